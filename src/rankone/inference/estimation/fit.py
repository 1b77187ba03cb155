"""A fit: best values, intervals, what the data identify, and reasons not to trust it."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy

from rankone.inference.estimation.findings import findings_of, residual_checks
from rankone.inference.estimation.intervals import Intervals
from rankone.support.labelled import Labelled, Table, Variables
from rankone.support.wording import count, listing, quote
from rankone.tensors.bases.distributions import Distribution
from rankone.tensors.bases.joint_distribution import Known


@dataclass(frozen=True, repr=False)
class Fit(Intervals, Labelled):
    """Parameters from data: best values, intervals, and whether to believe them.

    Attributes
    ----------
    level : float
        Default level of intervals.
    converged : bool
        Whether the search converged.
    stuck : bool
        Whether it ended where the likelihood jumps: an event passes a time of the data there.
    kinked : bool
        Whether it ended at a kink of the likelihood: rates switch at a time of the data there.
    dof : float
        Degrees of freedom: number of data less that of directions of the parameters that were
        fitted to them. Priors make it fractional: what they say is not fitted.
    others : tuple of dict of str to float
        Other minima that the data do not exclude at the level.
    jumps : tuple of Jump
        Parameters in whose intervals an event passes a time of the data, and that time.
    sizes : tuple of dict of str to float
        For each experiment the largest values of the observed states over the box.
    held : dict of str to float
        Parameters that the data do not determine and that the solution holds at a value, as around
        the optimum of a calibration: all intervals are conditional on them.
    """

    @cached_property
    def findings(self) -> tuple[str, ...]:
        """Reasons not to trust the fit, a sentence each."""
        return tuple(findings_of(self))

    @property
    def success(self) -> bool:
        """Whether there are no :attr:`findings`."""
        return not self.findings

    @property
    def message(self) -> str:
        """The findings in one text, or that there are none."""
        return "; ".join(self.findings) or "the fit converged, and nothing speaks against it"

    @cached_property
    def checks(self) -> tuple[str, ...]:
        """What is worth knowing and no reason to distrust the fit, a sentence each.

        Most are about the residuals, see the guide to fits.
        """
        predicted = [row.predicted for row in self._rows]
        rows = self.trials, self.standardised, predicted, self._spare
        sentences = [*residual_checks(*rows, self.unit_known)]
        levels = {name for trial in self.trials for name in trial.observations.levels}
        for name in levels & set(self.fixed):
            if self.fixed[name] == 0.0:
                sentences.append(f"{quote(name)} is zero: the data show no such part of the noise")
        for time in sorted({jump.time for jump in self.jumps if self.converged}):
            names = listing(jump.parameter for jump in self.jumps if jump.time == time)
            sentences.append(
                f"an event passes the time {time:.6g} of the data inside the intervals of {names}; "
                "standard deviations and bands are rough there"
            )
        return tuple(sentences)

    @cached_property
    def known(self) -> Known:
        """The distribution of the parameters, which statistics take: ``solution.mean(under=fit)``.

        Estimates are normal in the coordinates of the search, with the covariance there.
        """
        free = self._problem.free
        root = self._identification.root
        deviations = np.linalg.norm(root, axis=1)
        distributions: dict[str, Distribution] = {}
        fixed = dict(self.fixed)
        for j, name in enumerate(self.parameters):
            x = self.x[name]
            if not deviations[j] > 0.0:
                fixed[name] = x
            elif free.logarithmic[j]:
                spread = deviations[j] * free.logarithms[j]
                distributions[name] = scipy.stats.lognorm(spread, scale=x)
            else:
                distributions[name] = scipy.stats.norm(x, deviations[j] * free.width[j])
        moving = [j for j, name in enumerate(self.parameters) if name in distributions]
        pairs = itertools.combinations(moving, 2)
        correlation = {
            (self.parameters[i], self.parameters[j]): float(
                root[i] @ root[j] / (deviations[i] * deviations[j])
            )
            for i, j in pairs
        }
        several = []
        for name in dict.fromkeys(itertools.chain(*(trial.fixed for trial in self.trials))):
            values = {trial.fixed.get(name) for trial in self.trials}
            if len(values) > 1 or any(trial.doses is not None for trial in self.trials):
                several.append(name)
            else:
                fixed[name] = self.trials[0].fixed[name]
        return Known(distributions, correlation, fixed, tuple(several))

    # --- display -------------------------------------------------------------------------------

    def _table(self) -> Table:
        """The estimates, a line each, and whether to believe them."""
        noise = f"chi2 {self.chi2:.4g}"
        if not self.unit_known:
            noise = f"sigma {self.sigma:.4g} estimated"
        elif self.noise_levels:
            noise = f"log-likelihood {self.log_likelihood:.4g}"
        of = f"{count(self.size, 'value')} of {', '.join(self.observed)}"
        if len(self.trials) > 1:
            of += f" in {len(self.trials)} experiments"
        rows = []
        for name, (low, high) in self.interval().items():
            cells = [f"{self.x[name]:.6g}", f"[{low:.6g}, {high:.6g}]", self.limits[name]]
            rows.append([name, *(cells if self.identifiable[name] else ["not identified", "", ""])])
        for name in self.combinations:
            low, high = self.interval_of(name)
            rows.append([name, f"{self.value_of(name):.6g}", f"[{low:.6g}, {high:.6g}]", ""])
        header = ["parameter", "estimate", f"{100 * self.level:g} % interval", "limited by"]
        if not any(row[-1] for row in rows):
            header, rows = header[:-1], [row[:-1] for row in rows]
        verdict = f"{'success' if self.success else 'no success'}: {self.message}"
        return Table(
            f"Fit to {of}: {noise}, {self.dof:.4g} degrees of freedom",
            header,
            rows,
            [verdict, *(f"note: {check}" for check in self.checks)],
        )

    def _variables(self) -> Variables:
        """Estimates with deviations and intervals, and the covariance."""
        low, high = np.array(list(self.interval().values())).T
        columns = {
            "estimate": np.array(list(self.x.values())),
            "std": np.array(list(self.std.values())),
            "lower": low,
            "upper": high,
            "identified": np.array(list(self.identifiable.values())),
            "limits": np.array(list(self.limits.values()), dtype=object),
        }
        arrays = {name: (("parameter",), column) for name, column in columns.items()}
        names = list(self.parameters)
        return Variables(
            {**arrays, "covariance": (("parameter", "other"), self.covariance)},
            {"parameter": names, "other": names},
        )
