"""Fronts that trajectories meet once, each at its own time and many of them after the horizon."""

import numpy as np
import pytest

import rankone as ro
from rankone.solvers.request import Domain
from rankone.solvers.stretches_by_markers import pilots
from rankone.trajectories.events.markers import late_front
from rankone.trajectories.integrators.integrator import Spans
from rankone.trajectories.integrators.integrator_choice import span_integrator_for
from rankone.trajectories.system.features import Ending

RATES = {"x": "0.5*s/(ks + s + s**2/ki)*x", "s": "-s/(ks + s + s**2/ki)*x"}
BOX = {"ks": (0.05, 5.0), "ki": (2.0, 200.0), "x0": (1e-3, 0.1)}
FLAT = {"ks": (0.4, 0.6), "ki": (90.0, 110.0), "x0": (0.04, 0.05)}


def found(rates, box, end):
    """The late front of a culture that grows from x0 on a substrate of 10."""
    problem = ro.Problem.from_strings(rates, {"x": "x0", "s": "10"}, box, (0, end))
    system = ro.compile(problem).system
    domain = Domain((0.0, end), tuple(box.values()))
    points, tolerances = pilots(system, domain, 1e-4)
    integrator = span_integrator_for(system, "auto")
    states = system.initial(np.ascontiguousarray(points.T))
    spans = Spans(np.zeros(len(points)), states, np.full(len(points), end))
    paths = integrator.paths(system, points, spans, tolerances)
    return late_front(system, points, paths, domain.horizon, integrator, tolerances)


@pytest.mark.slow
def test_a_front_over_decades_ends_the_first_stretch():
    marker, order = found(RATES, BOX, 30.0)
    assert order.ending is Ending.LENGTH
    assert order.instants == ((0,),)
    assert 15.0 < order.length < 30.0  # as long as the first one needs behind its front
    low = marker.level < 2.0 if marker.state == 1 else marker.level > 4.0
    assert low  # the food is nearly used up


@pytest.mark.parametrize(
    ("rates", "box", "end"),
    [
        (RATES, FLAT, 30.0),  # all meet it before the end
        (RATES, BOX, 2.0),  # none meets it before
        ({**RATES, "x": f"{RATES['x']} - 0.2*x"}, BOX, 30.0),  # some die out before
    ],
)
def test_where_not_some_meet_it_before_and_all_others_later_there_is_none(rates, box, end):
    assert found(rates, box, end) is None
