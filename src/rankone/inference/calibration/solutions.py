"""Solutions of a calibration problem over a box, which are fitted and have posteriors."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy

from rankone.inference.calibration.records import (
    Free,
    Interval,
    Parameter,
    Records,
    Settings,
    SimulatedExperiment,
    check_solvable,
    joined,
    measured,
    problem_for,
)
from rankone.inference.estimation.experiments import Experiment
from rankone.inference.estimation.fit import Fit
from rankone.inference.estimation.formulas import formula_of
from rankone.inference.estimation.posterior import Posterior, posterior_of
from rankone.inference.estimation.search import fit_experiments
from rankone.problem.models.model import LARGEST_SPREAD
from rankone.problem.problem import Problem
from rankone.solution.compiled import compile_problem
from rankone.solution.solution import Solution
from rankone.support.arrays import Table, html_of
from rankone.support.errors import (
    OptionError,
    ProblemError,
    count,
    did_you_mean,
    listing,
    quote,
    shown,
    text_table,
)
from rankone.support.options import checked_number
from rankone.tensors.coordinates import name_of


@dataclass(frozen=True, eq=False, repr=False)
class CalibrationSolutions:
    """Solutions of the experiments of a calibration problem over a box.

    Made by :meth:`CalibrationProblem.solve`.

    Attributes
    ----------
    solutions : dict of str to Solution
        By the names of the experiments, ``"condition"`` or ``"before -> condition"``; one solution
        may serve all of them.
    experiments : dict of str to Experiment
        What was measured in each.
    bounds : dict of str to tuple
        Intervals of the parameters that observables and noise have, which no solution has.
    priors : dict of str to distribution
        Of the free parameters, from the table; uniform on the scale of the parameter where it has
        none.
    penalties : dict of str to distribution
        Densities of the values that are proportional to what the objective has of the priors of the
        table; None where no distribution is.
    """

    solutions: dict[str, Solution]
    experiments: dict[str, Experiment]
    bounds: dict[str, tuple[float | str, ...]]
    priors: dict[str, Any]
    penalties: dict[str, Any] = field(default_factory=dict)

    @property
    def success(self) -> bool:
        """Whether each is within its tolerance."""
        return all(solution.success for solution in self.solutions.values())

    @property
    def error(self) -> float:
        """The largest of the measured errors."""
        return max(solution.error for solution in self.solutions.values())

    def fit(self, **options: Any) -> Fit:
        """The most likely parameters inside the box, with the priors of the table.

        Options are those of :func:`rankone.fit`; a ``prior=`` replaces one of the table. Levels of
        noise are corrected for the degrees of freedom, as there.

        Raises
        ------
        ProblemError
            If the table has Laplace's prior of a logarithm.
        """
        pairs = [(self.solutions[name], each) for name, each in self.experiments.items()]
        fixed = {name_of(key) for key in options.get("fixed") or {}}
        bounds = {name: ends for name, ends in self.bounds.items() if name not in fixed}
        bounds |= options.pop("bounds", None) or {}
        own = {name_of(key): each for key, each in (options.pop("prior", None) or {}).items()}
        prior = {n: each for n, each in self.penalties.items() if n not in fixed} | own
        for name, each in prior.items():
            if each is None:
                raise ProblemError(
                    f"the prior of {quote(name)} is Laplace's of its logarithm, which fits of "
                    "solutions do not have",
                    term=name,
                    remedy=f"give another one, prior={{{name!r}: ...}}, or use problem.fit()",
                )
        return fit_experiments(pairs, bounds=bounds, prior=prior or None, **options)

    def posterior(self, prior: Mapping[str, Any] | None = None, **options: Any) -> Posterior:
        """The distribution of the parameters in the box after the data are known.

        Parameters
        ----------
        prior
            As for :meth:`Solution.posterior`; priors that are not given are those of the table.
        **options
            Those of :func:`rankone.posterior`.
        """
        priors = {**self.priors, **(prior or {})}
        others = {name: self.priors[name] for name, each in self.penalties.items() if each is None}
        return posterior_of(self.fit(prior=others), priors, **options)

    def _table(self) -> Table:
        different = {id(solution) for solution in self.solutions.values()}
        rows = [
            [name, ", ".join(solution.parameters), f"{solution.error:.2g}",
             "yes" if solution.success else "no"]
            for name, solution in self.solutions.items()
        ]  # fmt: skip
        summary = (
            f"CalibrationSolutions: {count(len(different), 'solution')} for "
            f"{count(len(self.solutions), 'experiment')}"
        )
        return Table(summary, ["experiment", "free", "error", "success"], rows)

    def __repr__(self) -> str:
        summary, header, rows, *_ = self._table()
        return text_table(summary, header, rows)

    def _repr_html_(self) -> str:
        return html_of(self._table())


# -----------------------------------------------------------------------------
# Solves a calibration problem over a box: one solution an experiment, or one for all.


_MOST_FREE = 10  # Parameters of a box that nobody named: with more no solve ends in hours


def free_of(
    records: Records,
    active: Sequence[str],
    values: Mapping[str, float],
    given: object,
    spread: object,
) -> Free:
    """What is free: a box of ``active`` parameters, given or around values, and all outer ones."""
    parameters = {p.name: p for p in records.parameters}
    outer = {p.name for p in records.parameters if p.estimated and p.name not in active}
    return Free(box_of(parameters, active, values, given, spread), frozenset(outer), values)


def box_of(
    parameters: Mapping[str, Parameter],
    active: Sequence[str],
    values: Mapping[str, float],
    given: object,
    spread: object,
) -> dict[str, Interval]:
    """The intervals of the free parameters, with their scales."""
    names: Any = [n for n in active if parameters[n].estimated] if given is None else given
    if isinstance(names, str) or not isinstance(names, Mapping | list | tuple):
        raise OptionError(
            f"box is {shown(given)}, neither a mapping nor a list of names",
            term=given,
            remedy='write {"k1": (0.5, 2)}, or ["k1"]',
        )
    if given is None and len(names) > _MOST_FREE:
        raise OptionError(
            f"{count(len(names), 'estimated parameter')} are in rates or initial values: "
            f"one box has at most {_MOST_FREE} unless you name more",
            remedy="solve around the end of a fit, solve(around=problem.fit()), or name the free "
            f'parameters, box=["{names[0]}", "{names[1]}"]: the others keep their values',
        )
    box: dict[str, Interval] = {}
    for name in names:
        if name not in active:
            unused = f"{quote(name)} is in no rate and no initial value"
            unknown = f"there is no parameter {quote(name)}{did_you_mean(str(name), active)}"
            raise OptionError(
                f"box: {unused if name in parameters else unknown}",
                term=name,
                remedy=f"choose from {listing(active)}",
            )
        if isinstance(names, Mapping):
            box[name] = _interval(name, names[name])
        else:
            box[name] = _around(values[name], spread)
        if len(box[name]) == 2 and parameters[name].scale != "lin":
            box[name] = (*box[name], "log")
    return box


def _around(value: float, spread: object) -> Interval:
    """The interval from a value over the spread to the value times the spread."""
    factor = checked_number("spread", spread, 1.0, LARGEST_SPREAD, float)
    lower, upper = sorted((value / factor, value * factor))
    return lower, upper


def _interval(name: str, given: object) -> Interval:
    """An interval of a box as a tuple."""
    if not isinstance(given, list | tuple):
        raise OptionError(
            f"box: {quote(name)} has {shown(given)}, which is no interval",
            term=name,
            remedy=f'write {{"{name}": (0.5, 2)}}; fixed values are values={{"{name}": 1.0}}',
        )
    return tuple(given)


def experiment_of(records: Records, name: object) -> SimulatedExperiment:
    """The experiment of a name, or the only one."""
    by_name = {each.name: each for each in records.experiments}
    if name is None and len(by_name) == 1:
        return records.experiments[0]
    if name not in by_name:
        what = "an experiment has to be chosen" if name is None else (
            f"there is no experiment {quote(name)}{did_you_mean(str(name), by_name)}"
        )  # fmt: skip
        raise OptionError(what, term=name, remedy=f"choose from {listing(by_name)}")
    return by_name[str(name)]


def end_of(records: Records, experiment: SimulatedExperiment) -> float:
    """The last finite time of a measurement in an experiment, or else in all of them."""
    position = records.experiments.index(experiment)
    times = np.concatenate([s.times[s.experiments == position] for s in records.series])
    return float(times[np.isfinite(times)].max(initial=0.0)) or records.last_time or 1.0


def problem_of(records: Records, settings: Settings, name: object, free: Free) -> Problem:
    """The problem of one experiment."""
    experiment = experiment_of(records, name)
    return problem_for(records, settings, experiment, free, end_of(records, experiment))


def solved(
    records: Records, settings: Settings, free: Free, rtol: float, options: Mapping[str, Any]
) -> CalibrationSolutions:
    """Solutions of all experiments."""
    check_solvable(records)
    together = joined(settings, records.experiments, free)
    experiments = {
        each.name: measured(records, settings, k, together or free).experiment
        for k, each in enumerate(records.experiments)
    }
    if together is not None:
        first = records.experiments[0]
        problem = problem_for(records, settings, first, together, records.last_time or 1.0)
        solutions = dict.fromkeys(experiments, compile_problem(problem).solve(rtol, **options))
    else:
        problems = {
            each.name: problem_for(records, settings, each, free, end_of(records, each))
            for each in records.experiments
        }
        solutions = {
            name: compile_problem(problem).solve(rtol, **options)
            for name, problem in problems.items()
        }
    outer = [p for p in records.parameters if p.name in free.outer & _names(experiments.values())]
    bounds: dict[str, Interval] = {
        p.name: (p.lower, p.upper) if p.scale == "lin" else (p.lower, p.upper, "log") for p in outer
    }
    named = {name for solution in solutions.values() for name in solution.parameters}
    listed = {
        p.name: p.prior
        for p in records.parameters
        if p.prior is not None and (p.name in named or p.name in bounds)
    }
    priors = {p.name: _usual_prior(p) for p in outer}
    priors |= {name: prior.distribution() for name, prior in listed.items()}
    penalties = {name: prior.penalty() for name, prior in listed.items()}
    return CalibrationSolutions(solutions, experiments, bounds, priors, penalties)


def _names(experiments: Iterable[Any]) -> set[str]:
    """All names in what was measured, and in its noise."""
    texts = [text for e in experiments for text in (*e.observe.values(), *e.sigma.values())]
    return {name for text in texts for name in formula_of(text).names}


def _usual_prior(parameter: Parameter) -> Any:
    """Uniform between the bounds, on the scale of the parameter."""
    lower, upper = parameter.lower, parameter.upper
    if parameter.scale == "lin":
        return scipy.stats.uniform(lower, upper - lower)
    return scipy.stats.loguniform(max(lower, math.ulp(0.0)), upper)
