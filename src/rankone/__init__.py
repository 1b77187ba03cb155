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
    from rankone.compiler.codegen.layout import load_module
    from rankone.compiler.codegen.module import generate_source
    from rankone.compiler.codegen.sums import quadratic_system
    from rankone.compiler.passes import FirstOrderSystem, WeakForm, first_order, separate, weak_form
    from rankone.inference.calibration.calibrate import calibrate
    from rankone.inference.calibration.calibration_problem import CalibrationProblem, read_petab
    from rankone.inference.calibration.result import Calibration
    from rankone.inference.calibration.solutions import CalibrationSolutions
    from rankone.inference.estimation.design import Design
    from rankone.inference.estimation.experiments import Experiment
    from rankone.inference.estimation.fit import Fit
    from rankone.inference.estimation.minimize import Optimum
    from rankone.inference.estimation.posterior import Posterior
    from rankone.inference.estimation.posterior import posterior_of as posterior
    from rankone.inference.estimation.search import fit_experiments as fit
    from rankone.inference.populations.population import PopulationFit
    from rankone.inference.populations.predictive_check import PredictiveCheck
    from rankone.problem.fields import apply, field
    from rankone.problem.forms import GeneralTerm, QuadraticSystem, SeparatedForm
    from rankone.problem.functions import (
        at_event,
        duration,
        event_time,
        first_crossing,
        function,
        maximum,
        minimum,
        table,
    )
    from rankone.problem.integration import Trajectory
    from rankone.problem.models.model import Model
    from rankone.problem.models.sbml import read_sbml
    from rankone.problem.problem import FieldProblem, Problem
    from rankone.problem.steady_start import SteadyState
    from rankone.problem.user_events import Event
    from rankone.solution.compiled import CompiledProblem
    from rankone.solution.compiled_fields import CompiledFields
    from rankone.solution.fields.field_solution import FieldSolution
    from rankone.solution.fields.field_solution import load_saved as load
    from rankone.solution.many import Solutions, solve_many
    from rankone.solution.solution import Solution
    from rankone.solution.solving import compile_any as compile
    from rankone.solution.solving import solve_any as solve
    from rankone.solution.statistics.solution_statistics import Sobol
    from rankone.solution.steady import steady_state
    from rankone.solvers.engines.engine_options import CrossOptions, GreedyOptions, TrainOptions
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
    from rankone.trajectories.system.verdict import Status

__all__ = [
    "BlowUpError",
    "Calibration",
    "CalibrationProblem",
    "CalibrationSolutions",
    "CompiledFields",
    "CompiledProblem",
    "ConvergenceError",
    "CrossOptions",
    "Design",
    "EvaluationError",
    "Event",
    "Experiment",
    "ExportError",
    "FieldProblem",
    "FieldSolution",
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
    "apply",
    "at_event",
    "calibrate",
    "compile",
    "duration",
    "event_time",
    "field",
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
    "inference.calibration.calibrate": ("calibrate",),
    "inference.calibration.calibration_problem": ("CalibrationProblem", "read_petab"),
    "inference.calibration.result": ("Calibration",),
    "inference.calibration.solutions": ("CalibrationSolutions",),
    "compiler.codegen.layout": ("load_module",),
    "compiler.codegen.sums": ("quadratic_system",),
    "compiler.codegen.module": ("generate_source",),
    "inference.estimation.design": ("Design",),
    "inference.estimation.experiments": ("Experiment",),
    "inference.estimation.fit": ("Fit",),
    "inference.estimation.minimize": ("Optimum",),
    "inference.estimation.posterior": ("Posterior", "posterior"),
    "inference.estimation.search": ("fit",),
    "problem.user_events": ("Event",),
    "problem.fields": ("apply", "field"),
    "problem.problem": ("FieldProblem", "Problem"),
    "problem.steady_start": ("SteadyState",),
    "problem.integration": ("Trajectory",),
    "solution.compiled": ("CompiledProblem",),
    "solution.compiled_fields": ("CompiledFields",),
    "solution.solving": ("compile", "solve"),
    "solution.fields.field_solution": ("FieldSolution", "load"),
    "solution.many": ("Solutions", "solve_many"),
    "solution.solution": ("Solution",),
    "solution.steady": ("steady_state",),
    "problem.forms": ("GeneralTerm", "QuadraticSystem", "SeparatedForm"),
    "problem.functions": (
        *("at_event", "duration", "event_time", "first_crossing"),
        *("function", "maximum", "minimum", "table"),
    ),
    "trajectories.system.verdict": ("Status",),
    "problem.models.model": ("Model",),
    "problem.models.sbml": ("read_sbml",),
    "inference.populations.population": ("PopulationFit",),
    "inference.populations.predictive_check": ("PredictiveCheck",),
    "solvers.engines.engine_options": ("CrossOptions", "GreedyOptions", "TrainOptions"),
    "solution.statistics.solution_statistics": ("Sobol",),
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
    "compiler.passes": ("FirstOrderSystem", "WeakForm", "first_order", "separate", "weak_form"),
}
"""The public names by their modules, which are imported when a name is first used, so that
``import rankone`` and the command line begin at once."""
_INNER_NAMES = {
    "compile": "compile_any",
    "fit": "fit_experiments",
    "load": "load_saved",
    "posterior": "posterior_of",
    "solve": "solve_any",
}
"""Public names of functions that have a longer name where they are defined."""


def __getattr__(name: str) -> Any:
    for module, names in _MODULES.items():
        if name in names:
            home = importlib.import_module(f"{__name__}.{module}")
            public = globals()[name] = getattr(home, _INNER_NAMES.get(name, name))
            if name in _INNER_NAMES:  # as help and errors call it
                public.__module__, public.__name__, public.__qualname__ = __name__, name, name
            return public
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
