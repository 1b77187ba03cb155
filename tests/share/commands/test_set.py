"""``--set``, and problem files with algebraic equations and steady starts, as commands."""

import json

import numpy as np
import pytest

import rankone
from rankone.share.commands.cli import main

FILE = """\
time = [0, 2]
unknowns = ["x", "z"]
equations = ["x_t = c - z", "0 = z**3 + z - k*x"]

[initial]
x = 1
z = "k/2"

[constants]
c = 0.5

[parameters]
k = [1, 2]
"""
AT_REST = """\
time = [0, 2]

[rhs]
x = "c - k*x"

[steady_state]
conditions = { c = "k/4" }
settle = 50

[constants]
c = 0.5

[parameters]
k = [1, 2]
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "circuit.toml"
    path.write_text(FILE)
    return path


def values(capsys, *arguments):
    status = main([*map(str, arguments), "--json"])
    out, err = capsys.readouterr()
    assert status == 0, err
    return json.loads(out)


def by_hand(k, c):
    """x and z at the end, by Euler steps and extrapolation in their number."""

    def steps(n):
        x = 1.0
        for _ in range(n):
            z = next(r.real for r in np.roots([1, 0, 1, -k * x]) if abs(r.imag) < 1e-9)
            x += 2 / n * (c - z)
        return x

    return 2 * steps(2000) - steps(1000)


def test_algebraic_equations_and_other_constants(file, tmp_path, capsys):
    saved = tmp_path / "solved.npz"
    answer = values(capsys, "solve", file, "--set", "c=0.7", "--save", saved, "--rtol", "1e-5")
    assert answer["success"]
    x, z = rankone.load(saved)(t=2, k=1.5)
    assert x == pytest.approx(by_hand(1.5, 0.7), rel=1e-5)
    assert z**3 + z == pytest.approx(1.5 * x, rel=1e-5)


def test_a_parameter_is_fixed(file, capsys):
    arguments = ("--at", "t=2", "--set", "c=0.7", "k=1.5", "--rtol", "1e-5")
    answer = values(capsys, "eval", file, *arguments)
    assert answer["values"]["x"] == pytest.approx(by_hand(1.5, 0.7), rel=1e-5)


def test_steady_starts(tmp_path, capsys):
    path = tmp_path / "rest.toml"
    path.write_text(AT_REST)
    answer = values(capsys, "eval", path, "--at", "t=0", "k=1.3", "--set", "c=2")
    assert answer["values"]["x"] == pytest.approx(0.25)
    path.write_text(AT_REST.replace("settle", "setle"))
    assert main(["show", str(path)]) == 2
    assert "unknown key `setle` (did you mean `settle`?)" in capsys.readouterr().err


def test_show_and_export(file, tmp_path, capsys):
    assert main(["show", str(file), "--first-order", "--set", "c=0.75"]) == 0
    assert "dx/dt = 0.75 - z" in capsys.readouterr().out
    assert main(["export", str(file), "-o", str(tmp_path / "circuit.py"), "--set", "c=0.75"]) == 0
    assert "('c', 0.75)" in (tmp_path / "circuit.py").read_text().replace('"', "'")


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("d=1", "no constant or parameter `d`"),
        ("c", "'c' cannot be read"),
        ("c=a", "'c=a' cannot be read"),
        ("x=1", "`x` is a state"),
        ("c=nan", "constant `c` is nan"),
    ],
)
def test_wrong_settings(file, setting, message, capsys):
    assert main(["solve", str(file), "--set", setting]) == 2
    assert message in capsys.readouterr().err


def test_saved_solutions_are_solved_already(file, tmp_path, capsys):
    saved = tmp_path / "solved.npz"
    main(["solve", str(file), "--save", str(saved), "--rtol", "1e-3", "--quiet"])
    assert main(["eval", str(saved), "--at", "t=1", "k=1.5", "--set", "c=1"]) == 2
    assert "--set is for problem files" in capsys.readouterr().err
