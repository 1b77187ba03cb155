"""Compare objectives of PEtab problems: python tests/benchmarks/petab_problems.py FOLDER

FOLDER is the PEtab benchmark collection, or has a folder for each problem in the same way. For each
problem the objective at the nominal point, and at a random point up to a factor of two around it,
is compared with one that uses nothing of rankone: the
model is turned into Python by libsbml (as in published_sbml.py), integrated by SciPy's LSODA at
1e-10, brought to steady states by long integration and Newton's method, and the likelihood is that
of ``petab.calculate_llh`` on the simulated measurements. *Gradient* compares the derivatives by the
coordinates of the parameters with central differences of rankone's objective along random
directions. Seconds are processor time: of reading and the first evaluation, of a further objective,
and of one with all derivatives.
"""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

from tests.benchmarks.published_sbml import Published, chosen, of_collection  # noqa: E402

RTOL, ATOL = 1e-10, 1e-13
LONG = 1e7  # Time to a steady state, in the units of the model
POINTS, DIRECTIONS, STEP = 1, 3, 1e-4


def main() -> None:
    arguments = of_collection(__doc__).parse_args()
    print(f"{'problem':36}objective        independent      relative  around    gradient  seconds")
    for file in chosen(arguments, "*[0-9].yaml"):
        print(f"{file.stem:36}{_tried(file)}", flush=True)


def _tried(file: Path) -> str:
    """One line of the table."""
    import rankone

    seconds = [time.process_time()]
    problem = rankone.read_petab(file)
    problem.evaluate()
    seconds.append(time.process_time())
    objective = problem.objective()
    seconds.append(time.process_time())
    gradient = problem.evaluate().gradient
    seconds.append(time.process_time())
    reference = Independent(file)
    independent = reference.objective()
    relative = abs(objective - independent) / abs(independent)
    around = max(_differences(problem, reference), default=0.0)
    first, again, slopes = np.diff(seconds)
    return (
        f"{objective:<17.10g}{independent:<17.10g}{relative:.1e}   {around:.1e}   "
        f"{_gradient_error(problem, gradient):.1e}   {first:.1f} {again:.2f} {slopes:.2f}"
    )


def _differences(problem: Any, reference: Any) -> Iterator[float]:
    """Relative differences of objectives at random points within the bounds."""
    generator = np.random.default_rng(3)
    for _ in range(POINTS):
        values = dict(reference.nominal)
        for name in problem.estimated:
            p = problem.parameters[name]
            factor = 2.0 ** generator.uniform(-1.0, 1.0)
            values[name] = float(np.clip(factor * values[name], p.lower, p.upper))
        independent = reference.objective(values)
        yield abs(problem.objective(values) - independent) / abs(independent)


def _gradient_error(problem: Any, gradient: Any) -> float:
    """The largest error of derivatives along random directions, over the gradient's length."""
    generator, worst = np.random.default_rng(1), 0.0
    estimated = [problem.parameters[name] for name in problem.estimated]
    for _ in range(DIRECTIONS):
        direction = generator.normal(size=len(estimated))
        direction /= np.linalg.norm(direction)

        def at(step: float, direction: Any = direction) -> float:
            moved = {
                p.name: p.value(p.scaled(p.nominal) + step * x)
                for p, x in zip(estimated, direction, strict=True)
            }
            return float(problem.objective(moved))

        near, far = at(STEP) - at(-STEP), at(2 * STEP) - at(-2 * STEP)
        difference = (8.0 * near - far) / (12.0 * STEP)
        scale = max(float(np.linalg.norm(gradient)), 1.0)
        worst = max(worst, abs(difference - float(gradient @ direction)) / scale)
    return worst


class Independent:
    """A problem simulated by SciPy, its likelihood by ``petab``."""

    def __init__(self, file: Path) -> None:
        import petab.v1 as petab

        self.petab, self.problem = petab, petab.Problem.from_yaml(str(file))
        self.model = Published(file.parent)
        table = self.problem.parameter_df
        self.nominal = {str(name): float(row["nominalValue"]) for name, row in table.iterrows()}

    def objective(self, values: dict[str, float] | None = None) -> float:
        """Minus the log-likelihood at values of all parameters, by default the nominal point."""
        self.nominal = self.nominal if values is None else values
        parameters = self.problem.parameter_df.copy()
        parameters["nominalValue"] = [self.nominal[str(name)] for name in parameters.index]
        measured = self.problem.measurement_df.copy()
        simulated = measured.rename(columns={"measurement": "simulation"})
        simulated["simulation"] = np.nan
        before = measured.get("preequilibrationConditionId")
        keys = list(
            zip(
                ["" if before is None or not isinstance(b, str) else b
                 for b in (measured.index if before is None else before)],
                measured["simulationConditionId"],
                strict=True,
            )
        )  # fmt: skip
        for key in dict.fromkeys(keys):
            rows = [k for k, other in enumerate(keys) if other == key]
            times = np.array(measured["time"].iloc[rows], dtype=float)
            values, states = self._states(*key, times)
            for k, state in zip(rows, states, strict=True):
                simulated.iloc[k, simulated.columns.get_loc("simulation")] = self._observed(
                    measured.iloc[k], values, state
                )
        simulated["row"] = measured["row"] = np.arange(len(measured))
        return -float(self.petab.calculate_llh(measured, simulated, self._with_noise(), parameters))

    def _with_noise(self) -> Any:
        """The observable table, with the observable where noise formulas repeat its formula."""
        table = self.problem.observable_df.copy()
        for name, row in table.iterrows():
            formula = str(row["observableFormula"])
            whole = rf"(?<![\w]){re.escape(formula)}(?![\w])"
            table.loc[name, "noiseFormula"] = re.sub(whole, str(name), str(row["noiseFormula"]))
        for column, usual in (("observableTransformation", "lin"), ("noiseDistribution", "normal")):
            if column not in table:
                table[column] = usual
            table[column] = table[column].fillna(usual)
        return table

    def _point(self, condition: str) -> dict[str, float]:
        row = self.problem.condition_df.loc[condition]
        point = dict(self.nominal)
        for name, cell in row.items():
            if name != "conditionName":
                point[str(name)] = self.nominal.get(cell, cell) if isinstance(cell, str) else cell
        return {name: float(x) for name, x in point.items()}

    def _states(self, before: str, condition: str, times: Any) -> tuple[dict[str, float], Any]:
        """Values of names, and states (T, n) at times."""
        self.model.numbers = {}
        values = self.model.start(self._point(condition))
        y = np.array([values[name] for name in self.model.states], dtype=float)
        if before:
            earlier = self.model.start(self._point(before))
            start = np.array([earlier[name] for name in self.model.states], dtype=float)
            y = self._rest(self.model.rates(earlier), start)
        rates, finite = self.model.rates(values), np.isfinite(times)
        states = np.empty((times.size, y.size))
        grid = np.unique(times[finite])
        if grid.size:
            path = self._path(rates, y, grid)
            states[finite] = path[np.searchsorted(grid, times[finite])]
        if not finite.all():
            states[~finite] = self._rest(rates, y)
        return values, states

    def _path(self, rates: Any, y: Any, grid: Any) -> Any:
        """States (T, n); steps do not straddle what switches in the twelve problems."""
        switches = [t for t in self._switches if 0.0 < t < grid[-1]]
        ends, states = [*switches, float(grid[-1])], np.empty((grid.size, y.size))
        start, sizes = 0.0, np.maximum(np.abs(y), 1e-6 * np.abs(y).max())
        states[grid == 0.0] = y
        for end in ends:
            if end <= start:
                continue
            inside = (grid > start) & (grid <= end)
            near = 1e-9 * (end - start)

            def within(t: float, u: Any, a: float = start + near, b: float = end - near) -> Any:
                return rates(min(max(t, a), b), u)

            done = solve_ivp(
                within, (start, end), y, "LSODA", np.union1d(grid[inside], end), rtol=RTOL,
                atol=np.maximum(ATOL * sizes, 1e-30),
            )  # fmt: skip
            assert done.success, done.message
            states[inside], y, start = done.y.T[: inside.sum()], done.y[:, -1], end
            sizes = np.maximum(sizes, np.abs(y))
        return states

    @property
    def _switches(self) -> list[float]:
        """All numbers of the condition table that are times by their names."""
        table = self.problem.condition_df
        columns = [c for c in table.columns if "time" in c.lower() or c.endswith("_end")]
        return sorted({float(x) for c in columns for x in table[c]})

    def _rest(self, rates: Any, y: Any) -> Any:
        """The steady state that a trajectory reaches."""
        done = solve_ivp(rates, (0.0, LONG), y, "LSODA", rtol=1e-10, atol=1e-14 * np.abs(y).max())
        state, sizes = done.y[:, -1], np.abs(done.y).max(axis=1)
        later = solve_ivp(rates, (0.0, LONG), state, "BDF", rtol=1e-10, atol=1e-14 * sizes.max())
        assert np.allclose(later.y[:, -1], state, rtol=1e-6, atol=1e-9 * sizes.max())
        return later.y[:, -1]

    def _observed(self, row: Any, values: dict[str, float], state: Any) -> float:
        """The value of an observable."""
        names = {**values, **self.nominal, **dict(zip(self.model.states, state, strict=True))}
        names["time"] = row["time"]
        cells = str(row.get("observableParameters", "")).split(";")
        for i, text in enumerate(cells, 1):
            if text and text != "nan":
                name = f"observableParameter{i}_{row['observableId']}"
                names[name] = self.nominal[text] if text in self.nominal else float(text)
        for name in self.model.assigned:
            names[name] = eval(self.model.assigned[name], {"np": np, **_FUNCTIONS, **names})
        formula = self.problem.observable_df.loc[row["observableId"], "observableFormula"]
        return float(eval(str(formula).replace("^", "**"), {**_FUNCTIONS, **names}))


_FUNCTIONS = {
    "exp": np.exp,
    "log": np.log,
    "sqrt": np.sqrt,
    "piecewise": lambda *a: a[0] if a[1] else a[-1],
}


if __name__ == "__main__":
    main()
