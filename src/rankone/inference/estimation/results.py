"""What fits, calibrations, posteriors, designs and populations share: a verdict, and tables."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar, Protocol

import numpy as np

from rankone.support.arrays import Array
from rankone.support.errors import with_remedy
from rankone.support.labelled import Labelled, Variables
from rankone.support.wording import quote

MODEL_SHARE = 0.5
"""Accepted shift of an estimate by the error of the solution, in its standard deviations."""


class WithVerdict(Protocol):
    """A result that says whether it is a success, and why."""

    @property
    def success(self) -> bool: ...
    @property
    def message(self) -> str: ...


def verdict(result: WithVerdict) -> str:
    """Whether to believe a result, in a line."""
    return f"{'success' if result.success else 'no success'}: {result.message}"


class Judged(Labelled):
    """A result with reasons not to trust it, and notes on what is worth knowing."""

    _done: ClassVar[str] = "the fit converged"
    _itself: ClassVar[str] = "it"

    @property
    @abstractmethod
    def findings(self) -> tuple[str, ...]:
        """Reasons not to trust it, a sentence each."""

    @property
    def odd(self) -> tuple[str, ...]:
        """Those of the :attr:`checks` about what would not happen by chance."""
        return ()

    @property
    def checks(self) -> tuple[str, ...]:
        """What is worth knowing and no reason to distrust it, a sentence each."""
        return ()

    @property
    def success(self) -> bool:
        """Whether there are no :attr:`findings`."""
        return not self.findings

    @property
    def message(self) -> str:
        """The findings in one text, or that there are none."""
        against = "the notes say what is odd"
        if not self.odd:
            against = f"nothing speaks against {self._itself}"
        return "; ".join(self.findings) or f"{self._done}, and {against}"

    @property
    def _remarks(self) -> list[str]:
        """What stands below a table."""
        return [verdict(self), *(f"note: {check}" for check in self.checks)]


def interval_text(ends: tuple[float, float]) -> str:
    """An interval in a cell."""
    return f"[{ends[0]:.6g}, {ends[1]:.6g}]"


def by_parameter(
    columns: Mapping[str, Sequence[Any] | Array],
    names: Sequence[str],
    covariance: Array | None = None,
) -> Variables:
    """Columns with an entry for each parameter, and perhaps their covariance."""
    listed = list(names)
    arrays: dict[str, tuple[tuple[str, ...], Any]] = {}
    for name, column in columns.items():
        texts = any(isinstance(each, str) for each in column)
        arrays[name] = ("parameter",), np.array(column, dtype=object if texts else None)
    if covariance is None:
        return Variables(arrays, {"parameter": listed})
    arrays["covariance"] = ("parameter", "other"), covariance
    return Variables(arrays, {"parameter": listed, "other": listed})


def error_beside_noise(name: str, error: Array, noise: Array) -> Iterator[str]:
    """A sentence where the error of a solution (m,) is not small beside the noise of data (m,)."""
    shares = np.divide(error, noise, out=np.zeros(error.size), where=noise > 0.0)
    if math.sqrt(float(np.sum(shares**2))) > MODEL_SHARE:
        yield with_remedy(
            f"the error of the solution, {float(np.median(error)):.2g} in {quote(name)}, is not "
            f"small beside the noise, {float(np.median(noise)):.2g}",
            "solve with a smaller rtol",
        )
