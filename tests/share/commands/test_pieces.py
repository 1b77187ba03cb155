"""``rankone solve`` in pieces of a box, kept in a checkpoint, on processes."""

import json

import numpy as np
import pytest

import rankone as ro
from rankone.share.commands.cli import main

TOML = """
time = [0, 2]
rhs = {u = "-k*m*u"}
initial = {u = "1"}
parameters = {k = [0.5, 5], m = [1, 2]}
"""


@pytest.fixture
def solve(tmp_path, monkeypatch, capsys):
    """Runs the command in a folder with a problem; its status, and what it wrote."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "decay.toml").write_text(TOML)

    def run(*arguments):
        status = main(["solve", "decay.toml", "--rtol", "1e-4", *arguments])
        return status, capsys.readouterr()

    return run


def values(path):
    return ro.load(path).grid(t=np.linspace(0, 2, 5), k=[1.0, 4.0], m=[1.5])


def test_the_same_command_goes_on_to_the_same_bits(solve, tmp_path):
    command = ("--split", "k=2", "m=1", "--checkpoint", "run", "--overwrite", "--save")
    assert solve(*command, "first.npz")[0] == 0
    solves = sorted((tmp_path / "run").glob("solve-*"))
    assert len(solves) == 2
    stamp = solves[1].stat().st_mtime_ns
    solves[0].unlink()  # as if it had been killed before this one
    assert solve(*command, "again.npz")[0] == 0
    assert solves[0].exists()
    assert solves[1].stat().st_mtime_ns == stamp
    assert values("again.npz").tobytes() == values("first.npz").tobytes()
    assert len(ro.load("again.npz").pieces) == 2


@pytest.mark.slow
def test_processes_give_the_same_bits(solve):
    assert solve("--split", "k=2", "--save", "here.npz")[0] == 0
    assert solve("--split", "k=2", "--executor", "2", "--save", "there.npz")[0] == 0
    assert values("there.npz").tobytes() == values("here.npz").tobytes()


def test_one_solve_on_another_box_is_kept(solve, tmp_path):
    command = ("--box", "k=1:2", "--t-final", "1", "--checkpoint", "run", "--json")
    first, again = (json.loads(solve(*command)[1].out) for _ in range(2))
    assert first == again  # with its timings, so it was not solved again
    solution = ro.load(next((tmp_path / "run").glob("solve-*")))
    assert (solution.parameters, solution.time) == ({"k": (1.0, 2.0), "m": (1.0, 2.0)}, (0.0, 1.0))


def test_pieces_without_success_are_shown(solve):
    status, (out, err) = solve("--split", "k=2", "--check", "0")
    assert status == 1
    assert "2 without success" in err
    assert "success   no" in out or "unknown" in out


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("--split", "q=2"), "there is no parameter `q`"),
        (("--split", "k=x"), "write NAME=COUNT"),
        (("--executor", "x"), "--executor x is not valid"),
        (("--executor", "0"), "--executor 0 is not valid"),
        (("--checkpoint", ""), "checkpoint is empty text"),
    ],
)
def test_wrong_arguments(solve, arguments, text):
    status, (_, err) = solve(*arguments)
    assert status == 2
    assert text in err
