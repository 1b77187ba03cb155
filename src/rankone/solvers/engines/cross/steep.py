"""Why an interpolation does not converge, and how many nodes its worst points need.

The modes of a train are means over the box and over time. Where a front is met in one corner
alone, or at the end of the horizon, the errors there are a hundred times the tails of these means,
and nodes that follow the means come too late. On a line through such a point the largest mode of a
state at any time tells the error at that point.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from rankone.solvers.engines.cross.cross_options import TUNING
from rankone.solvers.request import Domain
from rankone.support.arrays import Array
from rankone.support.budget import OutOfBudgetError
from rankone.tensors.bases import Basis1D
from rankone.tensors.trains.adaptive import LinePoints, needed
from rankone.trajectories.system.system import System
from rankone.trajectories.system.verdict import SteepParameter


@dataclass(frozen=True)
class WorstLines:
    """What lines through the worst points tell of the bases of an attempt.

    ``nodes`` are those that each parameter needs, and ``missed`` is the largest sum of modes that
    an attempt left out, in units of the sizes of states.
    """

    nodes: tuple[int, ...]
    missed: float

    def explain(self, error: float) -> bool:
        """Whether too few nodes are the reason of an error."""
        return self.missed > TUNING.explaining_share * error


@dataclass(frozen=True)
class LineLimits:
    """The most nodes of a line, and the most trajectories on all of them after the first ones."""

    nodes: int
    trajectories: float


def worst_lines(
    trajectories: Callable[[Array], Array],
    domain: Domain,
    bases: Sequence[Basis1D],
    points: Array,
    rtol: float,
    limits: LineLimits,
) -> WorstLines:
    """Draw lines of each parameter through points (m, d) of the box.

    The trajectories at points (k, d) are in units of the sizes of states: (n, T, k). Lines that
    their nodes do not resolve are drawn again with more, as far as the limits allow. Parameters
    with several elements keep their bases: these are halved where they do not suffice.
    """
    drawn = {
        j: replace(basis, degree=math.ceil(TUNING.line_node_ratio * basis.size))
        for j, basis in enumerate(bases)
        if basis.elements == 1
    }
    nodes, missed, most = [basis.size for basis in bases], 0.0, limits.trajectories
    lines = LinePoints(domain.box, domain.first_coordinates, through=points)
    while drawn and most >= 0.0:
        counts = [len(points) * basis.size for basis in drawn.values()]
        states = trajectories(lines([(j, basis.nodes) for j, basis in drawn.items()]))
        on_each = np.split(states, np.cumsum(counts)[:-1], axis=2)
        finer = dict[int, Basis1D]()
        for (j, basis), on_lines in zip(drawn.items(), on_each, strict=True):
            modes = (on_lines.reshape(-1, basis.size) * np.sqrt(basis.weights)) @ basis.to_modal.T
            tails = np.cumsum(np.abs(modes).max(axis=0)[::-1])[::-1]
            missed = max(missed, float(tails[bases[j].size]))
            small = np.flatnonzero(tails <= TUNING.known_functions_share * rtol)
            if small.size > 1:
                nodes[j] = int(small[0])
                continue
            nodes[j] = needed(tails, TUNING.known_functions_share * rtol)
            if basis.size < limits.nodes:
                degree = min(max(TUNING.more_nodes * basis.size, nodes[j]), limits.nodes)
                finer[j] = replace(basis, degree=degree)
        most -= len(points) * sum(basis.size for basis in finer.values())
        drawn = finer
    return WorstLines(tuple(nodes), missed)


# -----------------------------------------------------------------------------
# Why an interpolation does not converge: a parameter on which the solution depends steeply.


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
    zooms: int = TUNING.max_zooms,
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

    places, coarse = changes(start, end, TUNING.line_places)
    for times in (slice(-1, None), slice(None)):
        for i in np.argsort(-coarse[:, times].max(axis=(0, 1)))[:zooms]:
            a, b, change = places[i], places[i + 1], coarse[:, times, i]
            if not change.max() >= TUNING.front_change:
                break
            while b - a > TUNING.jump_width * width:
                closer, fine = changes(a, b, TUNING.zoom_places)
                k = int(fine[:, times].max(axis=(0, 1)).argmax())
                if not fine[:, times, k].max() >= TUNING.kept_change * change.max():
                    break
                a, b, change = closer[k], closer[k + 1], fine[:, times, k]
            if b - a < TUNING.front_width * width:
                lower, upper = np.clip(scale.from_scale(np.array([a, b])), *box).tolist()
                yield (
                    (b - a) / width,
                    SteepParameter(
                        parameter=system.parameters[j],
                        unknown=system.states[int(change.max(axis=1).argmax())],
                        lower=lower,
                        upper=upper,
                        change=float(change.max()),
                        jump=bool((b - a) / width <= TUNING.jump_width),
                        at_end=change.shape[1] == 1,
                        others=fixed,
                    ),
                )
