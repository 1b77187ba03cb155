"""Outputs against SciPy: trajectories, quadrature, extremes and events of its own."""

import functools

import numpy as np
import pytest
import scipy.integrate
import scipy.optimize
import sympy as sp

import rankone as ro
from rankone.compiler.codegen import sums as long_sums
from rankone.solution.outputs import sampling
from rankone.solution.outputs.interpolation import _is_out_of_sight as out_of_sight
from rankone.support.errors import EvaluationError, OptionError, RankoneError
from tests.problems import EXAMPLES

t, x0, y0, k = sp.symbols("t x0 y0 k")
x, y, u = (sp.Function(name)(t) for name in "xyu")
POINTS = np.array([[8.0, 4.0], [8.3, 5.7], [9.7, 4.2], [11.1, 5.1], [12.0, 6.0]])


@functools.cache
def prey():
    return ro.solve(EXAMPLES["lotka_volterra"].problem, rtol=1e-7)


@functools.cache
def trajectory(a, b):
    """x, y and the integral of x*y along one trajectory."""

    def rhs(_, s):
        return [s[0] * (1.5 - s[1]), -s[1] * (3 - s[0]), s[0] * s[1], s[0]]

    given = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-12, "dense_output": True}
    return scipy.integrate.solve_ivp(rhs, (0, 6), [a, b, 0, 0], **given).sol


def largest(function):
    """The largest value over time, by a dense grid and Brent's method from its best point."""
    times = np.linspace(0, 6, 20001)
    best = times[np.argmax(function(times))]
    ends = max(best - 1e-3, 0), min(best + 1e-3, 6)
    found = scipy.optimize.minimize_scalar(
        lambda s: -function(s), bounds=ends, method="bounded", options={"xatol": 1e-13}
    )
    return max(-found.fun, function(0.0), function(6.0))


def crossing(function, direction):
    """The first time of a crossing, by a dense grid and Brent's method."""
    times = np.linspace(0, 6, 20001)
    signs = np.sign(function(times))
    change = signs[1:] * signs[:-1] < 0
    if direction:
        change &= signs[1:] == direction
    first = np.argmax(change)
    return scipy.optimize.brentq(function, times[first], times[first + 1], xtol=1e-14)


def positive(function):
    """How long it is positive, taken as linear within the cells of a dense grid."""
    values = function(np.linspace(0, 6, 20001))
    above, size = np.maximum(values, 0), np.abs(values)
    return 6 * np.mean((above[1:] + above[:-1]) / (size[1:] + size[:-1]))


CONSTANT = {
    "integral": (sp.Integral(x * y, (t, 0, 6)), lambda s: s(6.0)[2]),
    "part": (sp.Integral(x, (t, 1, 2.5)), lambda s: s(2.5)[3] - s(1.0)[3]),
    "maximum": (ro.maximum(x), lambda s: largest(lambda r: s(r)[0])),
    "minimum": (ro.minimum(x - y), lambda s: -largest(lambda r: s(r)[1] - s(r)[0])),
    "crossing": (ro.first_crossing(x, 2), lambda s: crossing(lambda r: s(r)[0] - 2, 0)),
    "upwards": (
        ro.first_crossing(x, 2, direction="rising"),
        lambda s: crossing(lambda r: s(r)[0] - 2, 1),
    ),
    "duration": (
        ro.duration(x - 5),
        lambda s: positive(lambda r: s(r)[0] - 5),
    ),
    "both": (
        ro.maximum(y) * x0 / sp.Integral(x, (t, 0, 6)),
        lambda s: largest(lambda r: s(r)[1]) * s(0.0)[0] / s(6.0)[3],
    ),
}


@pytest.mark.parametrize("name", CONSTANT)
def test_numbers_of_whole_trajectories(name):
    expression, exact = CONSTANT[name]
    output = prey().output({"q": expression}, rtol=1e-4)
    assert output.success, output.message
    assert output.metadata.timeless
    wanted = np.array([exact(trajectory(*point)) for point in POINTS])
    found = output["q"](x0=POINTS[:, 0], y0=POINTS[:, 1])
    assert np.abs(found - wanted).max() <= 2 * output.error * np.abs(wanted).max()


MOVING = {
    "product": (x * y / (1 + y), lambda s, r: s[0] * s[1] / (1 + s[1])),
    "sum": (x + 2 * y, lambda s, r: s[0] + 2 * s[1]),
    "with parameters": (
        x / x0 + sp.sin(t) * y0,
        lambda s, r: s[0] / s[0, :1] + np.sin(r) * s[1, 0],
    ),
    "running": (sp.Integral(x * y, (t, 0, t)), lambda s, r: s[2]),
}


@pytest.mark.parametrize("name", MOVING)
def test_functions_of_time(name):
    expression, exact = MOVING[name]
    output = prey().output({"q": expression})
    assert output.success, output.message
    assert prey().rtol <= output.rtol <= 20 * prey().rtol
    times = np.linspace(0, 6, 201)
    wanted = np.array([exact(trajectory(*point)(times), times) for point in POINTS])
    found = output["q"](t=times, x0=POINTS[:, :1], y0=POINTS[:, 1:])
    assert np.abs(found - wanted).max() <= 2 * output.error * np.abs(wanted).max()


@pytest.mark.slow
def test_time_derivatives_have_no_known_error():
    output = prey().output({"rate": x.diff(t) - x * (1.5 - y)})
    assert not output.success
    assert "not known" in output.message
    times = np.linspace(0.1, 5.9, 50)
    sizes = np.abs(prey().diff("t")["x"](t=times, x0=9.3, y0=4.8)).max()
    assert np.abs(output["rate"](t=times, x0=9.3, y0=4.8)).max() < 1e-4 * sizes


def test_derivatives_that_are_states_have_one():
    solution = ro.solve(EXAMPLES["decay"].problem, rtol=1e-8)
    m = sp.Symbol("m")
    oscillator = ro.Problem(
        [sp.Eq(m * x.diff(t, 2) + 4 * x, 0)], (t, 0, 3), {m: (0.9, 1.1)}, {x: 1, x.diff(t): 0}
    )
    solution = ro.solve(oscillator, rtol=1e-8)
    energy = solution.output({"energy": m * x.diff(t) ** 2 / 2 + 2 * x**2})
    assert energy.success
    assert np.allclose(energy(t=[0.3, 1.7], m=1.03), 2.0, rtol=1e-7)


def test_a_level_is_not_crossed_where_a_function_begins_at_it():
    v, g = sp.symbols("v g")
    ball = ro.Problem(
        [sp.Eq(x.diff(t, 2), -g)], (t, 0, 3), {v: (8, 12), g: (9, 10)}, {x: 0, x.diff(t): v}
    )
    output = ro.solve(ball, rtol=1e-8).output(
        {"landing": ro.first_crossing(x), "height": ro.maximum(x)}
    )
    found = output(v=[8.5, 11.9], g=[9.1, 9.9])
    v, g = np.array([8.5, 11.9]), np.array([9.1, 9.9])
    assert np.allclose(found, [2 * v / g, v**2 / (2 * g)], rtol=1e-7)


@pytest.mark.slow
def test_outputs_of_outputs_files_statistics_and_models(tmp_path):
    output = prey().output({"peak": "maximum(x)", "trough": "minimum(x)"})
    span = output.output({"span": sp.Symbol("peak") - sp.Symbol("trough")})
    values = output(x0=9.3, y0=4.8)
    assert np.isclose(span["span"](x0=9.3, y0=4.8), values[0] - values[1], rtol=3e-7)
    assert np.array_equal(ro.load(output.save(tmp_path / "o.npz"))(x0=9.3, y0=4.8), values)
    assert output.mean().shape == (2,)
    assert output.gradient(x0=9.3, y0=4.8).shape == (2, 2)
    assert output.export(tmp_path / "peaks.py").exists()
    assert prey().at(2.0).output({"r": x / y})["r"](x0=9.3, y0=4.8) == pytest.approx(
        np.divide(*prey()(t=2.0, x0=9.3, y0=4.8))
    )


def test_integrals_and_crossings_see_jumps():
    """A dose after half of the time; exact solutions."""
    problem = ro.Problem(
        [sp.Eq(u.diff(t), -k * u)], (t, 0, 2), {k: (0.5, 1)}, {u: 1}, jumps={1.0: {u: u + 1}}
    )
    output = ro.solve(problem, rtol=1e-8).output(
        {"auc": sp.Integral(u, (t, 0, 2)), "peak": ro.maximum(u), "up": ro.first_crossing(u, 1.2)}
    )
    rate = np.array([0.55, 0.9])
    once = (1 - np.exp(-rate)) / rate
    found = output(k=rate)
    assert np.allclose(found[0], once + (np.exp(-rate) + 1) * once, rtol=1e-7)
    assert np.allclose(found[1], 1 + np.exp(-rate), rtol=1e-7)
    assert np.allclose(found[2], 1.0, rtol=1e-7)


def test_an_output_that_is_not_resolved_says_so():
    output = prey().output({"kink": abs(x0 + 0.3 * y0 - 11.12345)}, rtol=1e-9, effort=0.05)
    assert not output.success
    assert output.error > 1e-9


def test_attempts_end_where_none_would_reach_the_tolerance():
    """Cheap ones go on; dear ones have to promise that their gain reaches it."""
    level = 1e-5
    assert not out_of_sight([0.1, 0.05], [1e10, 9.999e9, 9.99e9], level)  # cheap
    assert out_of_sight([0.02, 0.007], [1e10, 9.95e9, 9.2e9], level)  # four more, each 15 times
    assert not out_of_sight([0.02, 1e-4], [1e10, 9.95e9, 9.2e9], level)  # one more will do
    assert out_of_sight([0.02, 0.03, 0.04], [1e10, 9.8e9, 9.5e9, 9.1e9], level)  # no gain
    assert not out_of_sight([0.1], [1e10, 1e9], level)


@pytest.mark.parametrize(
    "rhs",
    [
        pytest.param("a - k*x", marks=pytest.mark.slow),
        pytest.param("-k*x + Piecewise((a, t < b), (0, True))", marks=pytest.mark.slow),
    ],
)
def test_durations_that_begin_inside_the_box_are_refused_soon(rhs):
    """The time above a level has a kink, or a root, where it is touched."""
    box = {"k": (0.5, 2), "a": (0.5, 2)} | ({"b": (1, 2)} if "b" in rhs else {})
    solution = ro.solve(ro.Problem.from_strings({"x": rhs}, {"x": "0"}, box, (0, 4)), 1e-4)
    output = solution.output({"q": "duration(x-0.5)"})
    assert not output.success
    assert "raise effort" not in output.message
    assert "restrict the solution to where it is smooth" in output.message
    assert max(output.nodes) < 600


@pytest.mark.parametrize(
    ("given", "match"),
    [
        ({}, "names no output"),
        (x / y, "not a mapping from names"),
        ("xx", "unknown name `xx`"),
        ({"q": "x*"}, "not a formula"),
        ({"q": "xx"}, "unknown name `xx`"),
        ({"q": sp.Symbol("xx")}, "names are"),
        ({"q": sp.Function("z")(t)}, "`z"),
        ({"q": sp.Function("x")(k)}, "not a name, a symbol or a function of `t`"),
        ({"x0": x}, "name of a coordinate"),
        ({3: x}, "not text"),
        ({"q": object()}, "not an expression"),
        ({"q": x > 2}, "not an expression"),
        ({"q": sp.sqrt(-1) * x}, "not real"),
        ({"q": ro.maximum(ro.maximum(x) * y)}, "inside another"),
        ({"q": sp.Integral(x, (t, 0, 7))}, "not in"),
        ({"q": sp.Integral(x, (t, 0, x0))}, "are not numbers"),
        ({"q": sp.Integral(x, (t, 0, 1), (x0, 8, 9))}, "several variables"),
        ({"q": ro.first_crossing(x, 2, 3)}, "direction"),
        ({"q": "maximum(x, y)"}, "not understood"),
    ],
)
def test_what_is_refused(given, match):
    with pytest.raises(RankoneError, match=match):
        prey().output(given)


def test_what_does_not_happen():
    with pytest.raises(EvaluationError, match=r"does not happen at x0 = .*restrict"):
        prey().output({"q": ro.first_crossing(x, 1000)})
    with pytest.raises(EvaluationError, match="not finite at"):
        prey().output({"q": 1 / (x0 - 10)})
    with pytest.raises(OptionError, match="nothing depends on time"):
        prey().at(1.0).output({"q": ro.maximum(x)})


a = sp.Symbol("a")


@functools.cache
def decaying():
    problem = ro.Problem(
        [sp.Eq(u.diff(t), -k * u)], (t, 0, 2), {k: (0.5, 2), a: (0.9, 1.1)}, {u: a}
    )
    return ro.solve(problem, rtol=1e-8)


@pytest.mark.parametrize(
    ("narrow", "effort"),
    [
        (u * sp.exp(-(((t - 0.7777) / 1e-5) ** 2)), 0.05),
        (sp.exp(-(((k - a) / 1e-4) ** 2)), 0.05),
        pytest.param(sp.exp(-(((t - k) / 1e-4) ** 2)), 0.05, marks=pytest.mark.slow),
        pytest.param(sp.exp(-(((u - 0.6123) / 1e-4) ** 2)), 0.05, marks=pytest.mark.slow),
        pytest.param(
            ro.maximum(sp.exp(-(((u - 0.6123) / 1e-4) ** 2))), 0.2, marks=pytest.mark.slow
        ),
    ],
    ids=str,
)
def test_what_is_narrow_is_not_missed(narrow, effort):
    output = decaying().output({"q": narrow}, effort=effort)
    assert not output.success
    assert output.error > output.rtol


@pytest.mark.parametrize(
    ("parameter", "middle", "width"), [(k, 1.2345, 1e-5), (a, 0.98765, 1e-6)], ids=str
)
def test_what_is_narrow_in_one_parameter_is_resolved(parameter, middle, width):
    output = decaying().output({"q": 1 / (1 + ((parameter - middle) / width) ** 2)}, effort=0.05)
    shares = np.linspace(-20.0, 20.0, 401)
    point = {k: 1.0, a: 1.0, parameter: middle + width * shares}
    assert output.success
    np.testing.assert_allclose(output["q"](point), 1 / (1 + shares**2), atol=2 * output.rtol)


@pytest.mark.parametrize(
    ("kinked", "exact"),
    [
        (sp.Abs(k - 1.2345) * u, lambda t, k, u: np.abs(k - 1.2345) * u),
        (sp.Heaviside(k - 1.2345) * u, lambda t, k, u: (k > 1.2345) * u),
        (sp.Abs(t - 0.7777) * u, lambda t, k, u: np.abs(t - 0.7777) * u),
    ],
    ids=["kink", "jump", "kink in time"],
)
def test_kinks_at_known_places_begin_elements(kinked, exact):
    output = decaying().output({"q": kinked})
    assert output.success
    rng = np.random.default_rng(4)
    at, rate, start = rng.uniform(0, 2, 500), rng.uniform(0.5, 2, 500), rng.uniform(0.9, 1.1, 500)
    wanted = exact(at, rate, start * np.exp(-rate * at))
    found = output["q"](t=at, k=rate, a=start)
    assert np.abs(found - wanted).max() <= 2 * output.rtol * np.abs(wanted).max()


S = sp.Function("x")
s = sp.Symbol("s")


@pytest.mark.parametrize(
    ("given", "match"),
    [
        (sp.Integral(sp.exp(s - t) * S(s), (s, 0, t)), "both `s` and `t`"),
        (sp.Integral(x, (x0, 8, 9)), "`x0` is a parameter"),
        (sp.Integral(x, (t, 0, sp.I)), "are not numbers"),
        (sp.Dummy("x0") * x, "names are"),
        ("max(x)", r"of one argument.*maximum\("),
    ],
)
def test_what_would_be_another_quantity_is_refused(given, match):
    with pytest.raises(RankoneError, match=match):
        prey().output({"q": given})


def test_a_dummy_variable_of_an_integral_is_time():
    one = prey().output({"q": sp.Integral(S(s), (s, 0, 2))})
    other = prey().output({"q": "integral(x, 0, 2)"})
    assert one(x0=9, y0=5) == other(x0=9, y0=5)


def two_peaks(second, box):
    """Peaks of size one and of another size, which depends on parameters."""
    curve = sp.exp(-4 * (t - 1) ** 2) + second * sp.exp(-4 * (t - 3) ** 2)
    problem = ro.Problem([sp.Eq(x.diff(t), curve.diff(t))], (t, 0, 4), box, {x: curve.subs(t, 0)})
    return ro.solve(problem, rtol=1e-6)


@pytest.mark.parametrize("quantity", [ro.maximum(x), ro.duration(x - 1.01)])
def test_islands_where_another_peak_is_the_largest_are_found(quantity):
    p, r = sp.symbols("p r")
    solution = two_peaks(1.05 * (p + r) / 2, {p: (0, 1), r: (0, 1)})
    output = solution.output({"q": quantity}, effort=0.1)
    assert not output.success
    assert output.error > 1e-4


def test_outputs_without_parameters():
    solution = ro.solve(
        ro.Problem([sp.Eq(x.diff(t, 2), -x)], (t, 0, 10), {}, {x: 1, x.diff(t): 0}), rtol=1e-8
    )
    output = solution.output({"largest": ro.maximum(x), "smallest": "minimum(x)", "none": sp.pi})
    assert output.success
    assert np.allclose(output(), [1, -1, np.pi], atol=1e-7)


def test_corners_are_resolved_in_time():
    c, w = sp.symbols("c w")
    curve = a * sp.exp(-c * t) * sp.cos(w * t)
    box = {a: (0.5, 1.5), c: (0.05, 0.4), w: (1, 3)}
    problem = ro.Problem([sp.Eq(x.diff(t), curve.diff(t))], (t, 0, 6), box, {x: a})
    output = ro.solve(problem, rtol=1e-6).output({"q": sp.exp(x)})
    assert output.success
    times = np.linspace(0, 6, 301)
    wanted = np.exp(1.5 * np.exp(-0.05 * times) * np.cos(3 * times))
    found = output["q"](t=times, a=1.5, c=0.05, w=3.0)
    assert np.abs(found - wanted).max() <= output.rtol * np.exp(1.5)


def test_outputs_of_a_part_of_the_horizon_say_so():
    blowing = ro.Problem([sp.Eq(x.diff(t), k * x**2)], (t, 0, 2), {k: (0.9, 1.1)}, {x: 1})
    with pytest.raises(ro.BlowUpError) as caught:
        ro.solve(blowing, rtol=1e-6)
    output = caught.value.solution.output({"m": ro.maximum(x)})
    assert not output.success
    assert "ends at" in output.message


def test_units_of_outputs():
    output = prey().output({"peak": ro.maximum(x)}, units={"peak": "1e3"})
    assert dict(output.metadata.units)["peak"] == "1e3"
    with pytest.raises(OptionError, match="no output `top`"):
        prey().output({"peak": ro.maximum(x)}, units={"top": "1"})


@pytest.mark.parametrize("power", [(4 * x * (1 - x)) ** 100000, "(4*x*(1-x))**100000"])
def test_powers_of_numbers_that_no_float_holds(power):
    with pytest.raises(OptionError, match="too large a number"):
        prey().output({"q": power})


@functools.cache
def bar():
    """Forty cells that exchange, the first of them heated."""
    n = 40
    rates = {f"u{i}": f"k*(u{max(i - 1, 0)} - 2*u{i} + u{min(i + 1, n - 1)})" for i in range(n)}
    rates["u0"] += " + 1"
    box = {"k": (0.5, 2.0), "start": (0.0, 0.5)}
    problem = ro.Problem.from_strings(rates, dict.fromkeys(rates, "start"), box, (0, 3))
    return ro.solve(problem, rtol=1e-5, method="cross")


@pytest.mark.parametrize(
    ("output", "exact"),
    [
        ("MEAN", lambda u, t, k: u.mean(axis=0)),
        ("k*MEAN**2 - u3 + t", lambda u, t, k: k * u.mean(axis=0) ** 2 - u[3] + t),
        pytest.param(
            "maximum(u0 - MEAN)",
            lambda u, t, k: (u[0] - u.mean(axis=0)).max(),
            marks=pytest.mark.slow,
        ),
        ("MEAN + u3_t", lambda u, t, k: u.mean(axis=0) + k * (u[2] - 2 * u[3] + u[4])),
    ],
)
def test_long_sums_of_states_are_one_source(monkeypatch, output, exact):
    """They are what they were term by term, with the same errors."""
    output = output.replace("MEAN", f"(({' + '.join(f'u{i}' for i in range(40))})/40)")
    quantity = bar().output({"q": output})
    monkeypatch.setattr(long_sums, "_LEAST_STATES", 100)
    by_terms = bar().output({"q": output})
    times = np.linspace(0, 3, 301)
    at = () if quantity.metadata.timeless else (times,)
    for at_k, start in [(0.5, 0.5), (1.3, 0.2), (2.0, 0.0)]:
        want = exact(bar()(times, k=at_k, start=start), times, at_k)
        got = quantity["q"](*at, k=at_k, start=start)
        np.testing.assert_allclose(got, want, atol=1e-4)
    assert quantity.rtol == pytest.approx(by_terms.rtol, rel=1e-2)
    assert quantity.errors["q"] == pytest.approx(by_terms.errors["q"], rel=0.2, nan_ok=True)
    assert quantity.outcome.status is by_terms.outcome.status


def test_an_output_of_many_states_charges_their_evaluation_once(monkeypatch):
    """The effect of the error of each state takes values of all of them that are there already."""
    squares = " + ".join(f"u{i}**2" for i in range(40))
    calls, original = [], sampling.Sampler._sources

    def counted(sampler, times, points):
        calls.append(len(points))
        return original(sampler, times, points)

    monkeypatch.setattr(sampling.Sampler, "_sources", counted)
    assert bar().output({"q": squares}).success
    assert len(calls) < 80


@functools.cache
def passing():
    """A state that passes the parameter k at the time k."""
    problem = ro.Problem.from_strings(
        {"x": "1 + 0*k", "q": "-k*q"}, {"x": "0", "q": "1"}, {"k": (0.8, 1.2)}, (0, 3)
    )
    return ro.solve(problem, rtol=1e-4, effort=0.3)


GAP = "Z**2/(exp(Z) + exp(-Z) - 1)".replace("Z", "((x - k)*1e9)")


@pytest.mark.parametrize(
    "narrow",
    [
        pytest.param(
            "integral(1 + Piecewise((1e5, (x > k) & (x < k + 1e-5)), (0, True)))",
            marks=pytest.mark.slow,
        ),
        pytest.param("integral(1 + 1e5*Max(0, 1 - Abs(x - k)*1e5))", marks=pytest.mark.slow),
        "maximum(Piecewise((1, (x > k) & (x < k + 1e-5)), (0, True)))",
        pytest.param(
            "maximum(1e-8*Piecewise((1, (x > k) & (x < k + 1e-5)), (0, True)))",
            marks=pytest.mark.slow,
        ),
        pytest.param("maximum(Max(0, 1 - Abs(x - k)*1e5))", marks=pytest.mark.slow),
    ],
)
def test_what_is_narrow_between_the_times_of_samples_is_not_missed(narrow):
    output = passing().output({"m": narrow})
    assert not output.success
    assert output.error > output.rtol


@pytest.mark.parametrize(
    "usual",
    [
        "maximum(q*tanh(x))",
        "minimum(x*exp(-x))",
        "integral(exp(-x))",
        "integral(q**2.5)",
        "integral(Piecewise((x, x > 1), (1, True)))",
        "integral((x - k)/(exp(x - k) - 1))",
        "integral(Max(x - k, 0))",
        "duration(x - 1)",
        "first_crossing(q - 0.5)",
        "x**3/(1 + x**3)",
        "sqrt(x**2 + q**2)",
        "Abs(x - 1)",
        "q*maximum(tanh(x))",
        "integral(1/(1 + exp(-50*(x - k))))",
        f"duration(x - 2 + 10*{GAP})",
    ],
)
def test_usual_outputs_hide_nothing(usual):
    assert passing().output({"m": usual}).success
