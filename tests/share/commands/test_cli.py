"""The command line: exit status, streams, files. The solver is replaced by known solutions."""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import rankone
from rankone.problem.toml_layout import TOML_LAYOUT
from rankone.share.commands.cli import main
from rankone.share.commands.solve_files import ARGUMENTS
from rankone.solution.solution import Solution, load
from rankone.support.errors import BlowUpError, OptionError, RankoneWarning
from rankone.trajectories.system.verdict import Status
from tests.solution.evaluation.functions import two_unknowns

SOLVED = two_unknowns().solution
FAILED = Solution(
    replace(SOLVED.outcome, status=Status.RANK_LIMIT),
    SOLVED.metadata,
)
UNCHECKED = Solution(
    replace(SOLVED.outcome, status=Status.UNCHECKED, measured=None), SOLVED.metadata
)

Solver = Callable[..., Solution]


@pytest.fixture
def file(tmp_path: Path) -> str:
    path = tmp_path / "problem.toml"
    path.write_text(TOML_LAYOUT)
    return str(path)


@pytest.fixture
def solver(monkeypatch: pytest.MonkeyPatch) -> Callable[[Solver], None]:
    def install(solve: Solver) -> None:
        compiled = SimpleNamespace(
            first_order="<the system>",
            methods={"train": "<the reason>", "cross": None},
            automatic=("cross",),
            lifted=None,
            quadratic="<the groups>",
            solve=solve,
            weak_form="<the weak form>",
            separated="<the terms>",
            source="# code\n",
        )
        monkeypatch.setattr(rankone, "compile", lambda problem: compiled)

    return install


def returning(solution: Solution) -> Solver:
    return lambda **options: solution


def raising(error: BaseException) -> Solver:
    def solve(**options: Any) -> Solution:
        raise error

    return solve


@pytest.mark.parametrize(("solution", "status"), [(SOLVED, 0), (FAILED, 1), (UNCHECKED, 1)])
def test_exit_status_says_whether_the_tolerance_is_met(
    solution: Solution,
    status: int,
    file: str,
    solver: Callable[[Solver], None],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    solver(returning(solution))
    saved = tmp_path / "solution.npz"
    assert main(["solve", file, "--save", str(saved)]) == status
    out, err = capsys.readouterr()
    assert repr(solution) in out
    assert str(saved) in out
    assert err == ""
    assert load(saved).success is (status == 0)


@pytest.mark.parametrize(("solution", "error"), [(SOLVED, 2e-7), (UNCHECKED, None)])
def test_json(
    solution: Solution,
    error: float | None,
    file: str,
    solver: Callable[[Solver], None],
    capsys: pytest.CaptureFixture[str],
) -> None:
    solver(returning(solution))
    main(["solve", file, "--json", "--quiet"])
    out, err = capsys.readouterr()
    summary = json.loads(out, parse_constant=pytest.fail)
    assert summary["success"] is solution.success
    assert summary["error"] == error
    assert set(summary["errors"]) == {"x", "y"}
    assert summary["rank"] == 3
    assert summary["timings"] == solution.timings
    assert summary["message"] == solution.message
    assert err == ""


def test_options_reach_the_solver(file: str, solver: Callable[[Solver], None]) -> None:
    seen: list[dict[str, Any]] = []

    def solve(**options: Any) -> Solution:
        seen.append(options)
        return SOLVED

    solver(solve)
    main(["solve", file])
    main(["solve", file, "--rtol", "1e-4", "--check", "7"])
    main(["solve", file, "--check", "0"])
    assert [options["rtol"] for options in seen] == [1e-6, 1e-4, 1e-6]
    assert [options["check"] for options in seen] == [96, 7, 0]
    # standard error is not a terminal here
    assert not any(options["progress"] for options in seen)


def test_another_domain_and_options_reach_the_solver(
    file: str, solver: Callable[[Solver], None]
) -> None:
    seen: list[dict[str, Any]] = []

    def solve(**options: Any) -> Solution:
        seen.append(options)
        return SOLVED

    solver(solve)
    assert main(["solve", file]) == 0
    domain = ["--box", "x0=7:13", "y0=-1:2e0", "--box", "z=0:1", "--t-final", "4.5"]
    options = ["--options", "max_rank=300", "basis=legendre", "--options", "time_nodes=[3, 4]"]
    assert main(["solve", file, *domain, *options]) == 0
    plain, moved = seen
    assert plain["parameters"] == {}
    assert plain["t_final"] is None
    assert moved["parameters"] == {"x0": [7.0, 13.0], "y0": [-1.0, 2.0], "z": [0.0, 1.0]}
    assert moved["t_final"] == 4.5
    given = {name: moved[name] for name in moved.keys() - plain.keys()}
    assert given == {"max_rank": 300, "basis": "legendre", "time_nodes": [3, 4]}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["--box", "x0=7,13"],
            "--box: 'x0=7,13' cannot be read; remedy: write NAME=LOWER:UPPER[:SCALE]",
        ),
        (["--box", "x0"], "--box: 'x0' cannot be read; remedy: write NAME=LOWER:UPPER[:SCALE]"),
        (["--box", "x0=1:2", "x0=3:4"], "--box: 'x0=3:4' has a name that is given twice"),
        (["--box", "x0=7:13:lg"], "the scale of parameter `x0` is 'lg' (did you mean `log`?)"),
        (["--box", "x0=7"], "ascending order; remedy: give a lower end and a higher one"),
        (["--box", "x0=13:7"], "the range of `x0` is [13.0, 7.0], not two numbers"),
        (["--box", "x1=7:13"], "there is no parameter `x1`"),
        (["--t-final", "-1"], "the horizon is (0.0, -1.0)"),
        (["--t-final", "late"], "--t-final: invalid float value: 'late'"),
        (["--options", "max_rank"], "--options: 'max_rank' cannot be read"),
        (["--options", "max_rank="], "--options: 'max_rank=' cannot be read"),
        (["--options", "max_rank=many"], "--options max_rank=many is not valid"),
        (["--options", "max_rnk=3"], "unknown option 'max_rnk' (did you mean `max_rank`?)"),
        (["--options", "rtol=1e-3"], "--options: `rtol` is not an option of the engine"),
        (["--tol", "1e-3"], "unrecognized arguments: --tol 1e-3 (did you mean `--rtol`?)"),
        (["--t-finl=3"], "unrecognized arguments: --t-finl=3 (did you mean `--t-final`?)"),
        (["--profile"], "unrecognized arguments: --profile (see"),
        (["--options", "self=1"], "--options: `self` is not an option of the engine"),
    ],
)
def test_wrong_domains_and_options_are_named(
    arguments: list[str], message: str, file: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["solve", file, *arguments]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert message in err


def test_all_arguments_of_solve_are_known() -> None:
    """What is not an option of an engine cannot be given as one."""
    arguments = inspect.signature(rankone.CompiledProblem.solve).parameters
    kinds = {arguments[name].kind for name in arguments.keys() - {*ARGUMENTS}}
    assert kinds == {inspect.Parameter.VAR_KEYWORD}


def test_quiet(
    file: str, solver: Callable[[Solver], None], capsys: pytest.CaptureFixture[str]
) -> None:
    solver(returning(SOLVED))
    assert main(["solve", file, "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")


def test_blow_up_saves_the_part_solved(
    file: str,
    solver: Callable[[Solver], None],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    part = Solution(
        replace(SOLVED.outcome, slabs=SOLVED.outcome.slabs[:1], status=Status.BLOW_UP),
        SOLVED.metadata,
    )
    solver(raising(BlowUpError("near t = 1.1", time=1.1, parameters={"x0": 1.0}, solution=part)))
    saved = tmp_path / "part.npz"
    assert main(["solve", file, "--save", str(saved)]) == 1
    out, err = capsys.readouterr()
    assert "t in [0, 1] of [0, 3]" in out
    assert err == "rankone: error: near t = 1.1\n"
    assert load(saved).time == (0.0, 1.0)


def test_blow_up_without_any_part(
    file: str, solver: Callable[[Solver], None], capsys: pytest.CaptureFixture[str]
) -> None:
    solver(raising(BlowUpError("at once", time=0.0, parameters={})))
    assert main(["solve", file]) == 1
    assert capsys.readouterr() == ("", "rankone: error: at once\n")


def test_interrupt_during_the_solve(
    file: str,
    solver: Callable[[Solver], None],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    solver(raising(KeyboardInterrupt()))
    assert main(["solve", file, "--save", str(tmp_path / "solution.npz")]) == 130
    assert capsys.readouterr().err == "rankone: interrupted\n"
    assert [path.name for path in tmp_path.iterdir()] == ["problem.toml"]


def test_interrupt_during_the_save(
    file: str,
    solver: Callable[[Solver], None],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def interrupted(stream: Any, array: Any, **_: Any) -> None:
        stream.write(b"half")
        raise KeyboardInterrupt

    solver(returning(SOLVED))
    monkeypatch.setattr("numpy.lib.format.write_array", interrupted)
    assert main(["solve", file, "--save", str(tmp_path / "solution.npz")]) == 130
    assert [path.name for path in tmp_path.iterdir()] == ["problem.toml"]


def test_bad_targets_are_found_before_the_solve(
    file: str,
    solver: Callable[[Solver], None],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    solver(raising(AssertionError("solved")))
    old = tmp_path / "old.npz"
    old.touch()
    for target, message in (
        (file, "end the name in .npz"),
        (str(tmp_path), "end the name in .npz"),
        (str(tmp_path / "missing" / "a.npz"), "there is no directory"),
        (str(old), "exists; remedy"),
    ):
        assert main(["solve", file, "--save", target]) == 2
        assert message in capsys.readouterr().err
    solver(returning(SOLVED))
    assert main(["solve", file, "--save", str(old), "--overwrite"]) == 0


def test_bad_input_has_no_traceback(
    file: str, solver: Callable[[Solver], None], capsys: pytest.CaptureFixture[str]
) -> None:
    solver(raising(OptionError("rtol=5 is out of range", remedy="a smaller one")))
    assert main(["solve", file, "--rtol", "5"]) == 2
    expected = "rankone: error: --rtol 5 is out of range; remedy: a smaller one\n"
    assert capsys.readouterr() == ("", expected)


def test_bugs_keep_their_traceback(file: str, solver: Callable[[Solver], None]) -> None:
    solver(raising(ZeroDivisionError()))
    with pytest.raises(ZeroDivisionError):
        main(["solve", file])


def test_warnings_are_one_line(
    file: str, solver: Callable[[Solver], None], capsys: pytest.CaptureFixture[str]
) -> None:
    def solve(**options: Any) -> Solution:
        import warnings

        warnings.warn("parameter `z` appears nowhere", RankoneWarning, stacklevel=1)
        return SOLVED

    solver(solve)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("warnings.filters", [])
        assert main(["solve", file, "--quiet"]) == 0
    assert capsys.readouterr().err == "rankone: warning: parameter `z` appears nowhere\n"


@pytest.mark.parametrize(
    "arguments",
    [[], ["dissolve"], ["solve"], ["solve", "a", "--check", "-1"], ["solve", "a", "--rtol", "x"]],
)
def test_usage_errors(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("rankone")
    assert error.count("\n") == 1
    assert "error: " in error


def test_help_documents_the_toml_layout_and_the_status(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["solve", "--help"]) == 0
    out = capsys.readouterr().out
    assert '  x = "x*(1.5 - y)"' in out
    assert "exit status" in out


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"rankone {rankone.__version__}\n"


@pytest.mark.parametrize(
    ("flags", "printed"),
    [
        (["--weak-form"], "<the weak form>\n"),
        (["--source"], "# code\n"),
        (
            ["--separated", "--source"],
            "# separated form\n\n<the terms>\n\n# generated module\n\n# code\n",
        ),
    ],
)
def test_show(
    flags: list[str],
    printed: str,
    file: str,
    solver: Callable[[Solver], None],
    capsys: pytest.CaptureFixture[str],
) -> None:
    solver(raising(AssertionError("solved")))
    assert main(["show", file, *flags]) == 0
    assert capsys.readouterr() == (printed, "")


def test_show_everything(
    file: str, solver: Callable[[Solver], None], capsys: pytest.CaptureFixture[str]
) -> None:
    solver(raising(AssertionError("solved")))
    assert main(["show", file]) == 0
    out = capsys.readouterr().out
    shown = (
        "train  does not apply: <the reason>",
        "cross  applies",
        "auto   tries cross",
        "<the system>",
        "<the weak form>",
        "<the terms>",
        "<the groups>",
        "# code",
    )
    assert [*map(out.index, shown)] == sorted(map(out.index, shown))


def test_a_problem_that_does_not_separate(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "pendulum.toml"
    path.write_text(
        'time = [0, 2]\n[rhs]\ntheta = "w"\nw = "-k*sin(theta)"\n'
        "[initial]\ntheta = 1\nw = 0\n[parameters]\nk = [1, 2]\n"
    )
    assert main(["show", str(path)]) == 0
    out = capsys.readouterr().out
    assert out.startswith("# methods\n\ntrain  applies\ncross  applies\n")
    assert "# lifted form\n\nLifted: 2 further unknowns\n" in out
    assert "# quadratic system\n\nnone: not all terms separate\n" in out
    assert main(["solve", str(path), "--rtol", "1e-4", "--method", "train"]) == 0
    capsys.readouterr()
    path.write_text(path.read_text().replace("sin(theta)", "theta*abs(theta)"))
    assert main(["solve", str(path), "--rtol", "1e-4", "--method", "train"]) == 2
    assert "`Abs(theta(t))` has no lifted form" in capsys.readouterr().err
    assert main(["solve", str(path), "--rtol", "1e-4", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["error"] <= 1e-4
    assert answer["method"] == "cross"


def test_the_whole_way(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """No replacement: a file in, a saved solution out."""
    path, saved = tmp_path / "decay.toml", tmp_path / "decay.npz"
    path.write_text(
        'time = [0, 2]\n[rhs]\nu = "-k*u"\n[initial]\nu = 1\n[parameters]\nk = [0.5, 5]\n'
    )
    assert main(["solve", str(path), "--rtol", "1e-5", "--json", "--save", str(saved)]) == 0
    assert json.loads(capsys.readouterr().out)["error"] <= 1e-5
    assert load(saved)(1.0, k=2.0)[0] == pytest.approx(0.1353352832, abs=1e-5)
    domain = ["--box", "k=6:7", "--t-final", "3", "--options", "max_rank=30"]
    assert main(["solve", str(path), "--json", *domain]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert (answer["time"], answer["parameters"]) == ([0, 3], {"k": [6, 7]})
    assert main(["show", str(path)]) == 0
    assert "Separated form" in capsys.readouterr().out
