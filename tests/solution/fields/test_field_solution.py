"""Solutions of fields compared with modes times coefficients by plain NumPy."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

import rankone as ro
from rankone.solution.fields.field_solution import FieldSolution
from rankone.trajectories.system.verdict import Status
from tests.solution.fields.small_fields import N, R, orthonormal_modes, small_fields

V = orthonormal_modes()
POINT = {"k": 1.3, "s": 0.7}


@pytest.fixture(scope="module")
def solution():
    return small_fields()


def test_all_entries_are_stacked(solution):
    a = solution.coefficients(t=0.4, **POINT)
    values = solution(t=0.4, **POINT)
    assert values.shape == (N + 1,)
    assert values == pytest.approx(np.append(V @ a[:R], a[R]), rel=1e-12)


@pytest.mark.parametrize("t", [0.3, [0.1, 0.9], np.linspace(0.0, 1.0, 6).reshape(2, 3)])
def test_values_broadcast_after_the_entries(solution, t):
    a = solution.coefficients(t=t, **POINT)
    expected = np.tensordot(V, a[:R], axes=1)
    assert solution["u"](t=t, **POINT) == pytest.approx(expected, rel=1e-12)
    assert solution(t=t, **POINT)[:N] == pytest.approx(expected, rel=1e-12)
    assert solution["w"](t=t, **POINT) == pytest.approx(a[R], rel=1e-12)
    assert np.shape(solution["w"](t=t, **POINT)) == np.shape(t)
    assert solution["u"].shape == (N,)


def test_unknowns_are_asked_for_by_symbols(solution):
    assert solution[sp.Symbol("u")].name == "u"
    assert solution.modes_of(sp.Symbol("u")) is solution.modes.modes[0]


@pytest.mark.parametrize(
    "index", [3, -1, [3, 17], slice(10, 20), np.arange(N) % 7 == 0, [[1, 2], [3, 4]], np.int64(5)]
)
@pytest.mark.parametrize("t", [0.5, [0.2, 0.5, 0.8]])
def test_entries_are_chosen_as_in_numpy(solution, index, t):
    every = solution["u"](t=t, **POINT)
    chosen = solution["u"][index](t=t, **POINT)
    assert np.shape(chosen) == np.shape(every[index])
    assert chosen == pytest.approx(every[index], rel=1e-12)


def test_entries_of_entries(solution):
    view = solution["u"].entries([3, 17, 40])
    assert view.positions.tolist() == [3, 17, 40]
    assert view[1](t=0.5, **POINT) == solution["u"][17](t=0.5, **POINT)
    assert solution["u"].reshape(6, 10)[2, 3].positions == 23


def test_grid_and_gradient(solution):
    times, k = np.linspace(0.0, 1.0, 3), [0.6, 1.9]
    grid = solution["u"].grid(t=times, k=k, s=[1.0])
    assert grid.shape == (N, 3, 2, 1)
    assert grid[:, 1, 1, 0] == pytest.approx(solution["u"](t=0.5, k=1.9, s=1.0), rel=1e-12)
    assert solution.grid(t=times, k=k, s=[1.0])[:N] == pytest.approx(grid, rel=1e-12)
    slopes = solution["u"].gradient(t=times, **POINT)
    assert slopes.shape == (N, 2, 3)
    h = 1e-5
    above, below = (solution["u"](t=times, k=1.3 + d, s=0.7) for d in (h, -h))
    assert slopes[:, 0] == pytest.approx((above - below) / (2 * h), abs=1e-5)
    assert solution.gradient(t=times, **POINT)[:N] == pytest.approx(slopes, rel=1e-12)
    assert solution["u"][3].gradient(t=0.5, **POINT).shape == (2,)


def test_many_points_take_bounded_memory(solution):
    t = np.linspace(0.0, 1.0, 30_000)
    values = solution(t=t, max_memory="60MB", **POINT)
    exact = V @ solution.coefficients(t=t, **POINT)[:R]
    np.testing.assert_allclose(values[:N], exact, rtol=1e-12, atol=1e-12)
    assert solution["u"](t=t, max_memory="60MB", **POINT).shape == (N, 30_000)
    with pytest.raises(ro.EvaluationError, match="max_memory"):
        solution["u"](t=np.linspace(0.0, 1.0, 200_000), max_memory="60MB", **POINT)
    assert solution["u"](t=[], **POINT).shape == (N, 0)


def test_smaller_solutions_keep_the_modes(solution):
    fixed = solution.fix(k=1.3)
    assert fixed.parameters == {"s": (0.5, 1.5)}
    assert fixed["u"](t=0.4, s=0.7) == pytest.approx(solution["u"](t=0.4, **POINT), rel=1e-10)
    assert fixed.errors == solution.errors
    restricted = solution.restrict(k=(1.0, 1.5))
    assert restricted(t=0.4, **POINT) == pytest.approx(solution(t=0.4, **POINT), rel=1e-10)
    assert solution.at(0.4)(**POINT) == pytest.approx(solution(t=0.4, **POINT), rel=1e-10)


def test_derivatives_are_not_a_success(solution):
    slope = solution.diff("k")
    assert slope["u"](t=0.4, **POINT) == pytest.approx(
        solution["u"].gradient(t=0.4, **POINT)[:, 0], rel=1e-9
    )
    assert not slope.success
    assert np.isnan(slope.error)


def test_success_is_measured(solution):
    assert solution.success
    assert solution.error == 2e-5
    assert solution.errors == {"u": 2e-5, "w": 1e-6}
    worse = FieldSolution(solution.coefficients, replace(solution.modes, errors=(2e-4, 1e-6)))
    assert not worse.success
    assert worse.status is Status.TOLERANCE
    unchecked = FieldSolution(solution.coefficients, replace(solution.modes, errors=()))
    assert not unchecked.success
    assert unchecked.status is Status.UNCHECKED
    nan = FieldSolution(solution.coefficients, replace(solution.modes, errors=(np.nan, 1e-6)))
    assert not nan.success
    stopped = replace(solution, status=Status.TRAJECTORY_LIMIT, message="enough")
    assert not stopped.success
    assert "no: enough" in stopped.summary()


def test_the_summary_says_which_norm(solution):
    text = " ".join(repr(solution).split())
    assert "u (60 entries, 4 modes), w" in text
    assert "relative to the largest value of the field" in text
    assert "yes" in text
    assert "<table>" in solution._repr_html_()
    assert solution.rank == solution.coefficients.rank
    assert solution.box == ((0.5, 2.0), (0.5, 1.5))
    assert solution.unknowns == ("u", "w")


def test_errors_say_what_was_given(solution):
    with pytest.raises(ro.EvaluationError, match=r"no unknown `v`.*`u` and `w`"):
        solution["v"]
    with pytest.raises(ro.EvaluationError, match="`u` has 60 entries in this solution, and 7"):
        solution[ro.field("u", 7)]
    with pytest.raises(ro.EvaluationError, match="100 does not select entries of `u`"):
        solution["u"][100]
    with pytest.raises(ro.EvaluationError, match="outside its range"):
        solution["u"](t=0.5, k=100.0, s=1.0)
    with pytest.raises(ro.EvaluationError, match="no value for `s`"):
        solution(t=0.5, k=1.0)
    with pytest.raises(ro.EvaluationError, match="do not have the shape"):
        solution["u"].reshape(7, 7)
    with pytest.raises(TypeError, match="not iterable"):
        iter(solution)
    with pytest.raises(ro.OptionError, match="the modes need"):
        FieldSolution(
            solution.coefficients,
            replace(
                solution.modes,
                unknowns=solution.modes.unknowns[:1],
                modes=(V,),
                scales=(1.0,),
                errors=(),
            ),
        )


def test_it_can_be_pickled(solution):
    copy = pickle.loads(pickle.dumps(solution))
    assert (copy(t=0.4, **POINT) == solution(t=0.4, **POINT)).all()


@pytest.mark.parametrize("name", ["fit", "posterior", "minimize", "design"])
def test_applications_ask_what_is_read(solution, name):
    with pytest.raises(ro.OptionError, match=f"{name} of fields does not say what is read"):
        getattr(solution, name)([0.1], [1.0])


@pytest.mark.parametrize("name", ["probability", "plot", "density"])
def test_members_of_outputs_are_named(solution, name):
    for owner in (solution, solution["u"][3]):
        with pytest.raises(AttributeError, match=rf"solution\.output\(\{{.*\}}\)\.{name}"):
            getattr(owner, name)
        with pytest.raises(AttributeError, match="have no `cdf`"):
            owner.cdf  # noqa: B018
