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
    from rankone.codegen.lowering import quadratic_system
    from rankone.estimation.fit import Fit
    from rankone.estimation.minimize import Optimum
    from rankone.estimation.posterior import Posterior
    from rankone.frontend.problem import Problem
    from rankone.interface.compiled import CompiledProblem
    from rankone.interface.compiled import compile_problem as compile
    from rankone.interface.compiled import solve_problem as solve
    from rankone.interface.solution import Solution, load
    from rankone.ir.forms import GeneralTerm, QuadraticSystem, SeparatedForm
    from rankone.ir.functions import duration, first_crossing, function, maximum, minimum, table
    from rankone.ir.verdict import Status
    from rankone.solvers.cross import CrossOptions
    from rankone.solvers.greedy import GreedyOptions
    from rankone.solvers.train import TrainOptions
    from rankone.statistics.solution_statistics import Sobol
    from rankone.support import __version__
    from rankone.support.errors import (
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
    from rankone.symbolic import FirstOrderSystem, WeakForm, first_order, separate, weak_form

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
    "BlowUpError": ("support.errors", "BlowUpError"),
    "CompiledProblem": ("interface.compiled", "CompiledProblem"),
    "ConvergenceError": ("support.errors", "ConvergenceError"),
    "CrossOptions": ("solvers.cross", "CrossOptions"),
    "EvaluationError": ("support.errors", "EvaluationError"),
    "ExportError": ("support.errors", "ExportError"),
    "FirstOrderSystem": ("symbolic", "FirstOrderSystem"),
    "Fit": ("estimation.fit", "Fit"),
    "GeneralTerm": ("ir.forms", "GeneralTerm"),
    "GreedyOptions": ("solvers.greedy", "GreedyOptions"),
    "Optimum": ("estimation.minimize", "Optimum"),
    "OptionError": ("support.errors", "OptionError"),
    "Posterior": ("estimation.posterior", "Posterior"),
    "Problem": ("frontend.problem", "Problem"),
    "ProblemError": ("support.errors", "ProblemError"),
    "QuadraticSystem": ("ir.forms", "QuadraticSystem"),
    "RankoneError": ("support.errors", "RankoneError"),
    "RankoneWarning": ("support.errors", "RankoneWarning"),
    "SeparatedForm": ("ir.forms", "SeparatedForm"),
    "SeparationError": ("support.errors", "SeparationError"),
    "Sobol": ("statistics.solution_statistics", "Sobol"),
    "Solution": ("interface.solution", "Solution"),
    "Status": ("ir.verdict", "Status"),
    "StorageError": ("support.errors", "StorageError"),
    "TrainOptions": ("solvers.train", "TrainOptions"),
    "WeakForm": ("symbolic", "WeakForm"),
    "__version__": ("support", "__version__"),
    "compile": ("interface.compiled", "compile_problem"),
    "duration": ("ir.functions", "duration"),
    "first_crossing": ("ir.functions", "first_crossing"),
    "first_order": ("symbolic", "first_order"),
    "function": ("ir.functions", "function"),
    "generate_source": ("codegen", "generate_source"),
    "load": ("interface.solution", "load"),
    "load_module": ("codegen", "load_module"),
    "maximum": ("ir.functions", "maximum"),
    "minimum": ("ir.functions", "minimum"),
    "quadratic_system": ("codegen.lowering", "quadratic_system"),
    "separate": ("symbolic", "separate"),
    "solve": ("interface.compiled", "solve_problem"),
    "table": ("ir.functions", "table"),
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
