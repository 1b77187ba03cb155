"""Solutions of a calibration problem over a box, which are fitted and have posteriors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from rankone.inference.estimation.experiments import Experiment
from rankone.inference.estimation.fit import Fit
from rankone.inference.estimation.posterior import Posterior, posterior_of
from rankone.inference.estimation.search import fit_experiments
from rankone.solution.solution import Solution
from rankone.support.errors import ProblemError
from rankone.support.labelled import Table, html_of
from rankone.support.wording import count, quote, text_table
from rankone.tensors.bases.coordinates import name_of


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
