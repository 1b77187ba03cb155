"""Whether the spread of an unknown is above the error of the solution."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rankone.support.arrays import Array
from rankone.support.wording import quote

__all__ = ["Certainty"]

_ROUNDING = 1e-13
"""Error of values, relative to the largest, where none is measured."""
_CLEAR = 5.0
"""Spread over error from which the error hardly changes shares of the variance."""


@dataclass(frozen=True)
class Certainty:
    """Standard deviations of the unknowns beside the errors of the solution.

    Attributes
    ----------
    unknowns : tuple of str
    times : ndarray (times,)
        None of them where nothing depends on time.
    start : float
        Start of the horizon.
    spread : ndarray (unknowns, times) or (unknowns,)
        Standard deviations over the box.
    sizes : ndarray (unknowns,)
        Largest values of the unknowns.
    errors : ndarray (unknowns,)
        Measured errors relative to the sizes; not finite where none was measured.
    """

    unknowns: tuple[str, ...]
    times: Array
    start: float
    spread: Array
    sizes: Array
    errors: Array

    @property
    def error(self) -> Array:
        """Absolute errors, (unknowns,): at least those of rounding."""
        relative = np.where(np.isfinite(self.errors), self.errors, 0.0)
        return np.asarray(self.sizes * np.maximum(relative, _ROUNDING))

    @property
    def defined(self) -> NDArray[np.bool_]:
        """Where the spread is above the error, in the shape of the spread."""
        return np.asarray(self._rows(self.spread) > self.error[:, None]).reshape(self.spread.shape)

    @property
    def message(self) -> str | None:
        """A warning about shares of the variance that are not defined or not certain."""
        sentences = list(self._sentences())
        if not sentences:
            return None
        remedy = "solve with a smaller rtol if it should vary there"
        return f"{'; '.join(sentences)}; remedy: {remedy}"

    def _sentences(self) -> Iterator[str]:
        """For each unknown what is wrong with its shares.

        The start of the horizon is left out, where most initial values are numbers, and so is an
        unknown that does not vary at all.
        """
        later = self.times > self.start if self.times.size else np.ones(1, dtype=bool)
        for name, spread, size, error in zip(
            self.unknowns, self._rows(self.spread), self.sizes, self.error, strict=True
        ):
            varies = later & (spread > _ROUNDING * size)
            hidden = varies & (spread <= error)
            vague = varies & (spread > error) & (spread < _CLEAR * error)
            if hidden.any():
                yield (
                    f"the Sobol indices of {quote(name)} are NaN{self._when(hidden)}: its spread "
                    f"over the box, {spread[hidden].max():.2g}, is below the error of the "
                    f"solution, {error:.2g}"
                )
            if vague.any():
                yield (
                    f"the Sobol indices of {quote(name)} are uncertain{self._when(vague)}: its "
                    f"spread over the box is {spread[vague].min():.2g}, and the error of the "
                    f"solution {error:.2g}"
                )

    def _when(self, chosen: NDArray[np.bool_]) -> str:
        """The times chosen, by their ends."""
        if not self.times.size:
            return ""
        times = self.times[chosen]
        if times.size == 1:
            return f" at t = {times[0]:.4g}"
        return f" at {times.size} times between t = {times.min():.4g} and {times.max():.4g}"

    def _rows(self, values: Array) -> Array:
        """Values with an axis of times, of length one where nothing depends on time."""
        return values.reshape(len(self.unknowns), -1)
