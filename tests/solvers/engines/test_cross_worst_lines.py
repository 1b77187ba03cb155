"""Lines through the worst points of an attempt tell the nodes that are missing there."""

import numpy as np
import pytest

import rankone as ro
from rankone.solvers.engines.cross_samples import LineLimits, worst_lines
from rankone.solvers.request import Domain
from rankone.tensors import ChebyshevBasis

BOX = ((0.0, 1.0), (0.0, 1.0))
CORNER = np.array([[1.0, 1.0]])
DOMAIN = Domain((0.0, 1.0), BOX)
ONCE, OFTEN = LineLimits(1000, 0.0), LineLimits(1000, 1e4)


def front(points):
    """A state that is smooth but for a front at the last of 50 times, in the corner (1, 1)."""
    x, y = points.T
    states = np.repeat(0.1 * np.sin(x + y)[None, None], 50, axis=1)
    states[:, -1] += np.tanh(12.0 * (x + y - 1.9))
    return states


def bases(*sizes: int) -> list[ChebyshevBasis]:
    return [ChebyshevBasis(*interval, size) for interval, size in zip(BOX, sizes, strict=True)]


def interpolation_error(size: int) -> float:
    """Of the front on the line through the corner along x, by that many nodes."""
    basis, places = ChebyshevBasis(0.0, 1.0, size), np.linspace(0.0, 1.0, 401)
    at = [front(np.column_stack([x, np.ones_like(x)]))[0, -1] for x in (basis.nodes, places)]
    modes = basis.to_modal @ (np.sqrt(basis.weights) * at[0])
    return float(np.abs(basis.modal_values(places) @ modes - at[1]).max())


@pytest.mark.parametrize("size", [10, 16, 24])
def test_what_an_attempt_missed_is_about_the_error_at_its_worst_point(size):
    lines = worst_lines(front, DOMAIN, bases(size, size), CORNER, 1e-4, ONCE)
    error = interpolation_error(size)
    assert 0.3 * error < lines.missed < 5.0 * error
    assert lines.explain(error)
    assert not lines.explain(100.0 * error)


def test_the_nodes_are_those_that_the_front_needs():
    lines = worst_lines(front, DOMAIN, bases(50, 50), CORNER, 1e-4, ONCE)
    assert lines.nodes[0] == lines.nodes[1]
    assert interpolation_error(lines.nodes[0]) < 1e-4
    assert interpolation_error(lines.nodes[0] - 18) > 1e-4


def test_lines_are_drawn_again_until_their_nodes_resolve_them():
    coarse = bases(8, 8)
    lines = worst_lines(front, DOMAIN, coarse, CORNER, 1e-4, OFTEN)
    assert interpolation_error(lines.nodes[0]) < 1e-4
    assert interpolation_error(lines.nodes[0] - 18) > 1e-4
    once = worst_lines(front, DOMAIN, coarse, CORNER, 1e-4, ONCE)
    assert max(once.nodes) < lines.nodes[0]


def test_smooth_places_need_few_nodes():
    centre = np.array([[0.2, 0.2]])
    lines = worst_lines(front, DOMAIN, bases(30, 30), centre, 1e-4, ONCE)
    assert max(lines.nodes) < 15
    assert lines.missed < 1e-6


def test_bases_of_several_elements_are_kept():
    several = [ChebyshevBasis(0.0, 1.0, 5, breaks=(0.5,)), ChebyshevBasis(0.0, 1.0, 5)]
    lines = worst_lines(front, DOMAIN, several, CORNER, 1e-4, ONCE)
    assert lines.nodes[0] == several[0].size
    assert lines.nodes[1] > 10


def test_a_front_in_a_corner_is_resolved_by_the_second_attempt():
    """An enzyme uses its substrate up just before the end where two constants are at their ends."""
    problem = ro.Problem.from_strings(
        {"s": "-k*e*s/(0.02 + s)", "e": "-0.1*f*e"},
        {"s": "1", "e": "1"},
        {"k": (0.05, 0.155), "f": (0.5, 1.5)},
        (0, 10),
    )
    solution = ro.solve(problem, rtol=1e-5, method="cross")
    assert solution.success
    first, second = (record.nodes for record in solution.history)
    assert min(b - a for a, b in zip(first, second, strict=True)) > 5
