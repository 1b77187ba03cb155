"""Visual predictive checks: quantiles of data beside those of data simulated from a fit.

Data sets with the subjects, times, doses and covariates of the data are drawn from the fitted
population. Where the model is right, quantiles of the data lie in the bands of simulated ones
(Holford, PAGE 14, 2005; with corrected predictions: Bergstrand et al., AAPS J. 13, 2011).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rankone.inference.estimation.intervals import checked_level
from rankone.inference.estimation.noise import noise_draws
from rankone.inference.populations.individuals import EmpiricalBayes
from rankone.inference.populations.population_estimates import PopulationEstimates
from rankone.inference.populations.subjects import Measured
from rankone.support.arrays import MOST_ROUNDS, Array, Labelled, Table, Variables
from rankone.support.errors import OptionError, with_remedy
from rankone.support.options import LEVEL, checked_count, checked_number

_MOST_BINS = 10
_MOST_OUTSIDE = 0.2  # Largest share of subjects that may be outside of the box
_NOTED_OUTSIDE = 0.005  # Share above which it is said


@dataclass(frozen=True, repr=False)
class PredictiveCheck(Labelled):
    """Quantiles of the data of an observable in bins of time, and bands of simulated ones.

    Attributes
    ----------
    observable : str
        What was measured.
    times : ndarray (bins,)
        The median time of the data in each bin.
    counts : ndarray (bins,)
        Number of data in each bin.
    quantiles : tuple of float
        The probabilities of the quantiles.
    observed : ndarray (quantiles, bins)
        Quantiles of the data.
    simulated : ndarray (quantiles, 3, bins)
        Lower end, median and upper end of the quantiles of simulated data sets.
    level : float
        Probability of the bands.
    outside : float
        Share of simulated subjects that were outside of the box of the solution and drawn again.
    data : tuple of ndarray
        Times and values of the data (with corrected predictions, if so asked), in rows.
    corrected : bool
        Whether data were divided by their prediction for a subject without random effect.
    """

    observable: str
    times: Array
    counts: NDArray[np.intp]
    quantiles: tuple[float, ...]
    observed: Array
    simulated: Array
    level: float
    outside: float
    data: tuple[Array, Array]
    corrected: bool
    solution: Any = None

    @property
    def inside(self) -> NDArray[np.bool_]:
        """Which quantiles of the data (quantiles, bins) lie in their bands."""
        return np.asarray(
            (self.simulated[:, 0] <= self.observed) & (self.observed <= self.simulated[:, 2])
        )

    @property
    def message(self) -> str:
        """How many quantiles lie in their bands."""
        inside = self.inside
        text = f"{int(inside.sum())} of {inside.size} quantiles lie in their bands"
        if self.outside > _NOTED_OUTSIDE:
            text += (
                f"; {100 * self.outside:.1f} % of simulated subjects were outside of the box of "
                "the solution and drawn again"
            )
        return text

    def _table(self) -> Table:
        percent = [f"{100 * q:g} %" for q in self.quantiles]
        rows = [
            [f"{self.times[b]:.4g}", str(self.counts[b])]
            + [
                f"{self.observed[q, b]:.4g} [{self.simulated[q, 0, b]:.4g}, "
                f"{self.simulated[q, 2, b]:.4g}]"
                for q in range(len(percent))
            ]
            for b in range(self.times.size)
        ]
        return Table(
            f"Predictive check of {self.observable}: quantiles and {100 * self.level:g} % bands of "
            "simulated ones",
            ["time", "data", *percent],
            rows,
            [self.message],
        )

    def _variables(self) -> Variables:
        axes = ("quantile", "bin")
        arrays = {
            "observed": (axes, self.observed),
            **{
                name: (axes, self.simulated[:, k])
                for k, name in enumerate(("lower", "median", "upper"))
            },
        }
        return Variables(arrays, {"quantile": list(self.quantiles), "bin": list(self.times)})


def predictive_check(
    self: PopulationEstimates,
    observable: object = None,
    *,
    count: int = 400,
    quantiles: Sequence[float] = (0.05, 0.5, 0.95),
    bins: int | Sequence[float] | None = None,
    corrected: bool = False,
    level: float = LEVEL,
    seed: int = 0,
) -> PredictiveCheck:
    """Compare quantiles of the data with those of data simulated from the fit.

    Parameters
    ----------
    observable : name or symbol, optional
        What to compare; the only or first observable if left out.
    count : int
        Number of simulated data sets.
    quantiles : sequence of float
        Probabilities of the quantiles.
    bins : int or sequence of float, optional
        Number of bins of time with about as many data each, or the borders of them. By default
        each time is a bin, or ten bins where there are more times.
    corrected : bool
        Whether to correct data and simulations for differences of doses and covariates in a bin:
        each is multiplied by the median prediction of its bin over its own.
    level : float
        Probability of the bands.
    seed : int
        Seed of the simulation.

    Raises
    ------
    OptionError
        If there is no such observable, an option is out of its range, or more than a fifth of the
        simulated subjects are outside of the box of the solution.
    """
    level = checked_level(level)
    probabilities = tuple(checked_level(q) for q in quantiles)
    sets = checked_count("count", count, 2, self.size)
    index = [one.name for one in self._subjects.measured].index(self.measured(observable).name)
    generator = np.random.default_rng(checked_number("seed", seed, 0))
    parameters, outside = simulated_subjects(self, sets, generator)
    one, prediction, sigma = list(self.predicted(parameters))[index]
    drawn = noise_draws(one.noise, prediction, sigma, generator)
    owner = _bins(one, bins)
    data = one.data
    if corrected:
        factor = _corrections(self, index, owner)
        drawn, data = drawn * factor, data * factor
    observed, ends = _quantiles(one, owner, data, drawn, probabilities, level)
    numbers = np.array([np.count_nonzero(owner == b) for b in range(owner.max() + 1)])
    times = [np.median(one.times[owner == b]) for b in range(owner.max() + 1)]
    return PredictiveCheck(
        one.name,
        np.array(times),
        numbers,
        probabilities,
        observed,
        ends,
        level,
        outside,
        (one.times[one.present], data[one.present]),
        corrected,
        self.solution,
    )


def simulated_subjects(
    fit: PopulationEstimates, count: int, generator: np.random.Generator
) -> tuple[dict[str, Array], float]:
    """Parameters (count, n) of simulated subjects by name, with the covariates of the real ones.

    Subjects outside of the box of the solution are drawn again; their share is the second.
    """
    search: EmpiricalBayes = fit._search
    layout = search.layout
    random = list(layout.random)
    factor = layout.cholesky(fit._psi[None])[0]
    typical = layout.typical(fit._psi[None])
    places = np.repeat(typical, count, axis=0)
    waiting = np.ones(places.shape[:2], dtype=bool)
    drawn = outside = 0
    for _ in range(MOST_ROUNDS):
        draws = generator.standard_normal((int(waiting.sum()), len(random))) @ factor.T
        fresh = np.broadcast_to(typical, places.shape)[waiting]
        fresh[:, random] += draws
        places[waiting] = fresh
        inside = ((fresh >= search.lower) & (fresh <= search.upper))[:, random].all(axis=1)
        drawn += inside.size
        outside += int(np.count_nonzero(~inside))
        waiting[waiting] = ~inside
        if not waiting.any():
            break
    if waiting.any() or outside > _MOST_OUTSIDE * drawn:
        raise OptionError(
            with_remedy(
                f"{100 * outside / drawn:.0f} % of simulated subjects are outside of the box of "
                "the solution",
                "solve on a wider box; the notes of the fit say on which",
            )
        )
    values = layout.values(np.clip(places, search.lower, search.upper))
    parameters = {name: values[..., e] for e, name in enumerate(layout.names)}
    return parameters, outside / drawn


def _bins(one: Measured, bins: int | Sequence[float] | None) -> NDArray[np.intp]:
    """The bin (n, m) of each datum; -1 where data are missing."""
    times = one.times[one.present]
    distinct = np.unique(times)
    if bins is None and distinct.size <= _MOST_BINS:
        borders = 0.5 * (distinct[1:] + distinct[:-1])
    elif bins is None or isinstance(bins, int):
        most = checked_number("bins", _MOST_BINS if bins is None else bins, 1, times.size)
        borders = np.unique(np.quantile(times, np.arange(1, most) / most))
    else:
        borders = np.sort(np.asarray(bins, dtype=float))
    owner = np.where(one.present, np.searchsorted(borders, one.times, side="right"), -1)
    occupied = np.unique(owner[one.present])
    renumbered = np.searchsorted(occupied, owner)
    return np.where(one.present, renumbered, -1)


def _corrections(fit: PopulationEstimates, index: int, owner: NDArray[np.intp]) -> Array:
    """Factors (n, m) that make up for differences of predictions within a bin."""
    one, prediction, _ = list(fit.predicted(fit.typical))[index]
    factor = np.ones(prediction.shape)
    for b in range(owner.max() + 1):
        here = owner == b
        own = prediction[here]
        factor[here] = np.divide(np.median(own), own, out=np.ones(own.shape), where=own != 0.0)
    return np.where(one.present, factor, 1.0)


def _quantiles(
    one: Measured,
    owner: NDArray[np.intp],
    data: Array,
    drawn: Array,
    probabilities: Sequence[float],
    level: float,
) -> tuple[Array, Array]:
    """Quantiles of the data (q, bins), and lower end, median and upper end (q, 3, bins)."""
    size = owner.max() + 1
    observed = np.empty((len(probabilities), size))
    ends = np.empty((len(probabilities), 3, size))
    shares = [0.5 - 0.5 * level, 0.5, 0.5 + 0.5 * level]
    for b in range(size):
        here = owner == b
        observed[:, b] = np.quantile(data[here], probabilities)
        each = np.quantile(drawn[:, here], probabilities, axis=1)
        ends[:, :, b] = np.quantile(each, shares, axis=1).T
    return observed, ends
