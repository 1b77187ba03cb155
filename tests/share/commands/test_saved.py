"""Commands on saved solutions and problem files alike."""

from __future__ import annotations

import csv
import io
import json
import os
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rankone.share.commands.cli import main
from rankone.solution.solution import Solution, load
from rankone.trajectories.system.verdict import Status
from tests.solution.evaluation.functions import decay, oscillator, two_unknowns

SOLVED = two_unknowns().solution
UNITS = Solution(SOLVED.outcome, replace(SOLVED.metadata, units=(("t", "s"), ("x", "m"))))
FAILED = Solution(
    replace(SOLVED.outcome, status=Status.RANK_LIMIT),
    SOLVED.metadata,
)
POINT = ["--at", "t=1.2", "x0=0.5", "y0=2.5"]
AT = {"t": 1.2, "x0": 0.5, "y0": 2.5}
Run = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with solutions and a problem, to be copied."""
    folder = tmp_path_factory.mktemp("files")
    UNITS.save(folder / "u.npz")
    UNITS.save(folder / "u.nc")
    FAILED.save(folder / "failed.npz")
    (folder / "decay.toml").write_text(
        'time = [0, 2]\n[rhs]\nu = "-k*u"\n[initial]\nu = 1\n[parameters]\nk = [0.5, 5]\n'
    )
    return folder


@pytest.fixture
def run(
    files: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> Run:
    """Run a command in a directory of its own: exit status and streams."""
    shutil.copytree(files, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)

    def command(*arguments: str) -> tuple[int, str, str]:
        status = main(arguments)
        return status, *capsys.readouterr()

    return command


@pytest.mark.parametrize("file", ["u.npz", "u.nc"])
def test_values_at_a_point(file: str, run: Run) -> None:
    x, y = (float(SOLVED[name](AT)) for name in "xy")
    assert run("eval", file, *POINT) == (0, f"x = {x!r} m\ny = {y!r}\n", "")
    status, out, _ = run("eval", file, *POINT, "--json")
    assert status == 0
    answer = json.loads(out)
    assert answer["coordinates"] == AT
    assert answer["values"] == {"x": x, "y": y}


def test_values_on_a_grid(run: Run) -> None:
    grid = ["--grid", "t=0:3:4", "x0=-1,0.5", "--at", "y0=2.5"]
    wanted = SOLVED.grid(t=[0, 1, 2, 3], x0=[-1, 0.5], y0=2.5)
    status, out, _ = run("eval", "u.nc", *grid)
    assert status == 0
    head, *rows = csv.reader(io.StringIO(out))
    assert head == ["t", "x0", "y0", "x", "y"]
    numbers = np.array(rows, dtype=float)
    assert numbers[:, :3].tolist() == [[t, x0, 2.5] for t in range(4) for x0 in (-1, 0.5)]
    np.testing.assert_array_equal(numbers[:, 3:], wanted.reshape(2, -1).T)
    assert run("eval", "u.nc", *grid, "--csv", "v.csv") == (0, "", "")
    assert Path("v.csv").read_text() == out
    status, _, err = run("eval", "u.nc", *grid, "--csv", "v.csv")
    assert status == 2
    assert "`v.csv` exists" in err
    assert run("eval", "u.nc", *grid, "--csv", "v.csv", "--overwrite")[0] == 0
    status, out, _ = run("eval", "u.nc", *grid, "--json")
    answer = json.loads(out)
    assert answer["coordinates"] == {"t": [0, 1, 2, 3], "x0": [-1, 0.5], "y0": 2.5}
    np.testing.assert_array_equal(answer["values"]["x"], wanted[0, :, :, 0])


def test_a_problem_is_solved_first(run: Run) -> None:
    status, out, err = run("eval", "decay.toml", "--rtol", "1e-5", "--at", "t=1", "k=2")
    assert (status, err) == (0, "")
    assert float(out.removeprefix("u = ")) == pytest.approx(np.exp(-2), abs=1e-5)


def test_states_and_what_does_not_depend_on_time(run: Run) -> None:
    oscillator().solution.save("o.npz")
    _, out, _ = run("eval", "o.npz", "--at", "s=1", "k=1.5", "--states", "all")
    assert [line.split(" = ")[0] for line in out.splitlines()] == ["x", "x_t"]
    SOLVED.at(1.2).save("at.nc")
    x, y = SOLVED(**AT)
    status, out, _ = run("eval", "at.nc", "--at", "x0=0.5", "y0=2.5", "--json")
    assert status == 0
    assert json.loads(out)["values"] == pytest.approx({"x": x, "y": y}, rel=1e-12)
    assert run("eval", "at.nc", *POINT)[0] == 2
    decay().solution.at(1.0).save("number.npz")
    assert float(run("eval", "number.npz")[1].removeprefix("u = ")) == pytest.approx(np.exp(-1))
    assert run("eval", "number.npz", "--csv")[1].startswith("u\n0.36787")
    for file in ("at.nc", "number.npz"):
        status, out, err = run("report", file, "--no-plots")
        assert (status, err) == (0, "")
        assert "Over the box:\n" in out


def test_a_failed_solution_is_evaluated_and_said(run: Run) -> None:
    status, out, err = run("eval", "failed.npz", *POINT)
    assert status == 1
    assert out.startswith("x = ")
    message = "the error is not within the tolerance: the rank limit was reached"
    assert err == f"rankone: warning: {message}\n"
    status, out, err = run("report", "failed.npz", "--no-plots")
    assert status == 1
    assert message in err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["u.nc", "--at", "t=3.5", "x0=0", "y0=2"], "`t` = 3.5 is outside its horizon"),
        (["u.nc", "--at", "t=1", "x0=0", "y0=9"], "`y0` = 9 is outside"),
        (["u.nc", "--at", "t=1", "x0=0"], "no value for `y0`"),
        (["u.nc", "--at", "t=1", "x0=0", "y0=2", "z=1"], "unknown name `z`"),
        (["u.nc", "--at", "t=1", "x0=nan", "y0=2"], "`x0` is NaN"),
        (["u.nc", "--at", "t"], "--at: 't' cannot be read; remedy: write NAME=VALUE"),
        (["u.nc", "--at", "t=1", "t=2"], "--at: 't=2' has a name that is given twice"),
        (["u.nc", "--at", "t=1", "--grid", "t=1,2"], "'t' is given in --at and in --grid"),
        (["u.nc", "--grid", "t=0:1"], "--grid: 't=0:1' cannot be read; remedy: write NAME=LOWER"),
        (["u.nc", "--grid", "t=0:1:0"], "--grid: 't=0:1:0' cannot be read"),
        (["u.nc", "--grid", "t=0:1:2.5"], "cannot be read"),
        (["u.nc", "--grid", "t=1,,2"], "cannot be read"),
        (["u.nc", "--grid", "t=0:1:9000", "x0=0:1:9000", "y0=2"], "has 162,000,000 values"),
        (["u.nc", "--json", "--csv"], "--json and --csv are both to be printed"),
        (["u.nc", *POINT, "--csv", "missing/a.csv"], "there is no directory `missing`"),
        (["u.nc", *POINT, "--rtol", "1e-3"], "--rtol is for problem files; `u.nc` is solved"),
        (["none.nc"], "there is no file `none.nc`"),
        (["none.toml"], "there is no file `none.toml`"),
        (["u.txt"], "`u.txt` is neither a saved solution nor a problem file"),
        (["decay.toml", "--rtol", "5", "--at", "t=1", "k=1"], "--rtol 5"),
        (["broken.nc"], "`broken.nc` is not a rankone solution"),
        (["cut.nc"], "`cut.nc` is damaged"),
    ],
)
def test_bad_arguments_are_one_line(arguments: list[str], message: str, run: Run) -> None:
    Path("broken.nc").write_bytes(b"text")
    Path("cut.nc").write_bytes(Path("u.nc").read_bytes()[:-100])
    status, out, err = run("eval", *arguments)
    assert (status, out) == (2, "")
    assert message in err
    assert err.count("\n") == 1


def test_a_report(run: Run) -> None:
    status, out, err = run("report", "u.nc", "--no-plots")
    assert (status, err) == (0, "")
    assert repr(UNITS) in out
    assert "Over the box at t = 3 s:\n" in out
    assert f"\n  x [m]  {SOLVED.mean(3.0)[0]:.5g}  " in out
    status, out, _ = run("report", "u.npz", "--json", "--no-plots")
    data = json.loads(out, parse_constant=pytest.fail)
    assert data["units"] == {"t": "s", "x": "m"}
    assert data["ranks"] == [list(ranks) for ranks in SOLVED.ranks]
    found = data["statistics"]
    assert found["time"] == 3.0
    assert found["mean"]["y"] == SOLVED.mean(3.0)[1]
    assert found["std"]["x"] == SOLVED.std(3.0)[0]
    assert found["quantile_0.975"]["x"] == SOLVED.quantile(0.975, 3.0)[0]
    assert found["sobol_total"]["x"]["y0"] == SOLVED.sobol(3.0).total[0, 1, 0]
    assert found["sobol_first"]["y"]["x0"] == pytest.approx(0.0, abs=1e-12)


def test_a_report_of_what_was_not_solved(run: Run) -> None:
    outcome = replace(SOLVED.outcome, slabs=(), status=Status.RANK_LIMIT, measured=None)
    Solution(outcome, SOLVED.metadata).save("nothing.nc")
    status, out, _ = run("report", "nothing.nc", "--json", "--no-plots")
    assert status == 1
    assert "statistics" not in json.loads(out)


KINDS = ("trajectories", "bands", "sobol", "main_effects")
TEXTS = ["report.json", "report.txt"]


@pytest.mark.slow
def test_a_report_has_plots(run: Run) -> None:
    pytest.importorskip("matplotlib")
    status, out, err = run("report", "u.nc")
    assert (status, err) == (0, "rankone: written to the directory `u_report`\n")
    plots = [f"{kind}_{name}.png" for kind in KINDS for name in "xy"]
    assert sorted(os.listdir("u_report")) == sorted([*plots, *TEXTS])
    for name in plots:
        assert (Path("u_report") / name).read_bytes().startswith(b"\x89PNG")
    assert Path("u_report/report.txt").read_text() == out


@pytest.mark.slow
def test_a_report_in_a_directory(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """The plots are drawn at the centre and at the end of the horizon."""
    plotting = pytest.importorskip("rankone.share.plotting")
    pytest.importorskip("matplotlib")
    asked = []

    def plot(solution: Solution, *what: object, ax: object, **options: object) -> object:
        asked.append((*what, options))
        return ax

    for kind in KINDS:
        monkeypatch.setattr(plotting, f"plot_{kind}", plot)
    status, out, err = run("report", "u.nc", "-o", "out", "--json")
    assert (status, err) == (0, "")
    centre = {name: 0.5 * sum(ends) for name, ends in SOLVED.parameters.items()}
    assert asked == [
        *((centre, {"unknowns": name}) for name in "xy"),
        *((name, {}) for name in "xyxy"),
        *((name, 3.0, {}) for name in "xy"),
    ]
    assert Path("out/report.json").read_text() == out
    assert json.loads(out)["success"] is True
    status, _, err = run("report", "u.nc", "-o", "out")
    assert status == 2
    assert "report.txt` exists" in err
    assert run("report", "u.nc", "-o", "out", "--overwrite")[0] == 0


def test_places_of_reports(run: Run) -> None:
    """Nothing is made where a report cannot be."""
    before = sorted(os.listdir())
    for arguments, message in (
        (["u.nc", "-o", "u.npz"], "`u.npz` is not a directory"),
        (["u.nc", "-o", "u.npz", "--overwrite"], "`u.npz` is not a directory"),
        (["u.nc", "-o", "none/out"], "there is no directory `none`"),
        (["none.nc"], "none.nc"),
    ):
        status, out, err = run("report", *arguments)
        assert (status, out) == (2, "")
        assert message in err
        assert sorted(os.listdir()) == before


def test_a_report_without_plots(run: Run) -> None:
    before = sorted(os.listdir())
    status, out, err = run("report", "u.nc", "--no-plots")
    assert (status, err, sorted(os.listdir())) == (0, "", before)
    assert "Sobol indices" in out
    assert run("report", "u.nc", "--no-plots", "-o", "out") == (0, out, "")
    assert sorted(os.listdir("out")) == TEXTS


def test_a_report_without_matplotlib(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """It says what to install, and prints all the same."""
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    said = "rankone: warning: no plots without matplotlib; remedy: pip install matplotlib\n"
    before = sorted(os.listdir())
    status, out, err = run("report", "u.nc")
    assert (status, err, sorted(os.listdir())) == (0, said, before)
    assert "Sobol indices" in out
    assert run("report", "u.nc", "-o", "out") == (0, out, said)
    assert sorted(os.listdir("out")) == TEXTS


@pytest.mark.slow
def test_a_report_of_correlated_parameters(run: Run) -> None:
    """There are no Sobol indices of them."""
    pytest.importorskip("matplotlib")
    metadata = replace(SOLVED.metadata, correlations=(("x0", "y0", 0.6),))
    Solution(SOLVED.outcome, metadata).save("c.npz")
    status, out, err = run("report", "c.npz", "-o", "out")
    assert (status, err) == (0, "")
    assert out.endswith("No Sobol indices: the parameters are correlated\n")
    plots = [f"{kind}_{name}.png" for kind in KINDS if kind != "sobol" for name in "xy"]
    assert sorted(os.listdir("out")) == sorted([*plots, *TEXTS])


def test_plots_that_make_no_sense_are_left_out(run: Run) -> None:
    pytest.importorskip("matplotlib")
    UNITS.at(1.0).save("late.npz")
    Path("plain.toml").write_text('time = [0, 1]\n[rhs]\nu = "-u"\n[initial]\nu = 1\n')
    run("report", "late.npz", "-o", "late")
    assert run("report", "plain.toml", "-o", "plain", "--rtol", "1e-3")[0] == 0
    late = [f"{kind}_{name}.png" for kind in ("main_effects", "sobol") for name in "xy"]
    assert sorted(os.listdir("late")) == sorted([*late, *TEXTS])
    assert sorted(os.listdir("plain")) == sorted(["trajectories_u.png", *TEXTS])


@pytest.mark.slow
def test_models_of_saved_solutions_and_of_problems(run: Run) -> None:
    assert run("export", "u.nc", "-o", "m.c") == (0, "", "")
    assert run("export", "u.npz", "-o", "m.py") == (0, "", "")
    assert "Solved model of x, y" in Path("m.py").read_text()
    assert "t in [0.0, 3.0] s" in Path("m.h").read_text()
    assert run("export", "decay.toml", "-o", "d.c", "--rtol", "1e-4") == (0, "", "")
    assert Path("d.h").exists()
    assert run("export", "decay.toml", "-o", "d.py", "--model", "--rtol", "1e-4") == (0, "", "")
    assert "Solved model of u" in Path("d.py").read_text()
    options = ("--model-rtol", "1e-3", "--states", "all")
    assert run("export", "u.npz", "-o", "small.js", *options) == (0, "", "")
    assert "Made smaller: within 0.001" in Path("small.js").read_text()
    assert run("export", "decay.toml", "-o", "solver.py") == (0, "", "")
    assert "a solver for every parameter value" in Path("solver.py").read_text()


def test_what_cannot_be_exported(run: Run) -> None:
    before = sorted(os.listdir())
    for arguments, status, message in (
        (["u.nc", "-o", "m.txt"], 2, "the suffix '.txt' names no target"),
        (["decay.toml", "-o", "m.txt"], 2, "the suffix '.txt' names no target"),
        (["decay.toml", "-o", "m.py", "--rtol", "1e-3"], 2, "--rtol is for models"),
        (["decay.toml", "-o", "m.py", "--allow-failed"], 2, "--allow-failed is for models"),
        (["decay.toml", "-o", "m.py", "--fmi", "3.0"], 2, "--fmi is for models"),
        (["decay.toml", "-o", "m.py", "--model-rtol", "0.1"], 2, "--model-rtol is for models"),
        (["u.nc", "-o", "m.c", "--fmi", "3.0"], 2, "--fmi 3.0 does not apply to a `.c` file"),
        (["u.nc", "-o", "m.fmu", "--fmi", "1.0"], 2, "invalid choice: '1.0'"),
        (["u.nc", "-o", "m.c", "--model-rtol", "2"], 2, "--model-rtol 2"),
        (["u.nc", "-o", "m.c", "--method", "cross"], 2, "--method is for problem files"),
        (["failed.npz", "-o", "m.c"], 1, "the rank limit was reached; remedy: solve again"),
        (["none.toml", "-o", "m.py"], 2, "there is no file"),
    ):
        found, out, err = run("export", *arguments)
        assert (found, out) == (status, "")
        assert message in err
        assert err.count("\n") == 1
        assert sorted(os.listdir()) == before
    assert run("export", "failed.npz", "-o", "m.c", "--allow-failed") == (1, "", "")
    assert Path("m.c").exists()


def test_solve_saves_netcdf(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    assert run("solve", "decay.toml", "--rtol", "1e-3", "--save", "d.nc", "--quiet")[0] == 0
    assert load("d.nc").unknowns == ("u",)
    monkeypatch.setitem(sys.modules, "h5netcdf", None)
    status, _, err = run("solve", "decay.toml", "--save", "e.nc")
    assert status == 2
    assert "pip install h5netcdf h5py" in err
