"""rankone: parametric ODE systems written in SymPy, solved once for every parameter value.

>>> import sympy as sp, rankone as ro
>>> t, k = sp.symbols("t k")
>>> u = sp.Function("u")(t)
>>> problem = ro.Problem([sp.Eq(u.diff(t), -k * u)], (t, 0, 2), {k: (0.5, 5)}, {u: 1})
>>> solution = ro.solve(problem, rtol=1e-6)
>>> solution.success
True
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rankone.codegen import generate_source, load_module
    from rankone.compiled import CompiledProblem
    from rankone.compiled import compile_problem as compile
    from rankone.compiled import solve_problem as solve
    from rankone.errors import (
        BlowUpError,
        ConvergenceError,
        EvaluationError,
        ExportError,
        OptionError,
        ProblemError,
        RankoneError,
        RankoneWarning,
        SeparationError,
        StorageError,
    )
    from rankone.estimation.fit import Fit
    from rankone.estimation.minimize import Optimum
    from rankone.estimation.posterior import Posterior
    from rankone.functions import function, table
    from rankone.ir import GeneralTerm, QuadraticSystem, SeparatedForm
    from rankone.lowering import quadratic_system
    from rankone.solution import Solution, load
    from rankone.solvers.cross import CrossOptions
    from rankone.solvers.greedy import GreedyOptions
    from rankone.solvers.outcome import Status
    from rankone.solvers.train import TrainOptions
    from rankone.statistics.solution_statistics import Sobol
    from rankone.symbolic import (
        FirstOrderSystem,
        Problem,
        WeakForm,
        first_order,
        separate,
        weak_form,
    )
    from rankone.symbolic.over_time import duration, first_crossing, maximum, minimum
    from rankone.version import __version__

__all__ = [
    "BlowUpError",
    "CompiledProblem",
    "ConvergenceError",
    "CrossOptions",
    "EvaluationError",
    "ExportError",
    "FirstOrderSystem",
    "Fit",
    "GeneralTerm",
    "GreedyOptions",
    "Optimum",
    "OptionError",
    "Posterior",
    "Problem",
    "ProblemError",
    "QuadraticSystem",
    "RankoneError",
    "RankoneWarning",
    "SeparatedForm",
    "SeparationError",
    "Sobol",
    "Solution",
    "Status",
    "StorageError",
    "TrainOptions",
    "WeakForm",
    "__version__",
    "compile",
    "duration",
    "first_crossing",
    "first_order",
    "function",
    "generate_source",
    "load",
    "load_module",
    "maximum",
    "minimum",
    "quadratic_system",
    "separate",
    "solve",
    "table",
    "weak_form",
]

_HOMES = {
    "BlowUpError": ("errors", "BlowUpError"),
    "CompiledProblem": ("compiled", "CompiledProblem"),
    "ConvergenceError": ("errors", "ConvergenceError"),
    "CrossOptions": ("solvers.cross", "CrossOptions"),
    "EvaluationError": ("errors", "EvaluationError"),
    "ExportError": ("errors", "ExportError"),
    "FirstOrderSystem": ("symbolic", "FirstOrderSystem"),
    "Fit": ("estimation.fit", "Fit"),
    "GeneralTerm": ("ir", "GeneralTerm"),
    "GreedyOptions": ("solvers.greedy", "GreedyOptions"),
    "Optimum": ("estimation.minimize", "Optimum"),
    "OptionError": ("errors", "OptionError"),
    "Posterior": ("estimation.posterior", "Posterior"),
    "Problem": ("symbolic", "Problem"),
    "ProblemError": ("errors", "ProblemError"),
    "QuadraticSystem": ("ir", "QuadraticSystem"),
    "RankoneError": ("errors", "RankoneError"),
    "RankoneWarning": ("errors", "RankoneWarning"),
    "SeparatedForm": ("ir", "SeparatedForm"),
    "SeparationError": ("errors", "SeparationError"),
    "Sobol": ("statistics.solution_statistics", "Sobol"),
    "Solution": ("solution", "Solution"),
    "Status": ("solvers.outcome", "Status"),
    "StorageError": ("errors", "StorageError"),
    "TrainOptions": ("solvers.train", "TrainOptions"),
    "WeakForm": ("symbolic", "WeakForm"),
    "__version__": ("version", "__version__"),
    "compile": ("compiled", "compile_problem"),
    "duration": ("symbolic.over_time", "duration"),
    "first_crossing": ("symbolic.over_time", "first_crossing"),
    "first_order": ("symbolic", "first_order"),
    "function": ("functions", "function"),
    "generate_source": ("codegen", "generate_source"),
    "load": ("solution", "load"),
    "load_module": ("codegen", "load_module"),
    "maximum": ("symbolic.over_time", "maximum"),
    "minimum": ("symbolic.over_time", "minimum"),
    "quadratic_system": ("lowering", "quadratic_system"),
    "separate": ("symbolic", "separate"),
    "solve": ("compiled", "solve_problem"),
    "table": ("functions", "table"),
    "weak_form": ("symbolic", "weak_form"),
}
"""For each public name the module and its name there: imported when it is first asked for, so that
``import rankone`` and the command line begin at once."""


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, own = _HOMES[name]
    value = getattr(importlib.import_module(f"{__name__}.{module}"), own)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
