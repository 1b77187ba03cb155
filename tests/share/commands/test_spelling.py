"""Messages of commands: options in place of arguments, and TOML in place of mappings."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

import pytest

from rankone.share.commands.cli import main, spelling

SOLVE = (
    "overwrite",
    "rtol",
    "method",
    "unknowns",
    "options",
    "max_memory",
    "cover",
    "effort",
    "t_final",
)
OPTIONS = [
    ("try rtol=1e-03: it was solved to 2e-04", "try --rtol 1e-03: it was solved to 2e-04"),
    ("method='cross', the default", "--method cross, the default"),
    ("leave method= out, or take cross", "leave --method out, or take cross"),
    ("unknowns=('x', 'y') asks for these", "--unknowns x y asks for these"),
    ("choose another name, or overwrite=True", "choose another name, or --overwrite"),
    ("max_memory='2 GB'", "--max-memory '2 GB'"),
    (
        "raise max_rank, narrow the box or loosen rtol",
        "raise --options max_rank=N, narrow the box or loosen --rtol",
    ),
    ("unless `t_final` is to be later", "unless --t-final is to be later"),
    ("at k=0.5, where x == 3", "at k=0.5, where x == 3"),
    ("end it before t = 1; the error has the solution up to t = 1", "end it before t = 1"),
]
TABLES = [
    ("give numbers, for example {k: (0.5, 1.5)}", "give numbers, for example k = [0.5, 1.5]"),
    ("for example {8.0: {x: x + dose}}", 'for example time = 8.0, x = "x + dose"'),
    ("jumps={lag: {x: x + dose}}", 'time = "lag", x = "x + dose" in [[jumps]]'),
    ("Problem(..., atol={x: 1e-6}), or", "x = 1e-6 in [atol], or"),
    ("give Problem(..., atol=...), or", "give [atol], or"),
    ("SteadyState(..., start={x: 1})", "x = 1 in [initial]"),
    ("give a larger settle= to SteadyState", "give a larger settle in [steady_state]"),
    ("give settle=6e+02, or", "give settle = 6e+02 in [steady_state], or"),
    ("add it to `initial`, for example {x(t): 0}", "add it to [initial], for example x = 0"),
    ('write units={x: "m", t: "s"}', 'write x = "m", t = "s" in [units]'),
    ("give {symbol: expression, ...}", "give symbol = expression"),
    ("write (0.5, 1)", "write [0.5, 1]"),
    ('then = { y = "y/2" }', 'then = { y = "y/2" }'),
]


@pytest.mark.parametrize(("python", "words"), OPTIONS)
def test_options(python: str, words: str) -> None:
    for file in ("model.py", "model.toml"):
        assert spelling(Namespace(file=Path(file), **dict.fromkeys(SOLVE)))(python) == words


@pytest.mark.parametrize(("python", "toml"), TABLES)
def test_tables(python: str, toml: str) -> None:
    def spelled(file: str) -> str:
        return spelling(Namespace(file=Path(file), **dict.fromkeys(SOLVE)))(python)

    assert spelled("model.toml") == toml
    assert spelled("model.py") == python


def test_options_of_a_command_come_before_tables() -> None:
    fit = Namespace(file="model.toml", bounds=None, fixed=None)
    assert spelling(fit)("bounds={'q': (0, 1)}") == "--bounds q=0:1"
    assert spelling(fit)("fixed={name: value}") == "--fixed name=value"
    assert spelling(fit)("rtol=1e-3") == "rtol=1e-3"


WRONG = [
    ("k = [1, 0.5]", (), "write [0.5, 1]"),
    ("k = [0.5, 1]\n[atol]\nx = -1", (), "for example x = 1e-6"),
    ("k = [0.5, 1]", ("--method", "crss"), "--method crss is unknown"),
    ("m = [0.5, 1]", (), "declare it in [parameters]"),
]


@pytest.mark.parametrize(("lines", "options", "words"), WRONG)
def test_errors_of_a_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], lines: str, options: tuple[str], words: str
) -> None:
    file = tmp_path / "decay.toml"
    file.write_text(f'time = [0, 2]\n[rhs]\nx = "-k*x"\n[initial]\nx = 1\n[parameters]\n{lines}\n')
    assert main(["solve", str(file), *options]) == 2
    assert words in capsys.readouterr().err


def test_summaries_show_options(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "decay.toml"
    file.write_text('time=[0, 2]\nrhs={x = "-k*x**2"}\ninitial={x = 1}\nparameters={k = [1, 2]}\n')
    assert main(["solve", str(file), "--options", "max_rank=1"]) == 1
    shown = " ".join(capsys.readouterr().out.split())
    assert "raise --options max_rank=N, narrow the box or loosen --rtol" in shown
