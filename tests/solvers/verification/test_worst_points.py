"""The residual finds what random trajectories miss."""

from dataclasses import replace

import numpy as np
import pytest

import rankone as ro
from rankone.solvers.request import Check, Domain, SolveRequest
from rankone.solvers.verification.measure import measure
from rankone.solvers.verification.reference_set import ReferenceSet
from rankone.solvers.verification.worst_points import worst_points


@pytest.fixture(scope="module")
def decay():
    problem = ro.Problem.from_strings(
        {"x": "-a*x + b"}, {"x": "1"}, {"a": (1, 2), "b": (0, 1)}, (0, 1)
    )
    compiled = ro.compile(problem)
    solution = compiled.solve(1e-6, method="cross")
    reference_set = ReferenceSet.of(
        compiled.system, SolveRequest(1e-6, Domain.of(compiled.system), Check(24))
    )
    return compiled.system, solution.outcome, reference_set


def test_a_good_solution_has_none(decay):
    _, outcome, reference_set = decay
    assert worst_points(reference_set, outcome.slabs, outcome.error / 1e-6, 1e-6, 0) is None


def test_where_the_equations_do_not_hold(decay):
    """A solution of other equations in a corner, which no check point touches."""
    system, outcome, reference_set = decay

    def rhs(t, u, p):
        corner = (np.asarray(p[0]) > 1.9) & (np.asarray(p[1]) > 0.9)
        touched = (np.asarray(p[0])[..., None] == reference_set.reference.points[:, 0]).any(axis=-1)
        return system.rhs(t, u, p) + 1e-3 * (corner & ~touched)

    wrong = replace(reference_set, system=replace(system, rhs=rhs))
    points = worst_points(wrong, outcome.slabs, 0.5, 1e-6, 0)
    assert len(points) >= 3
    assert (points > [1.9, 0.9]).all()


@pytest.mark.parametrize(
    ("rate", "initial", "end", "rtol"),
    [
        ("-30*a*b*c*d*x", "1", 1, 1e-6),
        ("10*a*b*c*d - x**3", "0", 1, 1e-4),
        ("0.717*(x**2 + a)*a*b*c*d", "a", 0.9, 1e-4),
    ],
)
def test_products_of_parameters_are_right_near_the_corner(rate, initial, end, rtol):
    box = dict.fromkeys("abcd", (0, 1))
    compiled = ro.compile(ro.Problem.from_strings({"x": rate}, {"x": initial}, box, (0, end)))
    solution = compiled.solve(rtol)
    assert solution.success
    points = np.random.default_rng(8).random((500, 4))
    stricter = ReferenceSet.of(
        compiled.system, SolveRequest(1e-3 * rtol, Domain.of(compiled.system), Check(24))
    )
    measured = measure(stricter.with_points(points), solution.outcome.slabs)
    assert max(measured.interior) <= 5 * rtol
