"""Events of fields as events of their coefficients.

Numbers that cross zero are functions of rows times modes. A reset is that of the fields themselves,
at all entries, and then projected: it happens once, where rates are evaluated many times.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from rankone.support.arrays import Array
from rankone.trajectories.fields.field_system import FieldSystem, TermSum

_NUMBERS_AT_ONCE = 2**22  # Of fields that are held at once, 32 MB


@dataclass(frozen=True, eq=False)
class ReducedEvents:
    """The events of R coefficients of fields.

    ``rows`` has for each event the rows of its arguments (k, R). Fields are ``spread`` (N, R) times
    coefficients, and coefficients ``tests`` (R, N) times fields.
    """

    fields: FieldSystem
    rows: tuple[Array, ...]
    spread: Array
    tests: Array

    @classmethod
    def of(cls, fields: FieldSystem, spread: Array, tests: Array) -> ReducedEvents:
        """Those of a system of fields; empty where it has none."""
        empty = np.zeros((0, spread.shape[1]))
        rows = [
            np.concatenate([empty, *(row @ spread for row in event.arguments)])
            for event in fields.events
        ]
        if not rows:
            return cls(fields, (), empty, empty.T)
        return cls(fields, tuple(rows), spread, tests)

    def members(self) -> dict[str, object]:
        """What a system with these events is made of, by the names of generated modules."""
        events = self.fields.events
        if not events:
            return {}
        listed = [
            (event.name, event.direction, event.terminal, event.after is not None)
            for event in events
        ]
        known = tuple(k for k, event in enumerate(events) if event.known is not None)
        affine = tuple(
            (k, event.coefficients)
            for k, event in enumerate(events)
            if event.coefficients is not None
        )
        return {
            "EVENTS": tuple(listed),
            "KNOWN_EVENTS": known,
            "AFFINE_EVENT_TIMES": affine,
            "event_heights": self.heights,
            "known_event_times": self.known_times,
            **{
                f"after_event_{k}": partial(self.reset, event.after)
                for k, event in enumerate(events)
                if event.after is not None
            },
        }

    def heights(self, t: Array, a: Array, p: Array) -> Array:
        """What crosses zero at times (m,), coefficients (R, m) and parameters (d, m)."""
        pairs = zip(self.fields.events, self.rows, strict=True)
        times = np.broadcast_to(t, np.shape(a)[1:])
        return np.array(
            [self.fields.height(event, times, list(rows @ a), p) for event, rows in pairs]
        )

    def known_times(self, p: Array) -> Array:
        """Times of the events at known times, at parameters (d, m)."""
        return self.fields.known_times(np.asarray(p, dtype=float))

    def reset(self, terms: TermSum, t: Array, a: Array, p: Array) -> Array:
        """Coefficients after an event at times (m,), from a (R, m) before it, at p (d, m)."""
        after = np.empty_like(a)
        times = np.broadcast_to(t, a.shape[1:])
        step = max(_NUMBERS_AT_ONCE // len(self.spread), 1)
        for first in range(0, a.shape[1], step):
            some = slice(first, first + step)
            values = self.fields.mapped(terms, times[some], self.spread @ a[:, some], p[:, some])
            after[:, some] = self.tests @ values
        return after
