"""Branches whose errors count: those that hold somewhere in the box, however small the part."""

from types import SimpleNamespace

from rankone.solution.outputs.branch_outputs import _held_somewhere
from rankone.solvers.request import Domain


def test_a_branch_that_holds_in_a_thousandth_of_the_box_counts():
    """A third one holds nowhere, and only leads to the others."""
    evaluator = SimpleNamespace(
        decided=lambda points: SimpleNamespace(chosen=2 * (points[0] > 0.999).astype(int))
    )
    domain = Domain((0.0, 1.0), ((0.0, 1.0), (0.0, 1.0)))
    assert _held_somewhere(evaluator, domain) == [0, 2]
