"""Models on the command line."""

import json

import pytest

from rankone.share.commands.cli import main
from tests.problem.models import documents as d

pytest.importorskip("libsbml", reason="needs python-libsbml: pip install python-libsbml")


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "chain.xml"
    path.write_text(
        d.document(
            compartments=[d.compartment()],
            species=[d.species("A", amount=2.0), d.species("B", amount=0.0)],
            parameters=[d.parameter("k", 0.5), d.parameter("q", 0.2)],
            reactions=[d.reaction("R", ["A"], ["B"], "k*A*C"), d.reaction("Q", ["B"], [], "q*B*C")],
        ),
        encoding="utf-8",
    )
    return str(path)


def test_solve(file, tmp_path, capsys):
    saved = str(tmp_path / "chain.npz")
    options = ["--box", "k=0.25:1", "q=0.1:0.4:log", "--t-final", "4", "--rtol", "1e-4"]
    assert main(["solve", file, *options, "--save", saved, "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["unknowns"] == ["A", "B"]
    assert answer["time"] == [0.0, 4.0]
    assert answer["parameters"] == {"k": [0.25, 1.0], "q": [0.1, 0.4]}
    assert main(["eval", saved, "--at", "t=4", "k=0.5", "q=0.2", "--json"]) == 0


def test_show(file, capsys):
    assert main(["show", file]) == 0
    assert "dA/dt = -R/C" in capsys.readouterr().out
    assert main(["show", file, "--t-final", "2", "--box", "k=0.2:1", "--first-order"]) == 0
    assert "dA/dt = -A*k" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["solve", "{}"], "is a model, which has no horizon; remedy: give its end: --t-final 10"),
        (["show", "{}", "--box", "k=1:2"], "has no horizon"),
        (["solve", "{}", "--t-final", "4", "--box", "kk=1:2"], "no parameter `kk`"),
        (["report", "{}"], "solve the model first: rankone solve"),
        (["solve", "none.sbml", "--t-final", "4"], "there is no file"),
    ],
)
def test_bad_input(file, arguments, words, capsys):
    assert main([argument.format(file) for argument in arguments]) == 2
    assert words in capsys.readouterr().err


def test_the_horizon_of_a_problem_file_is_its_own(tmp_path, capsys):
    path = tmp_path / "problem.py"
    path.write_text("")
    assert main(["show", str(path), "--t-final", "3"]) == 2
    assert "--box and --t-final are for models" in capsys.readouterr().err
