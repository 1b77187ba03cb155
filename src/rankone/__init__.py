"""rankone: parametric ODE systems written in SymPy, solved once for every parameter value.

>>> import sympy as sp, rankone as ro
>>> t, k = sp.symbols("t k")
>>> u = sp.Function("u")(t)
>>> problem = ro.Problem([sp.Eq(u.diff(t), -k * u)], (t, 0, 2), {k: (0.5, 5)}, {u: 1})
>>> solution = ro.solve(problem, rtol=1e-6)
>>> solution.success
True
"""

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
from rankone.functions import function, table
from rankone.ir import GeneralTerm, QuadraticSystem, SeparatedForm
from rankone.lowering import quadratic_system
from rankone.solution import Solution, load
from rankone.solvers.cross import CrossOptions
from rankone.solvers.greedy import GreedyOptions
from rankone.solvers.outcome import Status
from rankone.solvers.train import TrainOptions
from rankone.symbolic import (
    FirstOrderSystem,
    Problem,
    WeakForm,
    first_order,
    separate,
    weak_form,
)
from rankone.version import __version__

__all__ = [
    "BlowUpError",
    "CompiledProblem",
    "ConvergenceError",
    "CrossOptions",
    "EvaluationError",
    "ExportError",
    "FirstOrderSystem",
    "GeneralTerm",
    "GreedyOptions",
    "OptionError",
    "Problem",
    "ProblemError",
    "QuadraticSystem",
    "RankoneError",
    "RankoneWarning",
    "SeparatedForm",
    "SeparationError",
    "Solution",
    "Status",
    "StorageError",
    "TrainOptions",
    "WeakForm",
    "__version__",
    "compile",
    "first_order",
    "function",
    "generate_source",
    "load",
    "load_module",
    "quadratic_system",
    "separate",
    "solve",
    "table",
    "weak_form",
]
