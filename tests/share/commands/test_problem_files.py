"""Problems from Python and TOML files."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from rankone.problem.toml_layout import TOML_LAYOUT
from rankone.share.commands.common import load_problem
from rankone.support.errors import ProblemError

SCRIPT = """
import sympy as sp
import rankone as ro

t, k = sp.symbols("t k")
u = sp.Function("u")(t)
problem = ro.Problem([sp.Eq(u.diff(t), -k*u)], (t, 0, 2), {k: (0.5, 5)}, {u: 1})
"""


def written(tmp_path: Path, name: str, text: str) -> Path:
    path = tmp_path / name
    path.write_text(text)
    return path


def test_toml(tmp_path: Path) -> None:
    problem = load_problem(written(tmp_path, "lv.toml", TOML_LAYOUT))
    assert [str(unknown) for unknown in problem.unknowns] == ["x(t)", "y(t)"]
    assert list(problem.parameters.values()) == [(8.0, 12.0), (4.0, 6.0)]
    assert problem.time[1:] == (0.0, 6.0)


def test_toml_with_tables_numbers_and_a_name(tmp_path: Path) -> None:
    text = 'name = "rise"\n[rhs]\nu = 1.5\n[initial]\nu = 0\n[time]\nstart = 1\nend = 2\n'
    problem = load_problem(written(tmp_path, "rise.toml", text))
    assert problem.name == "rise"
    assert problem.time[1:] == (1.0, 2.0)
    assert float(problem.equations[0].rhs) == 1.5


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("time = [0, 1\n", r"bad\.toml` is not readable TOML"),
        (TOML_LAYOUT.replace('"x0"', "x0 + 1"), "shows the layout, with formulas in quotes"),
        ("time = [0, 1]\n", "lacks `rhs` and `initial`"),
        (f"tim = 1\n{TOML_LAYOUT}", r"unknown key `tim` \(did you mean `time`\?\); remedy"),
        (f"tim = 1\n{TOML_LAYOUT}", r"it may have `time`, \[rhs\], .*\[\[jumps\]\], \[units\]"),
        (TOML_LAYOUT.replace("[0, 6]", "{begin = 0, end = 6}"), r"\[time\] has `begin` and `end`"),
        (TOML_LAYOUT.replace("[0, 6]", "[0, 6, 1]"), r"`time` is \[0, 6, 1\], not a list of two"),
        (TOML_LAYOUT.replace("[0, 6]", "6"), r"`time` is 6, not .*; remedy: write it like time ="),
        (TOML_LAYOUT.replace("[0, 6]", '["0", 6]'), r"`time` is \['0', 6\], not a list of two num"),
        (
            TOML_LAYOUT.replace("[0, 6]", "{start = 0, end = true}"),
            r"what \[time\] holds is \[0, True\], not a list of two numbers",
        ),
        (
            TOML_LAYOUT.replace("time = [0, 6]\n", "") + "time = [0, 6]\n",
            r"lacks `time`; `time` in \[parameters\] belongs above the first table",
        ),
        (TOML_LAYOUT.replace("x0 = [8, 12]", "x0 = [12, 8]"), "x0"),
        (TOML_LAYOUT.replace("x0 = [8, 12]", "x0 = 8"), r"`x0` in \[parameters\] is 8, not a list"),
        (
            TOML_LAYOUT.replace("[8, 12]", "{lower = 8, upper = 12}"),
            r"`x0` in \[parameters\] is \{.*\}, not .*; remedy: write it like x0 = \[0.5, 1.5\]",
        ),
        (TOML_LAYOUT.replace("[8, 12]", "[8, inf]"), "the upper bound of parameter `x0` is inf"),
        (TOML_LAYOUT.replace('x = "x0"', 'x = "x0 +"'), "x0 +"),
        (TOML_LAYOUT.replace('x = "x0"', "x = [1]"), r"`x` in \[initial\] is \[1\], neither text"),
        (TOML_LAYOUT.replace('"x*(1.5 - y)"', "true"), r"`x` in \[rhs\] is True, neither text nor"),
        (TOML_LAYOUT.replace('"x*(1.5 - y)"', "nan"), r"`x` in \[rhs\] is nan, neither text nor"),
        (
            TOML_LAYOUT.replace("times = [2, 4]", "times = [2, 2]"),
            r"\[\[jumps\]\] has a time twice",
        ),
        (TOML_LAYOUT.replace("times = [2, 4]", ""), r"\[\[jumps\]\] has no times"),
        (
            TOML_LAYOUT.replace("times = [2, 4]", 'times = ["2"]'),
            r"\[\[jumps\]\] has `times` = \['2'\]",
        ),
        (TOML_LAYOUT.replace("times = [2, 4]", 'time = "a b"'), "time of a jump.*not a formula"),
        (TOML_LAYOUT.replace("[[jumps]]", "[jumps]"), "`jumps` is .*, not a list of tables"),
        (TOML_LAYOUT.replace('"x + 1"', "[1]"), r"`x` in \[jumps\] is \[1\], neither text"),
        ("time = [0, 1]\nrhs = 3\ninitial = 4\n", r"`rhs` is 3, not a table; .* a line \[rhs\]"),
    ],
)
def test_bad_toml(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(ProblemError, match=message):
        load_problem(written(tmp_path, "bad.toml", text))


def test_toml_jumps_at_a_formula_and_a_number(tmp_path: Path) -> None:
    tables = '[[jumps]]\ntime = "0.5*y0 + 0.5"\nx = "x + 1"\n[[jumps]]\ntime = 5\nx = "x + 1"\n'
    problem = load_problem(written(tmp_path, "jumps.toml", f"{TOML_LAYOUT}\n{tables}"))
    assert [*problem.jumps] == [2.0, 4.0, 5.0]
    assert len(problem.events) == 1


def test_python(tmp_path: Path) -> None:
    guarded = f"{SCRIPT}\nif __name__ == '__main__':\n    raise AssertionError\n"
    problem = load_problem(written(tmp_path, "decay.py", guarded))
    assert [str(unknown) for unknown in problem.unknowns] == ["u(t)"]


def test_python_imports_its_neighbours_and_leaves_the_path_alone(tmp_path: Path) -> None:
    written(tmp_path, "neighbour_of_decay.py", SCRIPT)
    path = list(sys.path)
    assert load_problem(
        written(tmp_path, "decay.py", "from neighbour_of_decay import problem\n")
    ).parameters
    assert sys.path == path


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x = 1\n", r"bad\.py` has no variable `problem`"),
        ("problem = 1\n", r"`problem` of `.*bad\.py` is a int, not a Problem"),
        (SCRIPT.replace("problem =", "decay ="), "no variable `problem`; it has `decay`"),
        ("\n1/0\n", r"bad\.py`, line 2, failed: ZeroDivisionError"),
        ("\n\nx = (\n", r"bad\.py`, line 3, failed: SyntaxError"),
        ("raise BaseException('q')\n", "line 1, failed: BaseException: q"),
        ("import sys\nsys.exit(3)\n", "line 2, failed: SystemExit: 3"),
        (SCRIPT.replace("(0.5, 5)", "(5, 0.5)"), "k"),
    ],
)
def test_bad_python(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(ProblemError, match=message):
        load_problem(written(tmp_path, "bad.py", text))


def test_an_interrupt_stays_one(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        load_problem(written(tmp_path, "bad.py", "raise KeyboardInterrupt\n"))


@pytest.mark.parametrize("name", ["missing.py", "missing.toml", "problem.yaml", "problem"])
def test_no_such_file(name: str, tmp_path: Path) -> None:
    with pytest.raises(ProblemError, match=name):
        load_problem(tmp_path / name)


def test_a_directory(tmp_path: Path) -> None:
    (tmp_path / "folder.py").mkdir()
    with pytest.raises(ProblemError, match="there is no file"):
        load_problem(tmp_path / "folder.py")
