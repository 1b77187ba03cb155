"""Nothing narrow between the steps of trajectories is part of a success."""

import numpy as np
import pytest
import sympy as sp

import rankone as ro
from rankone.solvers import attempts
from rankone.trajectories.system.verdict import HiddenRate, Status

HIDDEN = {
    "gap": "1e9*Z**2/(exp(Z) + exp(-Z) - 1)",
    "flat": "1e9*exp(-1/Z**2 - Z**2)",
    "reciprocal": "1e6*exp(-1e12*(x/k + k/x - 2))",
}
"""Rates with a peak of width 1e-9 and area one at x = k, by Z = (x - k)/1e-9."""


def solved(rate, start="1", rtol=1e-3, **options):
    rates = {"x": "1", "y": f"{rate} - y/10".replace("Z", "((x - k)*1e9)")}
    problem = ro.Problem.from_strings(
        rates, {"x": "0.01", "y": start}, {"k": (0.8, 1.2)}, (0, 3), **options
    )
    return ro.solve(problem, rtol, effort=0.3)


@pytest.mark.parametrize("rate", HIDDEN.values(), ids=HIDDEN)
def test_hidden_peaks_are_no_success(rate):
    try:
        solution = solved(rate)
    except ro.ConvergenceError:  # a blow-up, or steps that shrink without end
        return
    sure = np.exp(-0.29) + np.exp(-0.1 * (2.91 - 1.01))  # if it is solved, the area counts
    assert not solution.success or solution(t=2.9, k=1.01)[1] > 0.5 * sure + 0.4


def test_no_success_where_the_limit_leaves_no_look(monkeypatch):
    assert solved("exp(-x)").success
    monkeypatch.setattr(attempts, "EXPLANATION_OPERATIONS", 1e3)
    solution = solved("exp(-x)")
    assert solution.status is ro.Status.WORK_LIMIT
    assert solution.error < 1e-3


def test_the_message_says_where():
    solution = solved(HIDDEN["flat"])
    assert solution.status is Status.NARROW
    cause = solution.outcome.cause
    assert isinstance(cause, HiddenRate)
    assert cause.state == "y"
    assert cause.time == pytest.approx(dict(cause.at)["k"] - 0.01, abs=1e-6)
    assert "the rate of `y` is so narrow near t = " in solution.message
    assert "steps pass over it" in solution.message


def test_peaks_that_change_nothing_are_no_matter():
    """The state itself runs through the peak in no time."""
    rate = "1 + 1e6*exp(-1/Z**2 - Z**2)".replace("Z", "((x - k)*1e9)")
    problem = ro.Problem.from_strings({"x": rate}, {"x": "0.01"}, {"k": (0.8, 1.2)}, (0, 3))
    solution = ro.solve(problem, 1e-3)
    assert solution.success
    assert solution(t=2.0, k=1.0)[0] == pytest.approx(2.01, abs=1e-4)


def test_singularities_that_can_be_removed_hide_nothing():
    solution = solved("sin(3*(x - k))/(x - k)")
    assert solution.success


def test_stretches_between_events_are_looked_at():
    rate = HIDDEN["flat"].replace("Z", "((x - k)*1e9)")
    problem = ro.Problem.from_strings(
        {"x": "1", "y": f"{rate} - y/10"},
        {"x": "0.01", "y": "1"},
        {"k": (0.8, 1.2)},
        (0, 3),
        events=[{"when": "x - 2*k", "direction": "rising", "then": {"y": "y + 1"}, "name": "dose"}],
    )
    solution = ro.solve(problem, 1e-3, effort=0.3)
    assert solution.status is Status.NARROW


@pytest.mark.parametrize("narrow", [True, False])
def test_branches_of_the_timeline_are_looked_at(narrow):
    hidden = HIDDEN["flat"].replace("Z", "((x - k)*1e9)")
    problem = ro.Problem.from_strings(
        {"x": "k", "y": f"1 + {hidden if narrow else 'exp(-x**2)'}"},
        {"x": 0.2, "y": 0},
        {"k": (0.8, 1.2)},
        (0, 2),
        events=[
            {"when": "y - 0.6", "direction": "rising", "then": {"y": "y + 0.1"}, "name": "dose"},
            {"when": "x - 0.8", "direction": "rising", "then": {"y": "y/2"}, "name": "wash"},
        ],
    )
    solution = ro.solve(problem, 1e-4)
    assert len(solution.timeline.branches) == 2
    assert solution.status is (Status.NARROW if narrow else Status.CONVERGED)


def test_hidden_peaks_of_outputs_are_no_success():
    problem = ro.Problem.from_strings({"x": "1"}, {"x": "0.01"}, {"k": (0.8, 1.2)}, (0, 3))
    peak = "exp(-1e12*(x/k + k/x - 2))"
    solution = ro.solve(problem, 1e-3, outputs={"q": f"1 + {peak}"}, effort=0.3)
    assert not solution.success
    wide = ro.solve(problem, 1e-3, outputs={"q": f"1 + {peak.replace('1e12', '1')}"})
    assert wide.success


FLAT = "exp(-1/Z**2 - Z**2)"


def test_harmless_peaks_hide_none_that_matters():
    """Those in the rate of `x` surprise most, on all trajectories."""
    harmless = "1 + 1e12*" + FLAT.replace("Z", "((x - 0.5)*1e9)")
    matters = "1e9*" + FLAT.replace("Z", "((x - k)*1e9)")
    rates = {"x": harmless, "y": f"{matters} - y/10"}
    problem = ro.Problem.from_strings(rates, {"x": "0.01", "y": "1"}, {"k": (0.8, 1.2)}, (0, 3))
    solution = ro.solve(problem, 1e-3, effort=0.3)
    assert solution.status is Status.NARROW
    assert solution.outcome.cause.state == "y"


def test_wide_features_hide_no_narrow_one_at_their_middle():
    """The wide one is antisymmetric and changes nothing; so do steps that are as wide."""
    wide = "1e6*W*exp(-1/W**2 - W**2)".replace("W", "((x - k)/1e-6)")
    narrow = "1e10*" + FLAT.replace("Z", "((x - k)/1e-10)")
    assert solved(f"{wide} + {narrow}").status is Status.NARROW


@pytest.mark.parametrize("method", ["auto", "train", "greedy"])
def test_peaks_are_found_that_a_sample_hits_by_chance(method):
    peak = "1e6*exp(-1e12*((t + 1)/2.0137 + 2.0137/(t + 1) - 2))"
    problem = ro.Problem.from_strings(
        {"y": f"{peak} - k*y"}, {"y": "1"}, {"k": (0.05, 0.15)}, (0, 3)
    )
    solution = ro.solve(problem, 1e-3, effort=0.3, method=method)
    assert solution.status is Status.NARROW
    assert solution.outcome.cause.time == pytest.approx(1.0137, abs=1e-4)


def test_many_removable_singularities_hide_nothing():
    """As in rates of Hodgkin and Huxley, crossed several times by each trajectory."""
    gate = "0.1*(1 - n)*(10*v + 0.3)/(1 - exp(-(10*v + 0.3))) - n"
    rates = {"v": "k*sin(5*t) - v", "n": gate}
    problem = ro.Problem.from_strings(rates, {"v": "0", "n": "0.3"}, {"k": (0.8, 1.2)}, (0, 5))
    assert ro.solve(problem, 1e-3, effort=0.3).success


def test_powers_of_powers_hide_nothing():
    peak = "(1 - (x - k)**2)"
    for _ in range(12):
        peak = f"({peak}**8 + e)"
    problem = ro.Problem.from_strings(
        {"x": "1", "y": f"{8.0**6}*{peak} - y/10"},
        {"x": "0.1", "y": "1"},
        {"k": (0.8, 1.2), "e": (0, 1e-30)},
        (0, 1.8),
    )
    assert ro.solve(problem, 1e-3, effort=0.3).status is Status.NARROW


@pytest.mark.parametrize("function", [lambda z: sp.besselk(0, z), lambda z: sp.expint(1, z)])
def test_special_functions_hide_nothing(function):
    t, k = sp.symbols("t k")
    x, y = sp.Function("x")(t), sp.Function("y")(t)
    width = sp.Integer(10) ** -9
    peak = function(1 + ((x - k) / width) ** 2) / width
    rates = [sp.Eq(x.diff(t), 1), sp.Eq(y.diff(t), peak - y / 10)]
    starts = {x: sp.Rational(1, 100), y: 1}
    solution = ro.solve(ro.Problem(rates, (t, 0, 3), {k: (0.8, 1.2)}, starts), 1e-3, effort=0.3)
    assert solution.status is Status.NARROW


@pytest.mark.parametrize(("width", "start"), [(1e-5, 0.3), (1e-7, 0.3), (1e-4, 0.1), (1e-6, 0.1)])
def test_layers_in_which_a_state_nearly_stops_are_no_success(width, start):
    """It stays there as long as for a fifth of the way, in whatever time the steps pass over it."""
    layer = f"1/(1 + {0.1128 / width}*k*exp(-{width**-2}*(x + 1/x - 2)))"
    problem = ro.Problem.from_strings({"x": layer}, {"x": f"{start}"}, {"k": (0.5, 1.5)}, (0, 2))
    solution = ro.solve(problem, 1e-3)
    assert solution.status is Status.NARROW
    assert solution.outcome.cause.state == "x"
    assert solution.outcome.cause.time == pytest.approx(1.0 - start, abs=0.01)


@pytest.mark.parametrize(
    ("layer", "start", "rtol"),
    [
        ("1/(1 + 1e6*k*exp(-1e14*(x + 1/x - 2)))", 0.1, 1e-4),  # left steps later
        ("1/(1 + 5e5*k*exp(-1e12*(x/0.5 + 0.5/x - 2)))", 0.1, 1e-4),  # met by one sample
        ("1/(1 + 494877*k*exp(-1.229e14*(x + 1/x - 2)))", 0.05, 1e-3),  # thinner than all errors
    ],
)
def test_layers_are_no_success_whatever_steps_are_near_them(layer, start, rtol):
    problem = ro.Problem.from_strings({"x": layer}, {"x": f"{start}"}, {"k": (1, 2)}, (0, 3))
    assert ro.solve(problem, rtol).status is Status.NARROW


@pytest.mark.parametrize(
    ("rates", "start"),
    [
        ({"P": "2 + LAYER", "y": "0"}, {"P": "0.05", "y": "0"}),
        ({"P": "20 + LAYER", "y": "0"}, {"P": "0.05", "y": "0"}),
        ({"P": "LAYER - (P - y)/2", "y": "LAYER + (P - y)/2"}, {"P": "2.05", "y": "-1.95"}),
    ],
)
def test_layers_that_move_with_a_state_are_no_success(rates, start):
    """It goes on with the layer for a while, at a rate that is not much smaller than before."""
    front = "((P + y)/2)" if "LAYER" in rates["y"] else f"(P - {rates['P'][:-8]}*t)"
    layer = f"1/(1 + 2e4*k*exp(-2.5e9*({front}/0.5 + 0.5/{front} - 2)))"
    rates = {name: rate.replace("LAYER", layer) for name, rate in rates.items()}
    problem = ro.Problem.from_strings(rates, start, {"k": (0.5, 1.5)}, (0, 1.5))
    assert ro.solve(problem, 1e-3).status is Status.NARROW


def test_layers_of_which_samples_meet_both_edges_are_no_success():
    """The largest surprise is behind the middle, from where the state leaves the layer at once."""
    layer = "1/(1 + 2e4*k*exp(-2.5e9*(x/0.5 + 0.5/x - 2)))"
    rates, start = {"x": layer, "y": "-y"}, {"x": "0.05", "y": "2"}
    problem = ro.Problem.from_strings(rates, start, {"k": (0.5, 1.5)}, (0, 1.5))
    assert ro.solve(problem, 1e-3).status is Status.NARROW
