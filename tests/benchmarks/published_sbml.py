"""Try published models in SBML: python tests/benchmarks/published_sbml.py FOLDER [--only NAME ...]

FOLDER has a folder for each model, as the PEtab benchmark collection has: a model, a table of
parameters with nominal values, tables of conditions and measurements. Three estimated parameters
are free, from nominal value ÷ 1.5 to × 1.5, under the first condition, up to the last measurement.

Two checks use nothing of rankone but libsbml: formulas are turned into Python by a walk through
their trees. *Rates* is the largest relative difference of right-hand sides at random states;
*error* is that of the solution at 1e-3 against SciPy trajectories of these formulas at 1e-10, in
random points and corners of the box, relative to the largest value of each unknown. Times are
evenly spread and, for fast transients, evenly spread in the logarithm: where an unknown is largest
for a millionth of the horizon, errors over its later values are larger than what is said.
"""

from __future__ import annotations

import argparse
import ast
import csv
import graphlib
import itertools
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import libsbml
import numpy as np
from scipy.integrate import solve_ivp

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

NAMES = (
    *("Boehm", "Bruno", "Fujita", "Raia", "Sneyd", "Zheng", "Perelson", "Elowitz", "Brannmark"),
    *("Blasi", "Weber", "Okuonghae"),
)
AT_REST = 100.0  # End of the horizon where all measurements are at the steady state
RTOL, SPREAD, TIMES, POINTS, STATES = 1e-3, 1.5, 101, 24, 20
_INFIX = {
    libsbml.AST_PLUS: " + ",
    libsbml.AST_TIMES: " * ",
    libsbml.AST_MINUS: " - ",
    libsbml.AST_DIVIDE: " / ",
    libsbml.AST_POWER: " ** ",
    libsbml.AST_FUNCTION_POWER: " ** ",
    libsbml.AST_LOGICAL_AND: " and ",
    libsbml.AST_LOGICAL_OR: " or ",
    libsbml.AST_RELATIONAL_GT: " > ",
    libsbml.AST_RELATIONAL_GEQ: " >= ",
    libsbml.AST_RELATIONAL_LT: " < ",
    libsbml.AST_RELATIONAL_LEQ: " <= ",
    libsbml.AST_RELATIONAL_EQ: " == ",
    libsbml.AST_RELATIONAL_NEQ: " != ",
}
_CALLS = {
    libsbml.AST_FUNCTION_EXP: "np.exp",
    libsbml.AST_FUNCTION_LN: "np.log",
    libsbml.AST_FUNCTION_SIN: "np.sin",
    libsbml.AST_FUNCTION_COS: "np.cos",
    libsbml.AST_FUNCTION_TANH: "np.tanh",
    libsbml.AST_FUNCTION_ABS: "abs",
    libsbml.AST_FUNCTION_MAX: "max",
    libsbml.AST_FUNCTION_MIN: "min",
}


def of_collection(document: str) -> argparse.ArgumentParser:
    """A parser of the folder of the collection, and of the names that are chosen."""
    parser = argparse.ArgumentParser(description=document.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", nargs="+", metavar="NAME", default=NAMES)
    return parser


def chosen(arguments: argparse.Namespace, files: str = "") -> Iterator[Path]:
    """The folders of the problems that are chosen, or files in them by a pattern."""
    for name in arguments.only:
        yield from sorted(arguments.folder.glob(f"{name}*/{files}"))


def main() -> None:
    arguments = of_collection(__doc__).parse_args()
    print(f"{'model':36}unknowns  free parameters  rates    said     error    seconds")
    for folder in chosen(arguments):
        print(f"{folder.name:36}{_tried(folder)}", flush=True)


def _tried(folder: Path) -> str:
    """One line of the table."""
    import rankone

    published = Published(folder)
    model = rankone.read_sbml(published.file)
    names = published.varied(model.parameters)
    nominal = {n: published.numbers.get(n, x) for n, x in model.parameters.items()}
    box = {n: tuple(sorted((nominal[n] / SPREAD, nominal[n] * SPREAD))) for n in names}
    problem = model.problem(box, time=(0.0, published.end))
    constants = {str(symbol) for symbol in problem.constants}
    others = {n: x for n, x in nominal.items() if n in constants and x is not None}
    began = time.process_time()
    solution = rankone.solve(problem.set(others), rtol=RTOL)
    seconds = time.process_time() - began
    rates = published.largest_difference(rankone.compile(problem.set(others)).system, box)
    error = published.error(solution, box)
    verdict = "success" if solution.success else "FAILED "
    return (
        f"{len(solution.unknowns):8}  {', '.join(names):15}  {rates:.1e}  "
        f"{solution.error:.1e}  {error:.1e}  {seconds:7.1f}  {verdict}"
    )


class Published:
    """A model of the collection as Python functions made of its formulas, and its tables."""

    def __init__(self, folder: Path) -> None:
        self.file = next(f for f in folder.glob("model_*.xml") if "all" not in f.name)
        (parameters,) = folder.glob("parameters_*.tsv")
        rows = [row for row in _table(parameters) if row["nominalValue"]]
        self.estimated = [row["parameterId"] for row in rows if float(row["estimate"])]
        self.numbers = {row["parameterId"]: float(row["nominalValue"]) for row in rows}
        conditions = _table(next(iter(sorted(folder.glob("experimentalCondition*.tsv")))))
        for name, text in list(conditions[0].items())[1:]:
            if name != "conditionName" and text:
                self.numbers[name] = self.numbers.get(text) if text in self.numbers else float(text)
        measured = [r for f in folder.glob("measurementData*.tsv") for r in _table(f)]
        finite = [at for row in measured if np.isfinite(at := float(row["time"]))]
        self.end = max(finite, default=AT_REST)
        document = libsbml.readSBMLFromFile(str(self.file))
        options = libsbml.ConversionProperties()
        options.addOption("expandFunctionDefinitions", True)
        document.convert(options)
        self._write(document.getModel())

    def _write(self, model: Any) -> None:
        """Formulas as Python source, and the values that the file gives."""
        rules = [model.getRule(i) for i in range(model.getNumRules())]
        self.assigned = {r.getVariable(): _python(r.getMath()) for r in rules if r.isAssignment()}
        self.changes = {r.getVariable(): _python(r.getMath()) for r in rules if r.isRate()}
        self.values = {c.getId(): c.getSize() for c in model.getListOfCompartments()}
        self.values |= {p.getId(): p.getValue() for p in model.getListOfParameters()}
        species = {s.getId(): s for s in model.getListOfSpecies()}
        for name, each in species.items():
            size = self.values[each.getCompartment()]
            amounts = each.getHasOnlySubstanceUnits()
            start = each.getInitialAmount() if each.isSetInitialAmount() else np.nan
            start = start if amounts else start / size
            if each.isSetInitialConcentration():
                start = each.getInitialConcentration() * (size if amounts else 1.0)
            self.values[name] = start
        self.starts = {
            a.getSymbol(): _python(a.getMath()) for a in model.getListOfInitialAssignments()
        }
        for reaction in model.getListOfReactions():
            law = reaction.getKineticLaw()
            local = {p.getId(): f"{reaction.getId()}_{p.getId()}" for p in _locals(law)}
            self.values |= {local[p.getId()]: p.getValue() for p in _locals(law)}
            rate = _python(law.getMath(), local)
            sides = (-1, reaction.getListOfReactants()), (1, reaction.getListOfProducts())
            for sign, reference in ((s, r) for s, listed in sides for r in listed):
                each = species[reference.getSpecies()]
                if each.getBoundaryCondition() or each.getConstant():
                    continue
                share = f"{sign * reference.getStoichiometry()!r} * ({rate})"
                if not each.getHasOnlySubstanceUnits():
                    share += f" / {each.getCompartment()}"
                before = self.changes.get(each.getId())
                self.changes[each.getId()] = f"{before} + {share}" if before else share
        self.states = list(self.changes)
        ordered = _ordered(self.assigned)
        lines = [f"    {n} = {self.assigned[n]}" for n in ordered]
        listed = ", ".join(self.changes.values())
        head = f"def rates(time, {', '.join(self.states)}):"
        self.source = "\n".join([head, *lines, f"    return [{listed}]"])

    def varied(self, parameters: dict[str, float]) -> list[str]:
        """The first three estimated parameters that the model has, with values."""
        named = [n for n in self.estimated if parameters.get(n) is not None and self.numbers[n]]
        return named[:3]

    def start(self, point: dict[str, float]) -> dict[str, float]:
        """All values at the start, with other numbers of some parameters."""
        scope = {"np": np, "time": 0.0, "piecewise": _piecewise}
        values = {**self.values, **self.numbers, **point}
        formulas = {**self.starts, **self.assigned}
        for name in _ordered(formulas):
            if name not in point and not (name in self.numbers and name in self.starts):
                values[name] = eval(formulas[name], {**scope, **values})
        return values

    def rates(self, values: dict[str, float]) -> Any:
        """The rates of the states as a function of time and states."""
        names = {"np": np, "piecewise": _piecewise, **values}
        exec(self.source, names)
        function = names["rates"]
        return lambda t, y: function(t, *y)

    def largest_difference(self, system: Any, box: dict[str, Any]) -> float:
        """Of the rates of rankone's system, at random states, over their largest change."""
        generator, worst = np.random.default_rng(1), 0.0
        for _ in range(STATES):
            point = {n: generator.uniform(*ends) for n, ends in box.items()}
            values = self.start(point)
            sizes = np.array([abs(values[n]) for n in self.states])
            sizes = np.where(sizes > 0.0, sizes, max(sizes.max(), 1.0))
            y = sizes * generator.uniform(0.5, 1.5, len(sizes))
            ours = np.array(self.rates(values)(0.0, y))
            order = [system.states.index(n) for n in self.states]
            u, p = np.empty((len(y), 1)), np.array([[point[n]] for n in box])
            u[order, 0] = y
            theirs = system.rhs(0.0, u, p)[order, 0]
            least = 1e-3 * np.abs(ours / sizes).max() * sizes  # slower rates are sums that cancel
            relative = np.abs(ours - theirs) / np.maximum(np.abs(ours), least)
            worst = max(worst, float(relative.max()))
        return worst

    def error(self, solution: Any, box: dict[str, Any]) -> float:
        """The largest error of a solution, over the largest value of each unknown."""
        early = np.geomspace(1e-9 * self.end, self.end, TIMES)
        times = np.union1d(np.linspace(0.0, self.end, TIMES), early)
        generator = np.random.default_rng(2)
        points = [[generator.uniform(*ends) for ends in box.values()] for _ in range(POINTS)]
        points += itertools.product(*box.values())
        off, sizes = np.zeros(len(self.states)), np.zeros(len(self.states))
        for point in points:
            at = dict(zip(box, point, strict=True))
            values = self.start(at)
            y = np.array([values[n] for n in self.states])
            reference = solve_ivp(
                self.rates(values), (0, self.end), y, "LSODA", times, rtol=1e-10, atol=1e-13
            ).y
            shown = np.array([solution[n](times, at) for n in self.states])
            off = np.maximum(off, np.abs(shown - reference).max(axis=1))
            sizes = np.maximum(sizes, np.abs(reference).max(axis=1))
        return float((off / np.where(sizes > 0.0, sizes, 1.0)).max())


def _table(file: Path) -> list[dict[str, str]]:
    with file.open() as stream:
        return list(csv.DictReader(stream, delimiter="\t"))


def _locals(law: Any) -> Any:
    return [*law.getListOfLocalParameters()] or [*law.getListOfParameters()]


def _python(node: Any, local: dict[str, str] | None = None) -> str:
    """A formula as Python text."""
    kind, children = node.getType(), map(node.getChild, range(node.getNumChildren()))
    inner = [_python(child, local) for child in children]
    if kind in _INFIX and len(inner) > 1:
        return f"({_INFIX[kind].join(inner)})"
    if kind == libsbml.AST_MINUS:
        return f"(-{inner[0]})"
    if kind in _CALLS:
        return f"{_CALLS[kind]}({', '.join(inner)})"
    if kind == libsbml.AST_FUNCTION_PIECEWISE:
        return f"piecewise({', '.join(inner)})"
    if kind == libsbml.AST_FUNCTION_ROOT:
        return f"({inner[-1]} ** (1.0 / {inner[0] if len(inner) > 1 else 2}))"
    if kind == libsbml.AST_FUNCTION_LOG:
        return f"(np.log({inner[-1]}) / np.log({inner[0] if len(inner) > 1 else 10}))"
    if kind == libsbml.AST_NAME_TIME:
        return "time"
    if kind == libsbml.AST_NAME:
        return (local or {}).get(node.getName(), node.getName())
    if node.isNumber():
        return repr(node.getValue())
    raise ValueError(f"{libsbml.formulaToL3String(node)} is not understood")


def _piecewise(*arguments: Any) -> Any:
    for value, holds in zip(arguments[::2], arguments[1::2], strict=False):
        if holds:
            return value
    return arguments[-1]


def _ordered(formulas: dict[str, str]) -> list[str]:
    """Names such that each formula comes after those it needs."""
    needs = {
        name: {n.id for n in ast.walk(ast.parse(text)) if isinstance(n, ast.Name)} & {*formulas}
        for name, text in formulas.items()
    }
    return list(graphlib.TopologicalSorter(needs).static_order())


if __name__ == "__main__":
    main()
