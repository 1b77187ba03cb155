"""SBML files as models: each feature against a closed form or a trajectory by hand."""

import sys

import numpy as np
import pytest
import scipy.integrate
from scipy.integrate import solve_ivp

import rankone as ro
from rankone import ProblemError
from tests.problem.models import documents as d

pytest.importorskip("libsbml", reason="needs python-libsbml: pip install python-libsbml")


@pytest.fixture
def read(tmp_path):
    def read(text, suffix=".xml"):
        path = tmp_path / f"model{suffix}"
        path.write_text(text, encoding="utf-8")
        return ro.read_sbml(path)

    return read


def values(model, end, *names, count=11, **options):
    """Trajectories of names of a model at evenly spread times, and the times."""
    problem = model.problem(time=(0, end), **options)
    times = np.linspace(0.0, end, count)
    trajectory = problem.trajectory(times, rtol=1e-10)
    return times, *(trajectory[name] for name in names)


def grown(rule):
    return d.document(
        compartments=[d.compartment(size=2.0, constant=False)],
        species=[d.species("S", concentration=3.0)],
        parameters=[d.parameter("g", 0.3), d.parameter("k", 0.5)],
        rules=[rule],
        reactions=[d.reaction("R", ["S"], [], "k*S*C")],
    )


# -- species and reactions ------------------------------------------------------------------------


def test_amounts_and_concentrations(read):
    """In a volume of 2, an amount of 6 is a concentration of 3; a rate changes amounts."""
    model = read(
        d.document(
            compartments=[d.compartment(size=2.0)],
            species=[
                d.species("A", amount=6.0),
                d.species("B", concentration=0.0, only_amounts=True),
                d.species("X", concentration=5.0, boundary=True),
            ],
            parameters=[d.parameter("k", 0.5)],
            reactions=[d.reaction("R", ["A"], ["B", "X"], "k*A*C")],
        )
    )
    assert [str(u) for u in model.unknowns] == ["A(t)", "B(t)"]
    assert model.parameters == {"C": 2.0, "A_0": 6.0, "B_0": 0.0, "X": 5.0, "k": 0.5}
    times, a, b = values(model, 4.0, "A", "B")
    np.testing.assert_allclose(a, 3 * np.exp(-0.5 * times), rtol=1e-7)
    np.testing.assert_allclose(b, 6 - 6 * np.exp(-0.5 * times), atol=1e-7)


def test_a_compartment_that_grows_dilutes(read):
    model = read(grown(d.rate_rule("C", "g*C")))
    times, amount = values(model, 4.0, "S_amount")
    np.testing.assert_allclose(amount, 6 * np.exp(-0.5 * times), rtol=1e-7)
    assert str(model.expression("S")) == "S_amount(t)/C(t)"


def test_a_compartment_by_a_rule_of_time(read):
    model = read(grown(d.assignment_rule("C", "2*exp(g*time)")))
    times, amount = values(model, 4.0, "S_amount")
    np.testing.assert_allclose(amount, 6 * np.exp(-0.5 * times), rtol=1e-7)


def test_a_rate_of_a_concentration_while_its_compartment_is_reset(read):
    """An event that halves the volume doubles the concentration, whose rate is 0.4."""
    model = read(
        d.document(
            compartments=[d.compartment(size=2.0, constant=False)],
            species=[d.species("S", concentration=1.0, boundary=True)],
            rules=[d.rate_rule("S", "0.4")],
            events=[d.event("halve", "time > 1", {"C": "C/2"})],
        )
    )
    _, amount, size = values(model, 2.0, "S_amount", "C", count=3)
    np.testing.assert_allclose(amount / size, [1.0, 2.8, 3.2], rtol=1e-8)


def test_stoichiometries_and_conversion_factors(read):
    """n A -> B with a rate of 1: A loses 3 * 0.5 by time, B gains 0.5 * 2."""
    model = read(
        d.document(
            ' conversionFactor="f"',
            compartments=[d.compartment()],
            species=[d.species("A", amount=9.0), d.species("B", amount=0.0, conversionFactor="h")],
            parameters=[d.parameter("f", 0.5), d.parameter("h", 2.0), d.parameter("m", 1.5)],
            assignments=[d.initial_assignment("n", "2*m")],
            reactions=[
                d.reaction("R", [d.reference("A", None, "n")], [d.reference("B", 0.5)], "1*C")
            ],
        )
    )
    times, a, b = values(model, 4.0, "A", "B")
    np.testing.assert_allclose(a, 9 - 1.5 * times, rtol=1e-9)
    np.testing.assert_allclose(b, times, atol=1e-9)


def test_local_parameters_hide_others(read):
    model = read(
        d.document(
            compartments=[d.compartment()],
            species=[d.species("A", amount=1.0), d.species("B", amount=1.0)],
            parameters=[d.parameter("k", 0.5)],
            reactions=[
                d.reaction("R", ["A"], [], "k*A*C", '<localParameter id="k" value="2"/>'),
                d.reaction("Q", ["B"], [], "k*B*C"),
            ],
        )
    )
    assert model.parameters["R_k"] == 2.0
    times, a, b = values(model, 2.0, "A", "B")
    np.testing.assert_allclose([a, b], np.exp([-2 * times, -0.5 * times]), rtol=1e-7)


def test_earlier_levels(read):
    """Level 2 with a stoichiometry by a formula."""
    times, a, b = values(read(d.DECAY_LEVEL_2), 3.0, "A", "B")
    np.testing.assert_allclose(a, 3 * np.exp(-0.5 * times), rtol=1e-7)
    np.testing.assert_allclose(b, 6 - 6 * np.exp(-0.5 * times), atol=1e-7)


# -- rules and formulas ---------------------------------------------------------------------------


def test_rules_in_any_order(read):
    """x' = -b x with b = 2 a and a = p + time, written the other way round."""
    names = [d.parameter(n, 1, False) for n in ("x", "a", "b")]
    model = read(
        d.document(
            parameters=[*names, d.parameter("p", 0.5)],
            rules=[
                d.assignment_rule("b", "2*a"),
                d.rate_rule("x", "-b*x"),
                d.assignment_rule("a", "p + time"),
            ],
            assignments=[d.initial_assignment("x", "b + 1")],
        )
    )
    times, x = values(model, 2.0, "x")
    np.testing.assert_allclose(x, 2 * np.exp(-times - times**2), rtol=1e-7)
    problem = model.problem(["p"], spread=2.0, time=(0, 2))
    assert {str(symbol) for symbol in problem.definitions} == {"a", "b"}
    assert str(model.expression("b")) == "2*p + 2*t"


def test_linear_algebraic_rules_are_solved(read):
    names = [d.parameter(n, 1, False) for n in ("x", "y", "z")]
    model = read(
        d.document(
            parameters=[*names, d.parameter("k", 0.5)],
            rules=[
                d.algebraic_rule("x + y + z - 4"),
                d.rate_rule("x", "y*k"),
                d.algebraic_rule("y - 3*z + x"),
            ],
        )
    )
    times, x = values(model, 2.0, "x")
    np.testing.assert_allclose(x, 3 - 2 * np.exp(-0.5 * times), rtol=1e-7)


def test_algebraic_rules_that_are_not_linear(read):
    """x and y are found from their product and their sum, which x changes."""
    model = read(
        d.document(
            parameters=[
                *(
                    d.parameter(n, value, False)
                    for n, value in (("s", 5), ("x", 0.5), ("y", 4), ("z", 0))
                ),
                d.parameter("k", 0.5),
            ],
            rules=[
                d.algebraic_rule("x*y - k"),
                d.algebraic_rule("x + y - s"),
                d.rate_rule("s", "-x*s"),
            ],
            events=[d.event("E", "s < 4", {"z": "1"})],
        )
    )
    assert "0 = -s + x + y" in repr(model)

    def rate(_t, s):
        return -s * (s - np.sqrt(s**2 - 2)) / 2

    reference = solve_ivp(
        rate, (0, 3), [5], t_eval=[1, 3], rtol=1e-10, atol=1e-12, events=lambda t, s: s[0] - 4
    )
    problem = model.problem({"k": (0.4, 0.6)}, time=(0, 3))
    trajectory = problem.trajectory([1.0, 3.0], k=0.5)
    np.testing.assert_allclose(trajectory.events["E"], reference.t_events[0], rtol=1e-6)
    np.testing.assert_allclose(trajectory["s"], reference.y[0], rtol=1e-6)
    np.testing.assert_allclose(trajectory["x"] * trajectory["y"], 0.5, rtol=1e-6)
    solution = ro.solve(model.problem({"k": (0.4, 0.6)}, time=(0, 1)), rtol=1e-5)
    assert solution.success
    np.testing.assert_allclose(solution["s"](1.0, k=0.5), reference.y[0, 0], rtol=1e-4)


@pytest.mark.parametrize(
    ("formula", "expected"),
    [
        ("f(3, x)", 3 - 2),
        ("piecewise(1, x > 3, 2, x > 1, 3)", 2),
        ("piecewise(1, x > 3) + piecewise(0, x > 3, 2)", None),
        ("root(3, 8) + sqrt(x + 2) + log(2, 8) + log10(100) + ln(exponentiale)", 2 + 2 + 3 + 2 + 1),
        ("floor(x/1.5) + ceil(x/1.5) + factorial(4) + abs(-x)", 1 + 2 + 24 + 2),
        ("quotient(-7, x) + rem(-7, x) + max(x, 1, 5) + min(x, 1)", -3 - 1 + 5 + 1),
        ("sec(x) + csc(x) + cot(x)", 1 / np.cos(2) + 1 / np.sin(2) + 1 / np.tan(2)),
        ("arcsec(x) + arccsc(x) + arccot(x)", np.arccos(0.5) + np.arcsin(0.5) + np.arctan(0.5)),
        ("sech(x) + arccoth(x)", 1 / np.cosh(2) + np.arctanh(0.5)),
        ("avogadro/1e23", 6.02214179),
        ("(x > 1) + (x > 1 && !(x > 3)) + xor(x > 1, x > 3, x < 0) + implies(x > 1, x < 0)", 3),
        ("piecewise(5, x, 6)", 5),
        ("1e-3*x^2 + 1/4 - 2.5", 0.004 - 2.25),
        ("rateOf(y) + rateOf(x) + rateOf(c)", 7 + 0 + 7),
    ],
)
def test_formulas(read, formula, expected):
    """Each formula is the rate of z, with x = 2, y' = 7 and c = 1 + y."""
    text = d.document(
        functions=[d.function("f", "lambda(a, b, a - g(b))"), d.function("g", "lambda(x, x)")],
        parameters=[
            d.parameter("x", 2),
            *(d.parameter(name, 0, False) for name in ("y", "z", "c")),
        ],
        rules=[
            d.rate_rule("y", "7"),
            d.assignment_rule("c", "1 + y"),
            d.rate_rule("z", formula),
        ],
    )
    if expected is None:
        with pytest.raises(ProblemError, match="Piecewise"):
            values(read(text), 1.0, "z")
        return
    times, z = values(read(text), 1.0, "z", count=3)
    np.testing.assert_allclose(z, expected * times, rtol=1e-9)


def test_an_event_sets_a_concentration_and_its_volume_at_once(read):
    """The amount is that of the new volume."""
    model = read(
        d.document(
            compartments=[d.compartment(size=2, constant=False)],
            species=[d.species("S", concentration=2)],
            events=[d.event("E", "time > 1", {"S": "5", "C": "2*C"})],
        )
    )
    trajectory = model.problem(time=(0, 2)).trajectory([0.5, 1.5])
    assert trajectory["C"].tolist() == [2, 4]
    assert trajectory["S_amount"] == pytest.approx([4, 20])


# -- events ---------------------------------------------------------------------------------------


def clock(*events, names=("x", "y"), rate="1"):
    """A parameter ``c`` that grows as time does, and others that only events reset."""
    return d.document(
        parameters=[d.parameter("c", 0, False), *(d.parameter(n, 0, False) for n in names)],
        rules=[d.rate_rule("c", rate)],
        events=events,
    )


@pytest.mark.parametrize(
    ("events", "expected"),
    [
        # conditions
        ([d.event("E", "c > 1 && time < 5", {"x": "c"})], [0, 1, 1, 1]),
        ([d.event("E", "c > 7 || (c >= 2 && !(c > 2.5))", {"x": "x + 1"})], [0, 0, 1, 1]),
        ([d.event("E", "c > 1", {"x": "1"}), d.event("F", "x >= 1 && c > 0", {"y": "2"})], None),
        # the start
        ([d.event("E", "c < 1", {"x": "3"}, before=False)], [3, 3, 3, 3]),
        ([d.event("E", "c < 1", {"x": "3"})], [0, 0, 0, 0]),
        ([d.event("E", "c > 0", {"x": "3"})], [3, 3, 3, 3]),
        ([d.event("E", "time >= 0", {"x": "3"})], [0, 0, 0, 0]),
        ([d.event("E", "time >= 0", {"x": "3"}, before=False)], [3, 3, 3, 3]),
        # delays
        ([d.event("E", "c > 0.5", {"x": "c"}, delay="1")], [0, 0, 0.5, 0.5]),
        ([d.event("E", "c > 0.5", {"x": "c"}, delay="1", at_trigger=False)], [0, 0, 1.5, 1.5]),
        (
            [
                d.event("E", "c > 0.5 && x < 1", {"y": "3"}, delay="1", persistent=False),
                d.event("F", "c > 1.2", {"x": "1"}),
            ],
            [0, 0, 1, 1],
        ),
        # one instant: values at the trigger, and by priority
        (
            [
                d.event("E", "c > 0.5", {"x": "7"}, priority="2"),
                d.event("F", "c > 0.5", {"x": "x + 1"}, priority="1"),
            ],
            [0, 1, 1, 1],
        ),
        (
            [
                d.event("E", "c > 0.5", {"x": "7"}, priority="2"),
                d.event("F", "c > 0.5", {"x": "x + 1"}, priority="1", at_trigger=False),
            ],
            [0, 8, 8, 8],
        ),
    ],
)
def test_events(read, events, expected):
    """The value of x at times 0, 1.1, 2.2 and 3.3; the events happen in between."""
    problem = read(clock(*events)).problem(time=(0, 4))
    trajectory = problem.trajectory([0.0, 1.1, 2.2, 3.3])
    if expected is None:
        np.testing.assert_allclose(trajectory["y"], [0, 2, 2, 2])
    else:
        np.testing.assert_allclose(trajectory["x"], expected, atol=1e-8)


def test_a_trigger_that_parameters_decide(read):
    """The event is at the start for c0 > 1 alone."""
    model = read(
        d.document(
            parameters=[d.parameter(n, 0.5, False) for n in ("c", "x")],
            rules=[d.rate_rule("c", "0.1")],
            events=[d.event("E", "c > 1", {"x": "9"}, before=False)],
        )
    )
    problem = model.problem({"c_0": (0.5, 2.0)}, time=(0, 1))
    assert [problem.trajectory(1.0, c_0=c)["x"] for c in (0.7, 1.5)] == [0.5, 9.0]


@pytest.mark.parametrize(("trigger", "expected"), [("Q > 1.4", 0.0), ("Q > 0.7", 9.0)])
def test_a_trigger_of_what_never_changes(read, trigger, expected):
    """Its numbers tell whether it happens at the start."""
    model = read(
        d.document(
            compartments=[d.compartment()],
            species=[d.species("S", concentration=1), d.species("Q", amount=1, boundary=True)],
            parameters=[d.parameter("k", 0.5), d.parameter("x", 0, False)],
            reactions=[d.reaction("R", ["S"], ["Q"], "k*S*C")],
            events=[d.event("E", trigger, {"x": "9"}, before=False)],
        )
    )
    assert model.problem(["k"], spread=2, time=(0, 1)).trajectory(1.0, k=0.5)["x"] == expected


def waving(delay, **options):
    """A sine that sets off an event each 2 pi, from pi/6 on, which keeps the time for a delay."""
    return d.document(
        parameters=[d.parameter("s", 0, False), d.parameter("x", 0, False), d.parameter("k", 5)],
        rules=[d.rate_rule("s", "cos(time)")],
        events=[d.event("E", options.pop("trigger", "s > 0.5"), {"x": "time"}, delay, **options)],
    )


OVERLAP = "event `E` is set off again at t = 6.806.*while an earlier one.*useValuesFromTriggerTime"


def test_values_taken_at_overlapping_triggers_are_no_solution(read):
    problem = read(waving("k")).problem({"k": (6.5, 7.5)}, time=(0, 14))
    with pytest.raises(ProblemError, match=OVERLAP):
        problem.trajectory([10.0], k=7.0)
    with pytest.raises(ProblemError, match=OVERLAP):
        ro.solve(problem, rtol=1e-3)


@pytest.mark.parametrize(
    ("options", "delay", "expected"),
    [
        ({}, 5.0, [0, np.pi / 6, np.pi * 13 / 6]),
        ({"at_trigger": False}, 7.0, [0, 0, np.pi / 6 + 7]),
        ({"persistent": False}, 7.0, [0, 0, 0]),
    ],
)
def test_repeated_triggers_without_overlap(read, options, delay, expected):
    problem = read(waving("k", **options)).problem(["k"], spread=1.5, time=(0, 14))
    np.testing.assert_allclose(problem.trajectory([0.5, 6.0, 13.0], k=delay)["x"], expected)


def test_a_trigger_at_the_start_and_one_during_its_delay(read):
    """The first values, at 0, are set at 5; the next ones, of 5/6 pi, 5 later."""
    model = read(waving("k", trigger="s < 0.5", before=False))
    x = model.problem(time=(0, 8)).trajectory([4.9, 5.1, 7.5, 7.7])["x"]
    np.testing.assert_allclose(x, [0, 0, 0, np.pi * 5 / 6])


# -- problems -------------------------------------------------------------------------------------


@pytest.fixture
def chain(read):
    """A -> B -> with rates k and q."""
    return read(
        d.document(
            compartments=[d.compartment()],
            species=[d.species("A", amount=2.0), d.species("B", amount=0.0)],
            parameters=[d.parameter("k", 0.5), d.parameter("q", 0.2), d.parameter("unused", 1.0)],
            reactions=[d.reaction("R", ["A"], ["B"], "k*A*C"), d.reaction("Q", ["B"], [], "q*B*C")],
        )
    )


def test_a_model_is_solved(chain):
    solution = ro.solve(chain.problem(["k", "q"], spread=1.5, time=(0, 5)), rtol=1e-6)
    assert solution.success
    assert solution.parameters == {"k": (0.5 / 1.5, 0.75), "q": (0.2 / 1.5, 0.2 * 1.5)}
    for k, q in [(0.35, 0.29), (0.7, 0.15)]:
        exact = scipy.integrate.solve_ivp(
            lambda _, u, k=k, q=q: [-k * u[0], k * u[0] - q * u[1]], (0, 5), [2, 0], rtol=1e-10
        ).y[:, -1]
        np.testing.assert_allclose(solution(t=5.0, k=k, q=q), exact, rtol=5e-6)


def test_constants_and_definitions_of_the_problem(chain):
    problem = chain.problem({"k": (0.1, 1.0)}, time=(0, 1))
    assert problem.set(q=0.0).trajectory(1.0, k=0.3)["B"] == pytest.approx(2 - 2 * np.exp(-0.3))
    assert {str(symbol) for symbol in problem.vary(q=(0.1, 0.3)).parameters} == {"k", "q"}
    assert "unused" in {str(symbol) for symbol in problem.constants}
    assert {str(symbol) for symbol in problem.definitions} == {"R", "Q"}


def test_initial_values_and_distributions(chain):
    problem = chain.problem({"A_0": (1, 3), "k": "norm(0.5, 0.01)"}, time=(0, 1))
    assert problem.trajectory(0.0, A_0=2.5, k=0.5)["A"] == 2.5


def test_the_text_of_a_model(chain):
    text = repr(chain)
    assert "Model 'm': 2 unknowns, 6 parameters, 0 events" in text
    assert "dA/dt = -R/C" in text


@pytest.mark.parametrize(
    ("parameters", "options", "words"),
    [
        ({"kk": (0, 1)}, {}, "no parameter `kk`.*`k`"),
        ({"A": (0, 1)}, {}, "`A`: it is an unknown; remedy: vary `A_0`"),
        ({"R": (0, 1)}, {}, "`R`: it is computed from others.*vary.*`k`"),
        (["k"], {}, "names without intervals.*spread=1.5"),
        (["B_0"], {"spread": 2.0}, "`B_0` is 0 in the file"),
        (["k"], {"spread": 1.0}, "spread"),
        (["k"], {"spread": 0.5}, "spread"),
        ({"k": (1, 2)}, {"spread": 2.0}, "`spread` is for a list of names"),
        ("k", {"spread": 2.0}, "neither a mapping nor a list"),
        ({"k": (2, 1)}, {}, "reversed"),
    ],
)
def test_wrong_parameters(chain, parameters, options, words):
    with pytest.raises(ro.RankoneError, match=words):
        chain.problem(parameters, time=(0, 1), **options)


@pytest.mark.parametrize("time", [5, (0,), (0, "1"), (0, np.inf), (2, 1)])
def test_wrong_time(chain, time):
    with pytest.raises(ProblemError, match="time"):
        chain.problem(time=time)


# -- what is refused ------------------------------------------------------------------------------


def changing(*rules, names=("x",), **lists):
    return d.document(parameters=[d.parameter(n, 1, False) for n in names], rules=[*rules], **lists)


FAST = d.document(
    version=1,
    compartments=[d.compartment()],
    species=[d.species("A", amount=1.0)],
    reactions=[d.reaction("R", ["A"], [], "A*C", more=' fast="true"')],
)
LAWLESS = d.document(
    compartments=[d.compartment()],
    species=[d.species("A", amount=1.0)],
    reactions=[
        '<reaction id="R" reversible="false"><listOfReactants>'
        f"{d.reference('A')}</listOfReactants></reaction>"
    ],
)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (changing(d.rate_rule("x", "delay(x, 1)")), "rate rule of `x`.*delay"),
        (FAST, "reaction `R` is fast"),
        (LAWLESS, "reaction `R` has no kinetic law"),
        (changing(d.rate_rule("x", "y")), "rate rule of `x`.*unknown name `y`"),
        (changing(d.rate_rule("x", "f(x)")), "rate rule of `x`.*unknown function `f`"),
        (
            changing(d.rate_rule("x", "f(x)"), functions=[d.function("f", "lambda(a, f(a))")]),
            "function `f`, which calls itself",
        ),
        (
            changing(d.rate_rule("x", "f(x)"), functions=[d.function("f", "lambda(a, b, a)")]),
            "`f` with 1 argument.* instead of 2",
        ),
        (changing(d.rate_rule("x", "inf")), "rate rule of `x`.*number inf"),
        (
            changing(
                d.assignment_rule("x", "y"), d.assignment_rule("y", "x"), names=("x", "y", "z")
            ),
            "circle: `x` needs `y`, `y` needs `x`",
        ),
        (
            changing(d.assignment_rule("x", "time")),
            "rules alone, for `x`: nothing",
        ),
        (
            changing(d.rate_rule("x", "rateOf(y)"), d.algebraic_rule("y*y - x"), names=("x", "y")),
            "rate of change of `y`, which an algebraic rule",
        ),
        (
            changing(d.rate_rule("x", "1"), d.algebraic_rule("y + z - x"), names=("x", "y", "z")),
            "algebraic rule `2`: 1 rule.*`y` and `z`",
        ),
        (clock(d.event("E", "c == 1", {"x": "1"})), "event `E` compares.*continuously"),
        (
            clock(
                d.event("E", "c > 1", {"x": "1"}, priority="1"),
                d.event("F", "c > 1", {"x": "2"}, priority="1"),
            ),
            "event `E` and event `F`.*chance",
        ),
        (
            clock(d.event("E", "c < 1", {"x": "1"}, "1", before=False, persistent=False)),
            "event `E`.*delay from the start",
        ),
        (
            d.document(
                parameters=[d.parameter("x", 1, False), d.parameter("k")],
                rules=[d.rate_rule("x", "-k*x")],
            ),
            "no value for `k`",
        ),
        (
            changing(d.rate_rule("x", "1"), assignments=[d.initial_assignment("x", "x + 1")]),
            "initial value of `x` depends on itself",
        ),
        ("<sbml", "not readable SBML: line 1"),
        (d.document().replace("<model ", "<medel ").replace("</model", "</medel"), "SBML"),
        (
            changing(d.rate_rule("x", "1")).replace(
                "<sbml ",
                '<sbml xmlns:q="http://www.sbml.org/sbml/level3/version1/spatial/version1" '
                'q:required="true" ',
            ),
            "package `spatial`",
        ),
    ],
)
def test_refusals_name_the_element(read, text, words):
    with pytest.raises(ProblemError, match=words):
        read(text).problem(time=(0, 3))


def test_a_missing_number_may_be_given(read):
    model = read(
        d.document(
            parameters=[d.parameter("x", 1, False), d.parameter("k")],
            rules=[d.rate_rule("x", "-k*x")],
        )
    )
    problem = model.problem({"k": (1, 2)}, time=(0, 1))
    assert problem.trajectory(1.0, k=2.0)["x"] == pytest.approx(np.exp(-2.0))
    with pytest.raises(ProblemError, match="no value for `k`"):
        model.problem(["k"], spread=2.0, time=(0, 1))


def test_files_and_packages(tmp_path, monkeypatch):
    with pytest.raises(ProblemError, match="there is no file"):
        ro.read_sbml(tmp_path / "none.xml")
    with pytest.raises(ProblemError, match="neither an SBML nor an Antimony file"):
        ro.read_sbml(tmp_path / "model.csv")
    path = tmp_path / "model.xml"
    path.write_text(d.document(), encoding="utf-8")
    monkeypatch.setitem(sys.modules, "libsbml", None)
    with pytest.raises(ProblemError, match="pip install python-libsbml"):
        ro.read_sbml(path)


def test_external_models_beside_a_file_in_another_folder(tmp_path, monkeypatch):
    folder = tmp_path / "models"
    folder.mkdir()
    inner = d.document(parameters=[d.parameter("x", 1, False)], rules=[d.rate_rule("x", "-2*x")])
    (folder / "inner.xml").write_text(inner, encoding="utf-8")
    (folder / "outer.xml").write_text(
        f'''<?xml version="1.0" encoding="UTF-8"?>
<sbml xmlns="{d.CORE}" level="3" version="2" comp:required="true"
  xmlns:comp="http://www.sbml.org/sbml/level3/version1/comp/version1">
  <model id="outer"><comp:listOfSubmodels>
    <comp:submodel comp:id="A" comp:modelRef="E"/></comp:listOfSubmodels></model>
  <comp:listOfExternalModelDefinitions>
    <comp:externalModelDefinition comp:id="E" comp:source="inner.xml"/>
  </comp:listOfExternalModelDefinitions>
</sbml>''',
        encoding="utf-8",
    )
    monkeypatch.chdir(tmp_path)
    problem = ro.read_sbml("models/outer.xml").problem(time=(0, 1))
    assert problem.trajectory(1.0)["A__x"] == pytest.approx(np.exp(-2.0))


def test_antimony(read, monkeypatch):
    text = "model m\n S1 -> S2; k*S1\n S1 = 2\n k = 0.5\n S2 = 0\nend\n"
    if "antimony" not in sys.modules:
        pytest.importorskip("antimony", reason="needs antimony: pip install antimony")
    times, s1 = values(read(text, ".ant"), 2.0, "S1")
    np.testing.assert_allclose(s1, 2 * np.exp(-0.5 * times), rtol=1e-7)
    with pytest.raises(ProblemError, match="not readable Antimony"):
        read("model m\n S1 -> ; ; k*\nend\n", ".ant")
