"""The classic method on the reference problems, its history and its failures."""

from __future__ import annotations

from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

import rankone as ro
from examples import kirchhoff
from rankone import Status
from rankone.solvers.engines.engine_options import GreedyOptions
from rankone.solvers.engines.greedy_engine import GreedySlabRecord
from rankone.solvers.outcome import Outcome
from rankone.solvers.verification.reference import integrate_reference
from rankone.support.errors import OptionError
from tests.problems import REFERENCE
from tests.solvers.engines.greedy_support import solve


def until(problem: ro.Problem, end: float) -> ro.Problem:
    """The same problem on a shorter horizon."""
    t, start, _ = problem.time
    return ro.Problem(problem.equations, (t, start, end), problem.parameters, problem.initial)


PROBLEMS = {
    "decay": (REFERENCE["decay"](), 1e-6),
    "linear": (REFERENCE["linear"](), 1e-8),
    "free fall": (REFERENCE["free_fall"](), 1e-4),
    "coupled": (REFERENCE["coupled"](), 1e-3),
    "Lotka-Volterra": (until(REFERENCE["lotka_volterra"](), 1.0), 1e-3),
    "Kirchhoff": (kirchhoff.motion(0.25), 1e-2),
}


@cache
def solved(name: str) -> Outcome:
    """The outcome for one of the problems without options, checked at many points."""
    problem, rtol = PROBLEMS[name]
    return solve(problem, rtol, check=256)


def values(outcome: Outcome, times: np.ndarray, points: np.ndarray) -> np.ndarray:
    """States at every time (T,) and point (m, d): (n, m, T)."""
    slabs = outcome.slabs
    result = np.empty((slabs[0].cores[0].shape[0], len(points), times.size))
    for k, t in enumerate(times):
        slab = next(slab for slab in slabs if t <= slab.end + 1e-12)
        result[:, :, k] = slab(np.full(len(points), t), points.T)
    return result


@cache
def trajectories(name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """SciPy at 256 random points and 21 times: states (n, m, T), times (T,), points (m, d)."""
    system = ro.compile(PROBLEMS[name][0]).system
    box = np.array(system.box)
    points = box[:, 0] + (box[:, 1] - box[:, 0]) * np.random.default_rng(77).random((256, len(box)))
    times = np.linspace(*system.horizon, 21)
    return integrate_reference(system, points, system.horizon, 1e-11)(times), times, points


def relative(gap: np.ndarray, exact: np.ndarray) -> float:
    """Largest gap, each state relative to its largest value."""
    return float((np.abs(gap).max(axis=(1, 2)) / np.abs(exact).max(axis=(1, 2))).max())


@pytest.mark.parametrize("name", PROBLEMS)
def test_without_options_the_tolerance_is_met(name: str) -> None:
    rtol, outcome = PROBLEMS[name][1], solved(name)
    assert outcome.status is Status.CONVERGED
    exact, times, points = trajectories(name)
    assert relative(values(outcome, times, points) - exact, exact) <= rtol


@pytest.mark.parametrize("name", PROBLEMS)
def test_agreement_with_train_and_scipy_within_the_stated_errors(name: str) -> None:
    """At other points than those the errors are stated from, without any factor.

    A solution states two errors: the largest over a sample of interior points, and at corners of
    the box. In the six dimensions of Kirchhoff's problem another sample of 256 points may exceed
    the first by a few per cent, never both.
    """
    problem, rtol = PROBLEMS[name]
    greedy = solved(name)
    train = ro.compile(problem).solve(rtol=0.1 * rtol, check=256).outcome
    assert greedy.measured is not None
    assert train.measured is not None
    exact, times, points = trajectories(name)
    stated, stated_by_train = (
        max(*measured.interior, *measured.corners) for measured in (greedy.measured, train.measured)
    )
    by_greedy, by_train = (values(outcome, times, points) for outcome in (greedy, train))
    assert relative(by_greedy - exact, exact) <= stated
    assert relative(by_greedy - by_train, exact) <= stated + stated_by_train


@pytest.mark.parametrize("elements", ["linear", "quadratic"])
def test_finite_elements_give_one_slab_for_each_element(elements: Any) -> None:
    options = {"elements": elements, "time_nodes": 21, "parameter_nodes": 21}
    outcome = solve(REFERENCE["decay"](), 0.1, time_slabs=1, **options)
    assert len(outcome.slabs) == (20 if elements == "linear" else 10)
    assert outcome.status is Status.CONVERGED
    for left, right in pairwise(outcome.slabs):
        assert left.end == right.start
        k = np.array([[0.7, 2.0, 4.9]])
        t = np.full(3, left.end)
        assert left(t, k) == pytest.approx(right(t, k), abs=1e-3)


# --- history -----------------------------------------------------------------------------------


@pytest.mark.parametrize("formulation", ["derivative", "volterra"])
@pytest.mark.parametrize("update", ["amplitudes", "time", "all"])
def test_minimal_residuals_fall_with_every_mode(formulation: str, update: str) -> None:
    outcome = solve(
        REFERENCE["decay"](),
        1e-4,
        preset="slides",
        elements="legendre",
        projection="minimal-residual",
        formulation=formulation,
        update=update,
        time_nodes=14,
        parameter_nodes=14,
    )
    (record,) = outcome.history
    assert isinstance(record, GreedySlabRecord)
    residuals = [mode.residual for mode in record.equations[0].modes]
    assert len(residuals) >= 5
    assert all(b <= a * (1 + 1e-10) for a, b in pairwise(residuals))
    assert residuals[-1] < 1e-2 * residuals[0]


def test_residuals_of_the_identity_fall_with_every_mode() -> None:
    """The Volterra form without own terms is a best approximation."""
    outcome = solved("coupled")
    for record in outcome.history:
        assert isinstance(record, GreedySlabRecord)
        for equation in record.equations:
            residuals = [mode.residual for mode in equation.modes]
            assert all(b <= a * (1 + 1e-6) for a, b in pairwise(residuals))


def test_the_history_holds_every_loop() -> None:
    outcome = solved("coupled")
    record = outcome.history[0]
    assert isinstance(record, GreedySlabRecord)
    assert {equation.state for equation in record.equations} == {"u1", "u2", "u3"}
    assert len(record.equations) == 3 * len(record.residuals)
    last = record.equations[-1]
    assert len(last.amplitudes) == record.ranks[2]
    assert list(last.amplitudes) == sorted(last.amplitudes, reverse=True)
    assert record.residuals[-1] < 1e-2 * record.residuals[0]
    first = record.equations[0].modes[0]
    assert first.differences
    assert first.amplitude > 0


def test_a_triangular_system_is_not_lagged() -> None:
    """Each equation is solved once in a slab: it takes only from equations before it."""
    problem = ro.Problem.from_strings(
        rhs={"u": "-k*u", "v": "k*u - m*v", "w": "m*v - w"},
        initial={"u": "1", "v": "0", "w": "0"},
        parameters={"k": (1, 2), "m": (1, 2)},
        time=(0, 1),
    )
    outcome = solve(problem, 1e-2)
    record = outcome.history[0]
    assert isinstance(record, GreedySlabRecord)
    assert len(record.equations) == 3
    assert outcome.error <= 5e-2


@pytest.mark.slow
def test_solves_are_reproducible() -> None:
    first, second = solved("coupled"), solved.__wrapped__("coupled")
    for a, b in zip(first.slabs, second.slabs, strict=True):
        assert all(np.array_equal(x, y) for x, y in zip(a.cores, b.cores, strict=True))
    assert first.history == second.history


# --- failures ----------------------------------------------------------------------------------


def test_divergence_is_said() -> None:
    """Lagged terms on one slab over two periods of Lotka-Volterra cannot settle."""
    outcome = solve(REFERENCE["lotka_volterra"](), 1e-3, preset="slides")
    assert outcome.status is Status.NO_CONVERGENCE
    assert "did not settle" in outcome.message
    assert outcome.history
    assert outcome.history[-1].residuals[-1] > 1
    assert not outcome.slabs


def test_iterations_that_do_not_suffice_are_said() -> None:
    outcome = solve(REFERENCE["coupled"](), 1e-4, time_slabs=1, max_iterations=2)
    assert outcome.status is Status.NO_CONVERGENCE
    assert outcome.measured is not None
    assert "measured error" in outcome.message


def test_too_few_modes_are_said() -> None:
    outcome = solve(REFERENCE["decay"](), 1e-6, max_modes=2)
    assert outcome.status is Status.RANK_LIMIT
    assert "max_modes" in outcome.message


def test_too_few_nodes_are_said() -> None:
    nodes = {"time_nodes": 21, "parameter_nodes": 21}
    outcome = solve(REFERENCE["decay"](), 1e-5, elements="linear", **nodes)
    assert outcome.status is Status.TOLERANCE
    assert "use more nodes" in outcome.message


def test_without_a_check_nothing_is_claimed() -> None:
    outcome = solve(REFERENCE["decay"](), 1e-3, check=0)
    assert outcome.status is Status.UNCHECKED
    assert outcome.measured is None


def test_a_blow_up_is_found() -> None:
    """v = 1 + k (u - 1), and so the first pole, that of k = 2, is at ln 2."""
    problem = ro.Problem.from_strings(
        rhs={"u": "u*v", "v": "k*u*v"},
        initial={"u": "1", "v": "1"},
        parameters={"k": (1, 2)},
        time=(0, 1.2),
    )
    outcome = solve(problem, 1e-2)
    assert outcome.status is Status.BLOW_UP
    assert outcome.blow_up is not None
    assert outcome.blow_up == (pytest.approx(np.log(2), rel=1e-5), (2.0,))


@pytest.mark.parametrize(
    "wrong",
    [
        {"formulation": "strong"},
        {"weak_form": "volterra"},
        {"elements": "quadratic", "time_nodes": 10},
        {"parameter_nodes": 1},
        {"parameter_nodes": 5.0},
        {"parameter_nodes": (5, "6")},
        {"max_modes": 0},
        {"max_modes": 2.5},
        {"max_modes": "abc"},
        {"max_iterations": None},
        {"tolerance": 2.0},
        {"tolerance": float("nan")},
        {"fixed_point_tolerance": "x"},
        {"time_slabs": 0},
        {"time_slabs": 1.5},
        {"cls": 1},
        {"nodes": 7},
        {"preset": "book"},
    ],
    ids=str,
)
def test_wrong_options(wrong: dict[str, Any]) -> None:
    with pytest.raises(OptionError):
        GreedyOptions.of(**wrong)


def test_numbers_of_other_kinds() -> None:
    options = GreedyOptions.of(
        max_modes=np.int64(7), tolerance=np.float32(0.5), parameter_nodes=[3]
    )
    assert (type(options.max_modes), options.max_modes) == (int, 7)
    assert (type(options.tolerance), options.tolerance) == (float, 0.5)
    assert options.parameter_nodes == (3,)


def test_nodes_for_another_number_of_parameters() -> None:
    with pytest.raises(OptionError, match="2 entries for 1 parameters"):
        solve(REFERENCE["decay"](), 1e-3, parameter_nodes=(5, 5))


def test_a_problem_without_parameters() -> None:
    import sympy as sp

    t = sp.Symbol("t")
    u = sp.Function("u")(t)
    problem = ro.Problem([sp.Eq(u.diff(t), u * (1 - u))], (t, 0, 2), {}, {u: sp.Rational(1, 4)})
    outcome = solve(problem, 1e-6)
    assert outcome.status is Status.CONVERGED
    exact = 1 / (1 + 3 * np.exp(-2.0))
    assert outcome.slabs[-1](np.array([2.0]), np.zeros((0, 1)))[0, 0] == pytest.approx(exact, 1e-5)


def test_solutions_that_vanish() -> None:
    problem = ro.Problem.from_strings(
        rhs={"u": "-k*u + v", "v": "0", "w": "-w"},
        initial={"u": "0", "v": "0", "w": "k"},
        parameters={"k": (1, 2)},
        time=(0, 1),
    )
    solution = ro.solve(problem, rtol=1e-3, method="greedy")
    assert solution.success, solution.message
    np.testing.assert_allclose(solution(t=0.5, k=1.5)[:2], 0.0, atol=1e-30)
    zero = ro.Problem.from_strings({"u": "-k*u"}, {"u": "0"}, {"k": (1, 2)}, (0, 1))
    np.testing.assert_array_equal(ro.solve(zero, method="greedy")(t=0.5, k=1.5), 0.0)
