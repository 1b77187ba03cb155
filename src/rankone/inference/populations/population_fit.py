"""A fit of a population: estimates, and whether to believe them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rankone.inference.estimation import results
from rankone.inference.estimation.experiments import failure_of
from rankone.inference.populations import predictive_check as _check
from rankone.inference.populations.population_estimates import PopulationEstimates
from rankone.support.errors import with_remedy
from rankone.support.labelled import Table, Variables
from rankone.support.wording import count, listing, quote

_MOST_NAMED = 4  # Subjects that a message names
# Standard deviations of the random effects that a box should hold to either side
_BOX_SPREADS = 3.0
_HIGH_SHRINKAGE = 0.3  # Above it the estimates of subjects say little of the population


@dataclass(frozen=True, repr=False)
class PopulationFit(PopulationEstimates, results.Judged):
    """Means and variances of a population from data of several subjects.

    Attributes
    ----------
    level : float
        Default level of intervals.
    idle : tuple of str
        Standard deviations, of random effects or of noise, that the data show to be zero.
    """

    predictive_check = _check.predictive_check

    @cached_property
    def findings(self) -> tuple[str, ...]:
        """Reasons not to trust the fit, a sentence each."""
        return tuple(self._findings())

    def _findings(self) -> Iterator[str]:
        if not self.solution.success:
            yield failure_of(self.solution)
        if not self.converged:
            yield with_remedy("the search did not converge", "give a start, or fewer parameters")
        yield from self._at_ends()
        yield from self._not_identified()
        yield from self._error_of_solution()

    def _at_ends(self) -> Iterator[str]:
        """Parameters whose estimates are at an end of the box, for some subjects."""
        ends = self._search.at_ends(self._psi, self._optimum.individuals.eta[0])
        for e, name in enumerate(self.parameters):
            for side, word in ((-1, "lower"), (1, "upper")):
                at = np.flatnonzero(ends[:, e] == side)
                if not at.size:
                    continue
                end = self.solution.parameters[name][max(side, 0)]
                where = ""
                if e in self._layout.random:
                    names = [self.subjects[i] for i in at[:_MOST_NAMED]]
                    more = f" and {at.size - len(names)} more" if at.size > len(names) else ""
                    noun = "subject" if at.size == 1 else "subjects"
                    where = f" of {noun} {', '.join(names)}{more}"
                low, high = self._suggested_box(e)
                yield with_remedy(
                    f"{quote(name)}{where} is at the {word} end of the box, {end:.4g}: means and "
                    "variances are not valid",
                    f"solve on a wider box, such as {name} in ({low:.3g}, {high:.3g})",
                )

    def _suggested_box(self, e: int) -> tuple[float, float]:
        """A box that holds the box so far and the random effects with room to spare."""
        box = self.solution.parameters[self.parameters[e]]
        scale = self._layout.scales[e]
        middle = self._layout.typical(self._psi[None])[0][:, e]
        ends = np.array([self._search.lower[e], self._search.upper[e]])
        room = 0.25 * (ends[1] - ends[0])
        if e in self._layout.random:
            q = self._layout.random.index(e)
            room = max(room, 4.0 * math.sqrt(self.omega[q, q]))
        low, high = scale.value(np.array([middle.min() - room, middle.max() + room]))
        return min(float(low), box[0]), max(float(high), box[1])

    def _not_identified(self) -> Iterator[str]:
        unseen = [name for name, identified in self.identifiable.items() if not identified]
        if not unseen:
            return
        yield with_remedy(
            f"the data do not identify {listing(unseen)}", "fix some, or measure more"
        )

    def _error_of_solution(self) -> Iterator[str]:
        """Where the error of the solution is not small beside the noise."""
        if not self.solution.success:
            return
        moved = self.predicted(self.individuals, self.solution.errors)
        for (one, prediction, sigma), (_, shifted, _) in zip(
            self.predicted(self.individuals), moved, strict=True
        ):
            error = np.abs(shifted - prediction)[one.present]
            noise = sigma[one.present]
            if one.noise.distribution == "log-normal":
                noise = noise * np.abs(prediction[one.present])
            yield from results.error_beside_noise(one.name, error, noise)

    @cached_property
    def checks(self) -> tuple[str, ...]:
        """What is worth knowing and no reason to distrust the fit, a sentence each."""
        return tuple(self._checks())

    def _checks(self) -> Iterator[str]:
        for name in self.idle:
            of = "noise" if name in self._layout.zero_levels else "variation between subjects"
            yield f"{quote(name)} is zero: the data show no such {of}"
        for q, e in enumerate(self._layout.random):
            reach = _BOX_SPREADS * math.sqrt(self.omega[q, q])
            middle = self._layout.typical(self._psi[None])[0][:, e]
            inside = self._search.lower[e] <= middle.min() - reach
            if not (inside and middle.max() + reach <= self._search.upper[e]):
                low, high = self._suggested_box(e)
                yield (
                    f"the box does not hold {_BOX_SPREADS:g} standard deviations of "
                    f"{quote(self.parameters[e])}: simulations need ({low:.3g}, {high:.3g})"
                )
        weak = {n: s for n, s in self.shrinkage.items() if n in self.random and s > _HIGH_SHRINKAGE}
        for name, share in weak.items():
            yield (
                f"the shrinkage of {quote(name)} is {100 * share:.0f} %: estimates of single "
                "subjects are drawn to the mean"
            )

    # --- display -------------------------------------------------------------------------------

    def _table(self) -> Table:
        """The estimates, a line each, and whether to believe them."""
        observed = ", ".join(one.name for one in self._subjects.measured)
        rows = []
        for name, (low, high) in self.interval().items():
            shrunk = self.shrinkage.get(name.removeprefix("omega_")) if "omega_" in name else None
            identified = self.identifiable[name] and not math.isnan(low)
            rows.append(
                [
                    name,
                    f"{self.x[name]:.5g}",
                    f"{self.std[name]:.3g}" if identified else "",
                    f"[{low:.5g}, {high:.5g}]" if identified else "",
                    "" if shrunk is None else f"{100 * shrunk:.0f} %",
                ]
            )
            if not self.identifiable[name]:
                rows[-1][1:4] = ["not identified", "", ""]
        return Table(
            f"Population of {count(len(self.subjects), 'subject')}: {count(self.size, 'value')} of "
            f"{observed}, log-likelihood {self.log_likelihood:.5g}",
            ["parameter", "estimate", "std error", f"{100 * self.level:g} % interval", "shrinkage"],
            rows,
            self._remarks,
        )

    def _variables(self) -> Variables:
        """Estimates with errors and intervals."""
        intervals = self.interval()
        low, high = np.array(list(intervals.values())).T
        columns = {
            "estimate": [self.x[name] for name in intervals],
            "std": [self.std[name] for name in intervals],
            "lower": low,
            "upper": high,
            "identified": [self.identifiable[name] for name in intervals],
        }
        return results.by_parameter(columns, list(intervals))
