"""Run the semantic cases of the SBML test suite: python tests/benchmarks/sbml.py FOLDER

FOLDER has a folder for each case, ``00001`` and so on, with its settings, results and models. For
each time course without delay functions and fast reactions one trajectory is compared with the
table of results within the tolerances of the case. Verdicts: *right*; *refused*, an error that
says why; *wrong*; *failed*, no answer in the seconds allowed, or an exception.
"""

from __future__ import annotations

import argparse
import csv
import re
import signal
import sys
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import sympy as sp

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

LEVELS = ("l3v2", "l3v1", "l2v5", "l2v4", "l2v3", "l2v2", "l2v1", "l1v2")
LEFT_OUT = {"CSymbolDelay", "FastReaction"}


class TimeOutError(Exception):
    """A case took too long."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", nargs="+", metavar="CASE", help="numbers of cases")
    parser.add_argument("--seconds", type=int, default=20, help="processor time of each case")
    parser.add_argument("--levels", nargs="+", default=LEVELS, help="by preference")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    signal.signal(signal.SIGPROF, _too_long)
    verdicts: Counter[str] = Counter()
    for folder in sorted(path for path in arguments.folder.iterdir() if path.is_dir()):
        if arguments.only and folder.name not in arguments.only:
            continue
        file = _model_file(folder, arguments.levels)
        if file is None or not _counts(folder):
            continue
        verdict, message = _verdict(folder, file, arguments.seconds)
        verdicts[verdict] += 1
        if verdict != "right" or arguments.only:
            print(f"{folder.name}: {verdict} {message}", flush=True)
    print(f"{verdicts.total()} cases: " + ", ".join(f"{n} {v}" for v, n in verdicts.items()))


def _too_long(*_: object) -> None:
    raise TimeOutError


def _counts(folder: Path) -> bool:
    """Whether a case is a time course without what is left out."""
    text = (folder / f"{folder.name}-model.m").read_text(errors="replace")
    tags = re.findall(r"(?:component|test)Tags:(.*)", text)
    names = {name.strip() for line in tags for name in line.split(",")}
    return "TimeCourse" in re.findall(r"testType:\s*(\w+)", text) and not names & LEFT_OUT


def _model_file(folder: Path, levels: list[str]) -> Path | None:
    files = [folder / f"{folder.name}-sbml-{level}.xml" for level in levels]
    return next(filter(Path.is_file, files), None)


def _verdict(folder: Path, file: Path, seconds: int) -> tuple[str, str]:
    from rankone import RankoneError

    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        ratio, place = _worst(folder, file)
        return ("right" if ratio <= 1.0 else "wrong"), f"{ratio:.3g} tolerances {place}"
    except RankoneError as error:
        return "refused", " ".join(str(error).split())
    except TimeOutError:
        return "failed", f"no answer in {seconds} s"
    except Exception as error:
        return "failed", f"{type(error).__name__}: {error}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)


def _worst(folder: Path, file: Path) -> tuple[float, str]:
    """The largest difference from the table in tolerances, and where it is."""
    import rankone

    settings = dict(
        line.split(":", 1)
        for line in (folder / f"{folder.name}-settings.txt").read_text().splitlines()
        if ":" in line
    )
    with (folder / f"{folder.name}-results.csv").open() as stream:
        header, *rows = [row for row in csv.reader(stream) if any(map(str.strip, row))]
    table = np.array([[float(cell) for cell in row] for row in rows])
    times = table[:, 0]
    model = rankone.read_sbml(file)
    problem = model.problem(time=(0.0, float(times[-1])))
    trajectory = problem.trajectory(times, rtol=1e-10)
    amounts = {name.strip() for name in settings["amount"].split(",")}
    worst = 0.0, ""
    for name, reference in zip(map(str.strip, header[1:]), table[:, 1:].T, strict=True):
        expression = _shown(file, model, name, name in amounts)
        computed = _values(expression, model, problem, trajectory, times)
        tolerance = float(settings["absolute"]) + float(settings["relative"]) * np.abs(reference)
        same = (reference == computed) | (np.isnan(reference) & np.isnan(computed))
        ratios = np.where(
            same, 0.0, np.nan_to_num(np.abs(computed - reference) / tolerance, nan=np.inf)
        )
        k = int(ratios.argmax())
        worst = max(worst, (float(ratios[k]), f"{name} at t = {times[k]:g}"))
    return worst


def _shown(file: Path, model: Any, name: str, as_amount: bool) -> sp.Expr:
    """What the table has under a name: an amount or a concentration of a species."""
    from rankone.problem.models.sbml_formulas import open_document

    expression = model.expression(name)
    document, content = open_document(file)
    species = content.getSpecies(name)
    if species is not None:
        compartment = content.getCompartment(species.getCompartment())
        size = model.expression(compartment.getId())
        pointlike = compartment.getSpatialDimensions() == 0
        is_amount = species.getHasOnlySubstanceUnits() or pointlike
        if as_amount and not is_amount:
            expression = expression * size
        elif is_amount and not as_amount and not pointlike:
            expression = expression / size
    del document
    return expression


def _values(expression: sp.Expr, model: Any, problem: Any, trajectory: Any, times: Any) -> Any:
    """An expression of the model along a trajectory."""
    numbers = {symbol: n for symbol, n in model.numbers.items() if n is not None}
    number_free = expression.xreplace({**numbers, model.start: sp.S.Zero})
    unknowns = list(problem.unknowns)
    function = sp.lambdify([model.time, unknowns], number_free, ["numpy", "scipy"])
    states = np.array([trajectory[unknown] for unknown in unknowns]).T
    return np.array([float(function(t, row)) for t, row in zip(times, states, strict=True)])


if __name__ == "__main__":
    main()
