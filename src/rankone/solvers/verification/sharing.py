"""One reference set for all attempts of a solve: engines that follow each other take the same."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace

from rankone.solvers.request import SolveRequest
from rankone.solvers.verification.reference_set import ReferenceSet
from rankone.support.arrays import Array
from rankone.trajectories.integrators.workers import Workers
from rankone.trajectories.system.system import System


@dataclass
class _Kept:
    """The last reference set that was made, and what it was made for."""

    system: System | None = None
    request: SolveRequest | None = None
    reference_set: ReferenceSet | None = None


_KEPT: ContextVar[_Kept | None] = ContextVar("rankone_reference", default=None)


@contextmanager
def sharing_references() -> Iterator[None]:
    """Keep the last reference set of :func:`reference_set_of` for those inside that ask again."""
    token = _KEPT.set(_Kept())
    try:
        yield
    finally:
        _KEPT.reset(token)


def reference_set_of(
    system: System, request: SolveRequest, lines: Array | None, workers: Workers
) -> ReferenceSet:
    """The reference set of a system and a request: see :meth:`ReferenceSet.of`.

    One that was made for the same before is taken again, without its trajectories on ``lines``
    (m, d) where nobody asks for them. Nothing is kept where a user limits the memory.
    """
    kept, count = _KEPT.get(), 0 if lines is None else len(lines)
    if kept is None or request.limits.memory < math.inf:
        return ReferenceSet.of(system, request, lines, workers)
    reference_set = kept.reference_set
    if reference_set is not None and kept.system is system and kept.request is request:
        if count == reference_set.on_lines:
            return replace(reference_set, workers=workers)
        if not count and reference_set.reference.blown is None:
            return replace(reference_set.without_lines(), workers=workers)
    kept.reference_set = None  # two are not held at once
    made = ReferenceSet.of(system, request, lines, workers)
    kept.system, kept.request, kept.reference_set = system, request, made
    return made
