"""Why an interpolation does not converge: a parameter on which the solution depends steeply."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress

import numpy as np

from rankone.ir.request import Domain
from rankone.ir.system import System
from rankone.ir.verdict import SteepParameter
from rankone.solvers.cross import constants
from rankone.support.arrays import Array
from rankone.support.budget import OutOfBudgetError


def steepest_front(
    trajectories: Callable[[Array], Array],
    system: System,
    domain: Domain,
    points: Sequence[Array],
) -> SteepParameter | None:
    """The narrowest front on lines through points (d,) of the box; None if there is none.

    Through each point goes one line for each parameter, up to the first jump that is still there
    at the end of the horizon. The trajectories at points (m, d) are in units of the states' sizes:
    shape (n, T, m).
    """
    fronts: list[tuple[float, SteepParameter]] = []
    with suppress(OutOfBudgetError):  # the fronts so far say it as well
        for point, j in itertools.product(points, range(len(domain.box))):
            for width, front in _on_line(trajectories, system, domain, point, j):
                if front.jump and front.at_end:
                    return front
                fronts.append((width, front))
    narrowest = min(
        fronts, key=lambda pair: (pair[0], not pair[1].at_end, -pair[1].change), default=None
    )
    return narrowest and narrowest[1]


def first_jump(
    trajectories: Callable[[Array], Array],
    system: System,
    domain: Domain,
    points: Sequence[Array],
    parameters: Sequence[int],
) -> SteepParameter | None:
    """The first jump on lines of some parameters through points (d,); None if there is none.

    The trajectories are as those of :func:`steepest_front`.
    """
    for point, j in itertools.product(points, parameters):
        for _, front in _on_line(trajectories, system, domain, point, j, zooms=1):
            if front.jump:
                return front
    return None


def _on_line(
    trajectories: Callable[[Array], Array],
    system: System,
    domain: Domain,
    point: Array,
    j: int,
    zooms: int = constants.MAX_ZOOMS,
) -> Iterator[tuple[float, SteepParameter]]:
    """Relative widths and fronts on the line through a point along parameter j.

    First fronts that differ at the end of the horizon, then those that differ at any time, of each
    the ``zooms`` pairs of places that differ most. Widths are those in the coordinate in which the
    parameter is looked at first.
    """
    scale, box = domain.first_coordinates[j], domain.box[j]
    start, end = scale.to_scale(np.array(box)).tolist()
    width = end - start
    pairs = list(zip(system.parameters, point.tolist(), strict=True))
    fixed = (*pairs[:j], *pairs[j + 1 :])

    def changes(a: float, b: float, count: int) -> tuple[Array, Array]:
        """Places, and changes (n, T, count - 1) between them."""
        places = np.linspace(a, b, count)
        line = np.tile(point, (count, 1))
        line[:, j] = np.clip(scale.from_scale(places), *box)
        return places, np.abs(np.diff(trajectories(line), axis=2))

    places, coarse = changes(start, end, constants.LINE_PLACES)
    for times in (slice(-1, None), slice(None)):
        for i in np.argsort(-coarse[:, times].max(axis=(0, 1)))[:zooms]:
            a, b, change = places[i], places[i + 1], coarse[:, times, i]
            if not change.max() >= constants.FRONT_CHANGE:
                break
            while b - a > constants.JUMP_WIDTH * width:
                closer, fine = changes(a, b, constants.ZOOM_PLACES)
                k = int(fine[:, times].max(axis=(0, 1)).argmax())
                if not fine[:, times, k].max() >= constants.KEPT_CHANGE * change.max():
                    break
                a, b, change = closer[k], closer[k + 1], fine[:, times, k]
            if b - a < constants.FRONT_WIDTH * width:
                lower, upper = np.clip(scale.from_scale(np.array([a, b])), *box).tolist()
                yield (
                    (b - a) / width,
                    SteepParameter(
                        parameter=system.parameters[j],
                        unknown=system.states[int(change.max(axis=1).argmax())],
                        lower=lower,
                        upper=upper,
                        change=float(change.max()),
                        jump=bool((b - a) / width <= constants.JUMP_WIDTH),
                        at_end=change.shape[1] == 1,
                        others=fixed,
                    ),
                )
