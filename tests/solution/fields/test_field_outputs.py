"""Outputs of fields compared with the same quantities of all entries, by plain NumPy."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as ss
import sympy as sp

import rankone as ro
from rankone.compiler.field_outputs import _Lowering
from rankone.trajectories.fields.field_system import Unknown
from tests.solution.fields.small_fields import N, orthonormal_modes, small_fields, without_scalars

POINT = {"t": [0.0, 0.3, 1.0], "k": 1.3, "s": 0.7}
TIMES = np.linspace(0.0, 1.0, 65)
u = ro.field("u", N)
t, k = sp.symbols("t k")
w = sp.Function("w")(t)
ROW = np.cos(np.arange(N))[None] / N
POSITIVE = np.ones((1, N)) / N


@pytest.fixture(scope="module")
def solution():
    return small_fields()


@pytest.fixture(scope="module")
def values(solution):
    """Entries (N, times) and the scalar unknown, (times,)."""
    return solution["u"](**POINT), solution["w"](**POINT)


def test_sums_of_functionals_are_exact(solution, values):
    every, scalar = values
    quantities = {
        "tip": solution["u"][5],
        "mean": ro.apply(POSITIVE, u),
        "sum": 2 * ro.apply(ROW, u) - w,
        "w": solution["w"],
    }
    output = solution.output(quantities)
    assert output.unknowns == ("tip", "mean", "sum", "w")
    expected = [every[5], POSITIVE[0] @ every, 2 * ROW[0] @ every - scalar, scalar]
    assert output(**POINT) == pytest.approx(np.array(expected), abs=1e-12)
    assert output.success, output.message
    assert output.metadata.equations[1].startswith("mean = apply(")


def test_errors_of_functionals_are_those_of_the_field_times_the_weights(solution):
    output = solution.output({"mean": ro.apply(ROW, u)})
    size = max(
        np.abs(np.tensordot(ROW[0], solution["u"](t=TIMES[:, None], **sample), 1)).max()
        for sample in [solution.sample(200, seed=1), {"k": 0.5, "s": 1.5}, {"k": 0.5, "s": 0.5}]
    )
    bound = 2e-5 * 5.0 * np.abs(ROW).sum() / size
    assert output.errors["mean"] == pytest.approx(bound, rel=0.1)
    assert "bounded by the measured errors of fields" in " ".join(repr(output).split())
    strict = solution.output({"mean": ro.apply(ROW, u)}, rtol=0.5 * bound)
    assert not strict.success
    assert "largest for `mean`" in strict.message


def test_outputs_less_accurate_than_the_solve_say_so_first(solution):
    centred = ROW - ROW.mean() + 1e-3 * POSITIVE
    loose = replace(solution, modes=replace(solution.modes, errors=(9e-5, 1e-6)))
    for quantity in (ro.apply(centred, u), ro.apply(POSITIVE, u) ** 2 * 1e-3):
        output = loose.output({"x": quantity})
        assert output.success
        assert output.error > solution.rtol
        told = f"less accurate than the solve asked for, {output.error:.1e} instead of 1.0e-04"
        assert output.message.startswith(told)
        assert told in " ".join(repr(output).split())
        own = loose.output({"x": quantity}, rtol=2 * output.error)
        assert own.success
        assert "less accurate" not in own.message
    assert "less accurate" not in solution.output({"mean": solution["w"]}).message


def test_quadratic_functionals(solution, values):
    every, _ = values
    difference = ss.diags_array([-1.0, 1.0], offsets=[0, 1], shape=(N, N))
    slopes = difference @ every
    quantities = {
        "energy": ro.apply(POSITIVE, u**2),
        "indefinite": ro.apply(ROW, u**2),
        "slope": ro.apply(POSITIVE, u * ro.apply(difference, u)),
        "weighted": k * ro.apply(POSITIVE, ro.apply(difference, u) ** 2) + w,
    }
    output = solution.output(quantities)
    mean = POSITIVE[0]
    expected = [
        mean @ every**2,
        ROW[0] @ every**2,
        mean @ (every * slopes),
        1.3 * (mean @ slopes**2) + values[1],
    ]
    assert output(**POINT) == pytest.approx(np.array(expected), abs=1e-3, rel=1e-3)
    assert np.isfinite(output.error)
    assert output.metadata.equations[0].startswith("energy = apply(")


def test_the_error_of_a_quadratic_functional_is_bounded(solution):
    """Whatever a field differs by within its error, the energy differs by no more than is said."""
    output = solution.output({"energy": ro.apply(POSITIVE, u**2)})
    every = solution["u"](t=0.0, k=1.0, s=1.0)
    wrong = every + 2e-5 * 5.0 * np.sign(every)
    size = solution.output({"energy": ro.apply(POSITIVE, u**2)})(t=0.0, k=1.0, s=1.0)[0]
    assert 0.3 * output.error < abs(np.mean(wrong**2) - np.mean(every**2)) / size < output.error


def test_quadratic_functionals_that_are_zero_by_symmetry(solution):
    """Only rounding is left of them."""
    half = orthonormal_modes(N // 2)
    mirrored = np.concatenate([half, half[::-1]]), solution.modes.modes[1]
    symmetric = replace(solution, modes=replace(solution.modes, modes=mirrored))
    odd = np.repeat([1.0, -1.0], N // 2)[None] / N
    output = symmetric.output({"odd": ro.apply(odd, u**2), "even": ro.apply(abs(odd), u**2)})
    values, even = output(**POINT)
    assert np.abs(values).max() < 1e-14 * even.max()


def test_functions_of_functionals_and_of_few_entries(solution, values):
    every, _ = values
    few = np.zeros((1, N))
    few[0, [3, 17]] = 0.5, 2.0
    quantities = {
        "exp": sp.exp(-ro.apply(POSITIVE, u)),
        "few": ro.apply(few, sp.sin(u)),
    }
    output = solution.output(quantities)
    expected = [np.exp(-POSITIVE[0] @ every), few[0] @ np.sin(every)]
    assert output(**POINT) == pytest.approx(np.array(expected), abs=1e-3)


def test_functions_of_time(solution):
    output = solution.output({"peak": ro.maximum(ro.apply(POSITIVE, u**2))})
    times = np.linspace(0.0, 1.0, 400)
    energies = np.mean(solution["u"](t=times, k=1.3, s=0.7) ** 2, axis=0)
    assert output(k=1.3, s=0.7)[0] == pytest.approx(energies.max(), rel=1e-3)


def test_outputs_have_all_that_plain_solutions_have(solution, tmp_path):
    output = solution.output({"tip": solution["u"][5], "mean": ro.apply(POSITIVE, u)})
    expected = solution["u"][5].mean(0.3)
    assert output.mean(0.3)[0] == pytest.approx(expected, rel=1e-10)
    again = ro.load(output.save(tmp_path / "tip.npz"))
    assert (again(**POINT) == output(**POINT)).all()
    output.export(tmp_path / "tip.py")
    assert (tmp_path / "tip.py").exists()
    output.explore(tmp_path / "tip.html")
    assert "bounded by the measured errors of fields" in (tmp_path / "tip.html").read_text()


def test_outputs_of_smaller_solutions(solution):
    at = solution.at(0.3).output({"tip": solution["u"][5]})
    assert at(k=1.3, s=0.7)[0] == pytest.approx(solution["u"][5](t=0.3, k=1.3, s=0.7), rel=1e-10)
    fixed = solution.fix(k=1.3).output({"mean": ro.apply(POSITIVE, u)})
    assert fixed.parameters == {"s": (0.5, 1.5)}


def test_unchecked_fields_have_unchecked_outputs(solution):
    unchecked = replace(solution, modes=replace(solution.modes, errors=()), status=None)
    output = unchecked.output({"tip": solution["u"][5]})
    assert not output.success
    assert np.isnan(output.error)
    assert not unchecked.output({"energy": ro.apply(POSITIVE, u**2)}).success
    assert not solution.diff("t").output({"tip": solution["u"][5]}).success


def test_fits_to_sensors(solution):
    times = np.linspace(0.1, 1.0, 8)
    sensors = {"s1": solution["u"][3], "s2": ro.apply(POSITIVE, u)}
    data = solution.output(sensors)(t=times, k=1.3, s=0.7)
    fit = solution.fit(times, dict(zip(sensors, data, strict=True)), observe=sensors, sigma=1e-3)
    assert fit.x["k"] == pytest.approx(1.3, rel=1e-3)
    best = solution.minimize("s1", 1.0, observe=sensors)
    assert 0.5 <= best.x["k"] <= 2.0
    assert len(solution.design(3, observe=sensors, sigma=1e-3, at={"k": 1.0, "s": 1.0}).times) == 3


@pytest.mark.parametrize(
    ("quantity", "message"),
    [
        (u, "has 60 entries"),
        (u.diff(t) * 2, "60 entries"),
        (ro.apply(POSITIVE, u.diff(t)), "derivative"),
        (ro.apply(POSITIVE, sp.exp(u)), "no polynomial of second degree"),
        (ro.apply(POSITIVE, u**3), "no polynomial of second degree"),
        (ro.apply(np.eye(N), u), "60 entries"),
        (ro.apply(np.ones((1, 3)), ro.field("v", 3)), "does not hold"),
        (ro.apply(np.ones((1, 3)), ro.field("u", 3)), "does not hold"),
        (sp.Symbol("z"), "z"),
        ("2*u + w", r"the output `q` names the field `u` of 60 entries"),
    ],
)
def test_what_is_no_output_is_refused_by_name(solution, quantity, message):
    with pytest.raises(ro.OptionError, match=message):
        solution.output({"q": quantity})


@pytest.mark.parametrize(("quantity", "message"), [("u", "names the field `u`"), (k, "neither")])
def test_outputs_of_a_solution_without_scalar_unknowns(quantity, message):
    alone = without_scalars()
    with pytest.raises(ro.OptionError, match=message):
        alone.output({"q": quantity})
    assert alone.output({"q": alone["u"][3]}).success


def test_a_derivative_that_is_a_state_is_named():
    unknowns = (Unknown("u", 0, N), Unknown("u_t", N, N))
    modes = replace(small_fields().modes, unknowns=unknowns)
    lowering = _Lowering(modes, small_fields().metadata)
    for derivative, remedy in ((u.diff(t), r'field\("u_t", 60\)'), (u.diff(t, 2), "diff")):
        with pytest.raises(ro.OptionError, match=remedy):
            lowering.output("q", ro.apply(POSITIVE, derivative))


def test_views_of_many_entries_are_refused(solution):
    with pytest.raises(ro.OptionError, match="60 entries"):
        solution.output({"q": solution["u"]})
    with pytest.raises(ro.OptionError, match="not a mapping"):
        solution.output("q")
