"""rankone: parametric ODE systems written in SymPy, solved once for every parameter value.

State a :class:`Problem`, :func:`solve` it, and call the :class:`Solution` like a function of time
and parameters:

>>> import sympy as sp, rankone as ro
>>> t, k = sp.symbols("t k")
>>> u = sp.Function("u")(t)
>>> problem = ro.Problem([sp.Eq(u.diff(t), -k * u)], (t, 0, 2), {k: (0.5, 5)}, {u: 1})
>>> solution = ro.solve(problem, rtol=1e-6)
>>> solution.success
True
>>> print(solution[u](t=1.0, k=2.0).round(5), sp.exp(-2.0).round(5))
0.13534 0.13534

``help(rankone.solve)`` lists the options; ``docs/reference.md`` lists all public names.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rankone.calibration.calibrate import calibrate
    from rankone.calibration.problem import CalibrationProblem, read_petab
    from rankone.calibration.result import Calibration
    from rankone.calibration.solutions import CalibrationSolutions
    from rankone.codegen.loading import load_module
    from rankone.codegen.lowering import quadratic_system
    from rankone.codegen.module import generate_source
    from rankone.estimation.design import Design
    from rankone.estimation.experiments import Experiment
    from rankone.estimation.fit import Fit
    from rankone.estimation.minimize import Optimum
    from rankone.estimation.posterior import Posterior
    from rankone.estimation.posterior import posterior_of as posterior
    from rankone.estimation.search import fit_experiments as fit
    from rankone.frontend.events import Event
    from rankone.frontend.problem import Problem
    from rankone.frontend.steady_start import SteadyState
    from rankone.frontend.trajectory import Trajectory
    from rankone.interface.compiled import CompiledProblem
    from rankone.interface.compiled import compile_problem as compile
    from rankone.interface.compiled import solve_problem as solve
    from rankone.interface.many import Solutions, solve_many
    from rankone.interface.solution import Solution, load
    from rankone.interface.steady import steady_state
    from rankone.ir.forms import GeneralTerm, QuadraticSystem, SeparatedForm
    from rankone.ir.functions import (
        at_event,
        duration,
        event_time,
        first_crossing,
        function,
        maximum,
        minimum,
        table,
    )
    from rankone.ir.verdict import Status
    from rankone.models.model import Model
    from rankone.models.sbml import read_sbml
    from rankone.populations.fit import PopulationFit
    from rankone.populations.predictive_check import PredictiveCheck
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
    "Calibration",
    "CalibrationProblem",
    "CalibrationSolutions",
    "CompiledProblem",
    "ConvergenceError",
    "CrossOptions",
    "Design",
    "EvaluationError",
    "Event",
    "Experiment",
    "ExportError",
    "FirstOrderSystem",
    "Fit",
    "GeneralTerm",
    "GreedyOptions",
    "Model",
    "Optimum",
    "OptionError",
    "PopulationFit",
    "Posterior",
    "PredictiveCheck",
    "Problem",
    "ProblemError",
    "QuadraticSystem",
    "RankoneError",
    "RankoneWarning",
    "SeparatedForm",
    "SeparationError",
    "Sobol",
    "Solution",
    "Solutions",
    "Status",
    "SteadyState",
    "StorageError",
    "TrainOptions",
    "Trajectory",
    "WeakForm",
    "__version__",
    "at_event",
    "calibrate",
    "compile",
    "duration",
    "event_time",
    "first_crossing",
    "first_order",
    "fit",
    "function",
    "generate_source",
    "load",
    "load_module",
    "maximum",
    "minimum",
    "posterior",
    "quadratic_system",
    "read_petab",
    "read_sbml",
    "separate",
    "solve",
    "solve_many",
    "steady_state",
    "table",
    "weak_form",
]

_MODULES = {
    "calibration.calibrate": ("calibrate",),
    "calibration.problem": ("CalibrationProblem", "read_petab"),
    "calibration.result": ("Calibration",),
    "calibration.solutions": ("CalibrationSolutions",),
    "codegen.loading": ("load_module",),
    "codegen.lowering": ("quadratic_system",),
    "codegen.module": ("generate_source",),
    "estimation.design": ("Design",),
    "estimation.experiments": ("Experiment",),
    "estimation.fit": ("Fit",),
    "estimation.minimize": ("Optimum",),
    "estimation.posterior": ("Posterior", "posterior"),
    "estimation.search": ("fit",),
    "frontend.events": ("Event",),
    "frontend.problem": ("Problem",),
    "frontend.steady_start": ("SteadyState",),
    "frontend.trajectory": ("Trajectory",),
    "interface.compiled": ("CompiledProblem", "compile", "solve"),
    "interface.many": ("Solutions", "solve_many"),
    "interface.solution": ("Solution", "load"),
    "interface.steady": ("steady_state",),
    "ir.forms": ("GeneralTerm", "QuadraticSystem", "SeparatedForm"),
    "ir.functions": (
        *("at_event", "duration", "event_time", "first_crossing"),
        *("function", "maximum", "minimum", "table"),
    ),
    "ir.verdict": ("Status",),
    "models.model": ("Model",),
    "models.sbml": ("read_sbml",),
    "populations.fit": ("PopulationFit",),
    "populations.predictive_check": ("PredictiveCheck",),
    "solvers.cross": ("CrossOptions",),
    "solvers.greedy": ("GreedyOptions",),
    "solvers.train": ("TrainOptions",),
    "statistics.solution_statistics": ("Sobol",),
    "support": ("__version__",),
    "support.errors": (
        "BlowUpError",
        "ConvergenceError",
        "EvaluationError",
        "ExportError",
        "OptionError",
        "ProblemError",
        "RankoneError",
        "RankoneWarning",
        "SeparationError",
        "StorageError",
    ),
    "symbolic": ("FirstOrderSystem", "WeakForm", "first_order", "separate", "weak_form"),
}
"""The public names by their modules, which are imported when a name is first used, so that
``import rankone`` and the command line begin at once."""
_INNER_NAMES = {
    "compile": "compile_problem",
    "fit": "fit_experiments",
    "posterior": "posterior_of",
    "solve": "solve_problem",
}
"""Public names of functions that have a longer name where they are defined."""


def __getattr__(name: str) -> Any:
    for module, names in _MODULES.items():
        if name in names:
            home = importlib.import_module(f"{__name__}.{module}")
            globals()[name] = getattr(home, _INNER_NAMES.get(name, name))
            return globals()[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
