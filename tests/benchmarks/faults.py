"""Planted faults: each is put into a copy of the source, where the tests that guard it must fail.

``python -m tests.benchmarks.faults`` tries all of them, ``--only TEXT`` those whose place or title
has the text; ``--clean`` sees first that their tests pass, and ``--list`` writes the table. The
source itself is never touched. A fault that no test sees, or whose old text is not in the source
once, ends the run with status 1.

A copy of the repository is tested in a process that is forked after NumPy, SciPy and SymPy are
there: imports would take longer than most tests.
"""

from __future__ import annotations

import argparse
import importlib
import os
import shutil
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
COPIED = ("src", "tests", "examples", "docs", "pyproject.toml", "README.md")


@dataclass(frozen=True)
class Fault:
    """What is changed, and what must see it.

    Attributes
    ----------
    place : str
        A file or folder below ``src/rankone``: the one file in it that has the text once.
    old, new : str
    tests : str
        Files or folders below ``tests``, then what ``-k`` takes.
    """

    place: str
    old: str
    new: str
    tests: str

    @property
    def title(self) -> str:
        return f"{self.place}: {self.old.strip()!r} -> {self.new.strip()!r}"


SUITE = "share/conformance/test_conformance.py"
FMUS = "share/conformance/test_fmus_over_events.py"
PAGES = "share/conformance/test_pages_over_events.py"
X = "share/export/"

PYTHON = [
    Fault(
        X + "model_program.py",
        "t[k] = 2.0 * x * t[k - 1]",
        "t[k] = 2.00001 * x * t[k - 1]",
        f"{SUITE} python-unequal",
    ),
    Fault(
        X + "model_program.py",
        "pairs.insert(1, (2.0 * scale * rate",
        "pairs.insert(1, (scale * rate",
        f"{SUITE} python-scaled and derivatives",
    ),
    Fault(
        X + "model_program.py",
        "return np.log(x), 1.0 / x",
        "return np.log(x), 1.0 / x**2",
        f"{SUITE} python-scaled and derivatives",
    ),
    Fault(
        X + "model_program.py",
        "return -1.0 / x, 1.0 / (x * x)",
        "return 1.0 / x, 1.0 / (x * x)",
        f"{SUITE} python-scaled and values",
    ),
    Fault(
        X + "model_program.py",
        'element = np.searchsorted(lower[1:], x, side="right")',
        'element = np.searchsorted(lower[1:], x, side="left")',
        f"{SUITE} python-unequal and values",
    ),
    Fault(
        X + "model_program.py",
        "(array >= lower - slack) & (array <= upper + slack)",
        "(array >= lower - slack)",
        f"{SUITE} python-unequal and extrapolated",
    ),
    Fault(
        X + "model_stretches.py",
        "times[times > self.intervals[0][1]] = np.nan",
        "pass",
        f"{SUITE} python and times_of_events and (ball or dose)",
    ),
    Fault(
        X + "model_stretches.py",
        "moved = (of_begin + share * (of_end - of_begin)) * speed",
        "moved = of_begin * speed",
        f"{SUITE} python-ball and derivatives",
    ),
    Fault(
        X + "model_stretches.py",
        "states[:, :, times > borders[-1] + self._rounding] = np.nan",
        "pass",
        f"{SUITE} python-rocket and values",
    ),
    Fault(
        X + "model_stretches.py",
        "clock[border, 0] += slopes[j] * points[j]",
        "clock[border, 0] -= slopes[j] * points[j]",
        f"{SUITE} python-dose and times",
    ),
    Fault(
        X + "model_stretches.py",
        "(times >= _ascending(borders - self._early)[1:-1])",
        "(times > _ascending(borders)[1:-1])",
        f"{SUITE} python and values and (ball or dose)",
    ),
    Fault(
        X + "model_branches.py",
        "np.where(inside, 0.5 / np.where",
        "np.where(inside, 1.0 / np.where",
        f"{SUITE} python and derivatives and kicked",
    ),
    Fault(
        X + "model_branches.py",
        "return np.concatenate([np.clip(root, lower, upper), by_height",
        "return np.concatenate([root + 0.01, by_height",
        f"{SUITE} python-kicked and values",
    ),
    Fault(
        X + "model_branches.py",
        "product[:, 1:count] += product[:, k : k + 1] * root[1:]",
        "pass",
        f"{SUITE} python and derivatives and kicked",
    ),
    Fault(
        X + "model_python.py",
        "', NamedTuple, Protocol' if several",
        "', NamedTuple' if several",
        f"{SUITE} python-washed and values",
    ),
    Fault(
        X + "model_python.py",
        "*([] if model.choice is None else _BRANCH_END)",
        "",
        f"{SUITE} python-washed and times",
    ),
]
C = [
    Fault(
        X + "model.c.in",
        "value[k] = 2 * x * value[k - 1] - value[k - 2];",
        "value[k] = 2 * x * value[k - 1] + value[k - 2];",
        f"{SUITE} c-unequal and values",
    ),
    Fault(
        X + "model.c.in",
        "        slope[1] = factor;",
        "        slope[1] = 2 * factor;",
        f"{SUITE} c-unequal and derivatives",
    ),
    Fault(
        X + "model.c.in",
        "if (at[middle].lower <= *x)",
        "if (at[middle].lower < *x)",
        f"{SUITE} c-unequal and values",
    ),
    Fault(
        X + "model.c.in",
        "if (!(*x >= lower - slack && *x <= upper + slack))",
        "if (*x < lower - slack)",
        f"{SUITE} c-unequal and extrapolated",
    ),
    Fault(
        X + "model.c.in", "if (not_a_number(*x))", "if (0)", f"{SUITE} c-unequal and extrapolated"
    ),
    Fault(
        X + "model.c.in",
        "return (wide.bits & 0x7fffffffffffffffULL) > 0x7ff0000000000000ULL;",
        "return x != x;",
        f"{SUITE} other_arithmetics and flags4",
    ),
    Fault(
        X + "model_stretches.c.in",
        "if (t > border[b->stretches] + slack)",
        "if (0)",
        f"{SUITE} c-rocket and values",
    ),
    Fault(
        X + "model_stretches.c.in",
        "t >= border[i + 1] - (rounded[i + 1] ? slack : 0)",
        "t > border[i + 1]",
        f"{SUITE} c-rocket and values or c-two and values",
    ),
    Fault(
        X + "model_stretches.c.in",
        "time += numbers[j] * point[j];",
        "time -= numbers[j] * point[j];",
        f"{SUITE} c-washed and times",
    ),
    Fault(
        X + "model_stretches.c.in",
        "(real)sqrt((double)height)",
        "height",
        f"{SUITE} c-kicked and values",
    ),
    Fault(
        X + "model_stretches.c.in",
        "return earlier(one_border[1] - one_border[0], other[1] - other[0], f) /",
        "return earlier(other[1] - other[0], one_border[1] - one_border[0], f) /",
        f"{SUITE} c-washed",
    ),
    Fault(
        X + "model_stretches.c.in",
        "return f->sign * at->guard",
        "return -f->sign * at->guard",
        f"{SUITE} c-kicked and times",
    ),
]
JAVASCRIPT = [
    Fault(
        X + "model_train.js.in",
        "        s3 += heap[d + 3] * value;\n",
        "        s3 += heap[d + 2] * value;\n",
        f"{SUITE} without_webassembly and (kirchhoff or scaled)",
    ),
    Fault(
        X + "model_train.js.in",
        "heap[out + i] = s0 + s2 + (s4 + s6) + (s1 + s3 + (s5 + s7));",
        "heap[out + i] = s0 + s2 + (s4 + s6) + (s1 + (s5 + s7));",
        f"{SUITE} without_webassembly",
    ),
    Fault(
        X + "model_train.js.in",
        "heap[SERIES + u * count + k] += heap[d + u - first]",
        "heap[SERIES + u * count + k] -= heap[d + u - first]",
        f"{SUITE} curves_in_javascript and lotka",
    ),
    Fault(
        X + "model_stretches.js.in",
        "let same = prepared >= columns;",
        "let same = true;",
        f"{SUITE} javascript and (values or derivatives) and ball",
    ),
    Fault(
        X + "model_stretches.js.in",
        "if (t > heap[border + stretches] + COORDINATES[0].slack) return undefined;",
        "",
        f"{SUITE} javascript-rocket and values",
    ),
    Fault(
        X + "model_stretches.js.in",
        "(time, slope, j) => time + (slope ?",
        "(time, slope, j) => time - (slope ?",
        f"{SUITE} javascript-dose and times",
    ),
    Fault(
        X + "model_stretches.js.in",
        "const slope = heap[ROOT_SLOPES + r * PARAMETERS + k - 1];",
        "const slope = 0;",
        f"{SUITE} javascript-kicked and derivatives",
    ),
    Fault(
        X + "model.js.in",
        "if (times[i + 1] <= COORDINATES[0].upper) values[k] = times[i + 1];",
        "values[k] = times[i + 1];",
        f"{SUITE} javascript and times_of and (ball or dose)",
    ),
    Fault(
        X + "model.js.in",
        "return undecided || rivals.length ? -1 : chosen;",
        "return chosen;",
        f"{SUITE} javascript-washed and times",
    ),
    Fault(
        X + "model.js.in",
        "throw new UnknownEventError(text, { value: event });",
        "throw new ModelError(text);",
        f"{SUITE} javascript_declares or declares",
    ),
    Fault(
        X + "model.d.ts.in",
        "export const errors",
        "declare const errors",
        f"{SUITE} declares",
    ),
    Fault(
        X + "model_js.py",
        "units = [(name, js_string(unit)) for name, unit in model.units if name in names]",
        "units = []",
        f"{SUITE} javascript-units and names",
    ),
]
PAGE = [
    Fault(
        X + "pages.py",
        "text = javascript_model(model, file)[file]",
        "text = javascript_model(model, file)[file].replace('2 * x', '2.001 * x')",
        f"{SUITE} page-units or page_has",
    ),
    Fault(
        X + "explorer.py",
        '"running": " of what still runs" if model.terminal else ""',
        '"running": ""',
        f"{PAGES} what_is_written and rocket",
    ),
    Fault(
        X + "explorer.py",
        '"terminal": model.terminal,',
        '"terminal": False,',
        f"{PAGES} bands_end or what_is",
    ),
    Fault(
        X + "explorer/values.js",
        "export function timesWithEvents",
        "export function timesWithEvent",
        f"{PAGES} times_of_curves",
    ),
]
FMU = [
    Fault(
        X + "fmu_core.h.in",
        'return fmu_failed(self, "the step begins at',
        'return 0 * fmu_failed(self, "the step begins at',
        f"{FMUS} early_return",
    ),
    Fault(
        X + "fmu_core.h.in",
        "return self->discarded || self->ended;",
        "return self->discarded;",
        f"{FMUS} terminal_event",
    ),
    Fault(
        X + "fmu_core.h.in",
        "return fmu_refused(self, FMU_DISCARD,",
        "return 0 * fmu_refused(self, FMU_DISCARD,",
        f"{SUITE} fmu2-units and extrapolated",
    ),
    Fault(
        X + "fmu_core.h.in",
        '"at the time %.15g it is not known which order of events "',
        '"at the time %.15g it is known which order of events "',
        f"{FMUS} unknown",
    ),
    Fault(
        X + "model_fmu.py",
        'return _line(dict(self.model.units).get(name, "")).strip()',
        'return ""',
        f"{SUITE} fmu2-units and names",
    ),
]
SHARE = [
    Fault(
        X + "packing.py",
        "if not solution.success and not allow_failed:",
        "if False:",
        f"{X}test_models.py failed",
    ),
]
CORE = [
    Fault(
        "tensors/coordinates.py",
        "return np.asarray(np.exp(s))",
        "return np.asarray(np.exp(1.0001 * s))",
        "tensors/test_scales.py",
    ),
    Fault(
        "tensors/coordinates.py",
        "        return -1.0 / s\n",
        "        return 1.0 / s\n",
        "tensors/test_scales.py",
    ),
    Fault(
        "tensors/coordinates.py",
        "return np.clip(array, lower, upper)",
        "return array",
        "solution/evaluation/test_evaluation.py",
    ),
    Fault(
        "tensors/slab.py",
        "return (2.0 * times - (self.start + self.end)) / (self.end - self.start)",
        "return (2.0 * times - (self.start + self.end)) / (self.end + self.start)",
        "tensors/test_slab.py tensors/test_evaluator.py",
    ),
    Fault(
        "solvers/engines/greedy_operators.py",
        "return RankOneSum((self.factors[0] * amplitudes, *self.factors[1:]))",
        "return RankOneSum((self.factors[0], *self.factors[1:]))",
        "solvers/engines tensors",
    ),
    Fault(
        "tensors/canonical.py",
        "return np.asarray((products @ self.amplitudes).reshape(shape))",
        "return np.asarray((products @ self.amplitudes**2).reshape(shape))",
        "tensors/test_canonical.py",
    ),
    Fault(
        "solution/evaluation/event_times.py",
        "return np.asarray(np.minimum(last, horizon).reshape(shape))",
        "return np.asarray(last.reshape(shape))",
        "solution/test_events.py",
    ),
    Fault(
        "solution/evaluation/event_times.py",
        "return [i for i, instant in enumerate(met, 1) if name in instant]",
        "return [i for i, instant in enumerate(met) if name in instant]",
        "solution/test_events.py",
    ),
    Fault(
        "solution/evaluation/core.py",
        'raise EvaluationError(f"nothing was solved: {self.message}")',
        "pass",
        "solution/evaluation/test_solution.py",
    ),
    Fault(
        "inference/estimation/intervals.py",
        "return float(scipy.stats.norm.ppf(share))",
        "return float(1.1 * scipy.stats.norm.ppf(share))",
        "inference/estimation/test_intervals.py",
    ),
    Fault(
        "inference/estimation/estimates.py",
        "return 2.0 * self._estimated - 2.0 * self.log_likelihood",
        "return self._estimated - 2.0 * self.log_likelihood",
        "inference/estimation/test_noise.py",
    ),
    Fault(
        "inference/estimation/cube_distributions.py",
        "return np.asarray(np.prod(width, axis=1)[:, None] * product)",
        "return np.asarray(product)",
        "inference/estimation/test_posterior.py",
    ),
    Fault(
        "tensors/coordinates.py",
        "return 0.0 < lower < upper or lower < upper < 0.0",
        "return lower < upper",
        "tensors/test_scales.py problem/test_scales.py",
    ),
    Fault(
        "support/errors.py",
        "return f\"{', '.join(quoted[:-1])} and {quoted[-1]}\"",
        "return f\"{', '.join(quoted)}\"",
        "support",
    ),
    Fault(
        "support/options.py",
        "if valid and least <= cast(float, value) <= most:",
        "if valid and least <= cast(float, value):",
        "support solvers/engines/test_train_engine.py",
    ),
]
SHARED = [
    Fault(
        "solution/statistics/over_box.py",
        "return np.asarray(np.sqrt(variances))",
        "return np.asarray(np.sqrt(1.2 * variances))",
        "solution/test_events_everywhere.py moments",
    ),
    # what tests share: processes, solves, data sets, pages
    Fault(
        X + "program.py",
        "return 0 if solution.success else 1",
        "return 1",
        "docs/test_docs.py standalone-solver",
    ),
    Fault(
        X + "program.py",
        'add("--json", action="store_true", help="print JSON")',
        "pass",
        "docs/test_docs.py standalone-solver",
    ),
    Fault(
        "inference/estimation/noise.py",
        "each = each + 2.0 * np.log(s)",
        "each = each + np.log(s)",
        "inference/estimation/test_noise.py",
    ),
    Fault(
        "inference/estimation/noise.py",
        "nu, squares = STUDENT_FREEDOM, (r / _STUDENT_SCALE) ** 2",
        "nu, squares = STUDENT_FREEDOM, r**2",
        "inference/estimation/test_noise.py",
    ),
    Fault(
        "inference/estimation/intervals.py",
        "return float(scipy.stats.t.ppf(share, dof)) if",
        "return float(0.75 * scipy.stats.t.ppf(share, dof)) if",
        "inference/estimation/test_experiments.py coverage",
    ),
    Fault(
        "trajectories/fields/field_crossings.py",
        "state = self._system.mapped(after, time, state, self._point)",
        "pass",
        "solution/fields/test_fields_with_events.py",
    ),
    Fault(
        "solvers/reduced",
        "raise SolveEndedError(Status.RANK_LIMIT, cause)",
        "raise SolveEndedError(Status.NO_CONVERGENCE, cause)",
        "solvers/reduced/test_field_solve.py travelling",
    ),
    Fault(
        "trajectories/integrators/workers.py",
        "            self.pool.restart()\n",
        "            pass\n",
        "solvers/engines/test_cross_workers.py dies_once",
    ),
    Fault(
        X + "fmi2.c.in",
        "return (fmi2Status)fmu_get(c, vr, nvr, value);",
        "return fmi2OK;",
        f"{SUITE} fmu2 and values",
    ),
    Fault(
        X + "fmi3.c.in",
        "return (fmi3Status)fmu_directional(instance, unknowns, nUnknowns, knowns, nKnowns, seed,",
        "return (fmi3Status)fmu_directional(instance, unknowns, nUnknowns, knowns, 0, seed,",
        f"{SUITE} fmu3 and derivatives",
    ),
    Fault(
        "solvers/branches.py",
        '_RAISED = {Status.WORK_LIMIT: "raise effort"',
        '_RAISED = {Status.WORK_LIMIT: "loosen rtol"',
        "solution/test_opened_events.py budget_that",
    ),
]
FAULTS = [
    fault for group in (PYTHON, C, JAVASCRIPT, PAGE, FMU, SHARE, CORE, SHARED) for fault in group
]


def planted(fault: Fault, source: Path) -> Path:
    """The file of a fault; a ValueError if the text is not there once."""
    place = source / fault.place
    files = [place] if place.is_file() else sorted(place.rglob("*.*"))
    having = [file for file in files if file.suffix != ".pyc" and fault.old in file.read_text()]
    if len(having) != 1 or having[0].read_text().count(fault.old) != 1:
        raise ValueError(f"the text is not there once: {[str(file) for file in having]}")
    return having[0]


def seen(fault: Fault, copy: Path) -> bool:
    """Whether the tests fail with the fault in a copy of the repository."""
    file = planted(fault, copy / "src" / "rankone")
    text = file.read_text()
    names, chosen = [], []
    for word in fault.tests.split():
        here = chosen if chosen or not (copy / "tests" / word).exists() else names
        here.append(word)
    paths = [str(copy / "tests" / name) for name in names]
    options = ["-q", "-x", "-n", "0", "-p", "no:cacheprovider", "--tb=no", "--no-header"]
    options += ["-m", ""]  # slow ones as well
    if chosen:
        options += ["-k", " ".join(chosen)]
    file.write_text(text.replace(fault.old, fault.new))
    try:
        child = os.fork()
        if child == 0:
            os.chdir(copy)
            sys.path[:] = [
                str(copy),
                str(copy / "src"),
                *(p for p in sys.path if p not in ("", str(ROOT), str(ROOT / "src"))),
            ]
            for name in [*sys.modules]:
                if name.partition(".")[0] in ("rankone", "tests", "examples"):
                    del sys.modules[name]
            for stream in (1, 2):
                os.dup2(os.open(copy / "out", os.O_WRONLY | os.O_CREAT | os.O_APPEND), stream)
            os._exit(int(pytest.main([*options, *paths])))
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    finally:
        file.write_text(text)
    if status not in (0, 1, 2):
        raise ValueError(f"pytest ended with status {status}: are there no such tests?")
    return status != 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="faults whose place or title has this text")
    parser.add_argument("--first", type=int, default=1, help="number of the first one to try")
    parser.add_argument("--clean", action="store_true", help="see the tests pass without faults")
    parser.add_argument("--list", action="store_true", help="write the table")
    asked = parser.parse_args()
    faults = [fault for fault in FAULTS if asked.only in fault.title]
    if asked.list:
        for fault in faults:
            print(f"{fault.title} | {fault.tests}")
        return 0
    for name in (
        "numpy",
        "scipy.integrate",
        "scipy.optimize",
        "scipy.stats",
        "sympy",
        "hypothesis",
    ):
        importlib.import_module(name)
    os.environ["PYTHONDONTWRITEBYTECODE"] = "1"
    sys.dont_write_bytecode = True
    missed = 0
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "copy"
        copy.mkdir()
        for name in COPIED:
            target = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
            target(ROOT / name, copy / name)
        os.environ["PYTHONPATH"] = f"{copy / 'src'}{os.pathsep}{copy}"
        for number, fault in enumerate(faults[asked.first - 1 :], asked.first):
            try:
                if asked.clean and seen(replace(fault, new=fault.old), copy):
                    raise ValueError("its tests fail without it")
                verdict = "seen" if seen(fault, copy) else "MISSED"
            except ValueError as error:
                verdict = f"NOT PLANTED ({error})"
            missed += verdict != "seen"
            print(f"{number:3} {verdict:8} {fault.title}", flush=True)
    tried = len(faults[asked.first - 1 :])
    print(f"{tried - missed} of {tried} faults are seen")
    return int(missed > 0)


if __name__ == "__main__":
    raise SystemExit(main())
