"""Hostile input: the right answer or a clear error, soon."""

import errno
import os
import shutil
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
import sympy as sp

import rankone as ro
from rankone.share.commands.common import load_problem

t, k = sp.symbols("t k")
x = sp.Function("x")(t)


def text(rate, box=None, initial="1", time=(0, 1), **more):
    return ro.Problem.from_strings(
        {"x": rate}, {"x": initial}, {"k": (0, 1)} if box is None else box, time, **more
    )


def plain(equation=None, **more):
    given = {"time": (t, 0, 1), "parameters": {k: (0, 1)}, "initial": {x: 1}, **more}
    return ro.Problem([sp.Eq(x.diff(t), -k * x) if equation is None else equation], **given)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: plain(name=3), "the name is 3, not text"),
        (lambda: plain(name="\ud800"), "not text"),
        (lambda: plain(name="a\0b"), "not text in one line"),
        (lambda: plain(parameters={sp.Symbol("\ud800"): (0, 1)}), "not text that can be printed"),
        (lambda: plain(parameters={sp.Symbol("c\nexit()#"): (0, 1)}), "printed in one line"),
        (lambda: plain(parameters={sp.Symbol(" "): (0, 1)}), "printed in one line"),
        (
            lambda: plain(sp.Eq(sp.MatrixSymbol("A", 1, 1), sp.Matrix([-k * x]))),
            "entries that are not written out",
        ),
        (lambda: plain(time=(t, 0, 5e-324)), "too short"),
        (lambda: plain(parameters={k: (0, 5e-324)}), "too narrow"),
        (lambda: text(f"max({','.join(f'x - {i}*k' for i in range(200))})"), "200 arguments"),
        (lambda: text("Piecewise()"), "`Piecewise` has no branch"),
        (lambda: text("Piecewise((1, t), (2, True))"), "`t` is not a condition"),
        (lambda: text("Piecewise(1, 2)"), "is not a branch of a Piecewise"),
        (lambda: text("(t > 1)*x"), "not understood"),
    ],
)
def test_a_problem_that_is_none(make, said):
    with pytest.raises(ro.ProblemError, match=said):
        make()


@pytest.mark.parametrize(
    ("rate", "box", "said"),
    [
        ("(k + 1)**1000000*x", {"k": (0, 1)}, "not finite"),
        ("sin(10**30*t)*x*k", {"k": (0, 1)}, "varies too fast for time|as it is written"),
        ("k*x*floor(1e6*t)", {"k": (0, 1)}, "switches 1000000 times"),
        ("-k*x", {"k": (-1e308, 1e308)}, "not finite"),
    ],
)
def test_a_coefficient_that_is_hopeless(rate, box, said):
    with pytest.raises(ro.RankoneError, match=said):
        ro.solve(text(rate, box))


@pytest.mark.parametrize("rate", ["-(a + b + c + x + t)**24", "-(a + b + c + x + t)**16"])
def test_a_power_of_thousands_of_terms_stays_as_it_is(rate):
    compiled = ro.compile(text(rate, dict.fromkeys("abc", (0, 1))))
    (term,) = compiled.separated.general
    assert "too many terms" in term.reason
    assert compiled.solve(1e-3).success


@pytest.mark.slow
def test_a_power_beyond_all_reason_is_not_expanded():
    compiled = ro.compile(text("x**99999999*k"))
    assert len(compiled.source) < 10_000
    with pytest.raises(ro.BlowUpError):
        compiled.solve(1e-3)


def test_piecewise_in_text_is_that_of_sympy():
    given = text("-k*x + Piecewise((1, (t > 0.2) & (t < 0.4)), (2*x, 0.5 < t <= 0.7), (0, True))")
    branches = (1, (t > 0.2) & (t < 0.4)), (2 * x, (t > 0.5) & (t <= 0.7)), (0, True)
    same = plain(sp.Eq(x.diff(t), -k * x + sp.Piecewise(*branches)))
    one, two = ro.solve(given, 1e-6), ro.solve(same, 1e-6)
    assert one.success
    np.testing.assert_allclose(one(t=0.9, k=0.3), two(t=0.9, k=0.3), rtol=1e-9)


@pytest.fixture(scope="module")
def solution():
    return ro.solve(plain(), 1e-3)


def test_a_number_beyond_floats(solution):
    with pytest.raises(ro.EvaluationError, match="`k` is 1000000"):
        solution(t=0.5, k=10**400)


def test_more_values_than_memory(solution):
    times, values = np.linspace(0, 1, 300_000)[:, None], np.linspace(0, 1, 300_000)[None, :]
    with pytest.raises(ro.EvaluationError, match=r"all values take|no memory for all values"):
        solution(t=times, k=values)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_pipe_is_not_replaced(solution, tmp_path):
    pipe = tmp_path / "u.npz"
    os.mkfifo(pipe)
    with pytest.raises(ro.StorageError, match="not a regular file"):
        solution.save(pipe, overwrite=True)
    assert pipe.is_fifo()


ODD = [3, "x", b"x", np.zeros((2, 2)), object(), {1: 2}, "\ud800", 10**400, float("nan"), sp.I]


@pytest.mark.parametrize(
    "call",
    [
        lambda value: ro.Problem(value, (t, 0, 1), {k: (1, 2)}, {x: 1}),
        lambda value: ro.Problem([value], (t, 0, 1), {k: (1, 2)}, {x: 1}),
        lambda value: plain(time=value),
        lambda value: plain(parameters=(value,)),
        lambda value: plain(parameters={k: value}),
        lambda value: ro.compile(plain()).solve(1e-3, method=value),
        lambda value: ro.compile(plain()).solve(1e-3, cover=value),
        lambda value: ro.compile(plain()).solve(1e-3, on_failure=value),
        lambda value: ro.compile(plain()).solve(1e-3, max_rank=(value,)),
        lambda value: ro.compile(plain()).solve(1e-3, basis=value),
        lambda value: ro.table([1, 2], [1, 2], kind=value),
        lambda value: ro.load(value),
    ],
)
def test_odd_values_are_named(call):
    taken = []
    for value in ODD:
        try:
            call(value)
        except ro.RankoneError:
            continue
        taken.append(value)
    assert not taken


@pytest.mark.parametrize(
    ("rate", "said"),
    [
        ("exp(" * 100 + "x" + ")" * 100, "nested more than 24 deep"),
        ("floor(10**400*t)*x", "too large a number"),
        ("Mod(t, 0)*x", "has no value"),
        ("x + 2**2000*k", "too large a number"),
    ],
)
def test_formulas_that_are_hopeless(rate, said):
    with pytest.raises(ro.ProblemError, match=said):
        ro.Problem.from_strings({"x": rate}, {"x": "1"}, {"k": (1, 2)}, (0, 1))


def test_names_that_python_reads_alike():
    box = {"\N{MICRO SIGN}": (1, 2), "\N{GREEK SMALL LETTER MU}": (3, 4)}
    with pytest.raises(ro.ProblemError, match="two names that Python reads as"):
        ro.Problem.from_strings({"x": "-x"}, {"x": "1"}, box, (0, 1))
    box.popitem()
    problem = ro.Problem.from_strings({"x": "-\N{MICRO SIGN}*x"}, {"x": "1"}, box, (0, 1))
    assert ro.solve(problem, 1e-3).success


@pytest.mark.parametrize(("start", "width"), [(100, 1e-13), (1000, 1e-12)])
def test_a_pulse_of_few_floating_point_numbers_is_refused(start, width):
    rate = f"-k*x + Piecewise((1/{width}, (t > {start}) & (t < {start} + {width})), (0, True))"
    problem = ro.Problem.from_strings({"x": rate}, {"x": "1"}, {"k": (0.01, 0.02)}, (0, 2 * start))
    with pytest.raises(ro.OptionError, match=r"a pulse for time .* is too short"):
        ro.solve(problem, 1e-5)


def test_a_spent_budget_is_named():
    rate = "-x + abs(a + b + c - 1.5)"
    problem = ro.Problem.from_strings({"x": rate}, {"x": "1"}, dict.fromkeys("abc", (0, 1)), (0, 2))
    solution = ro.solve(problem, 1e-8, effort=0.01)
    assert solution.status is ro.Status.WORK_LIMIT
    assert "the budget of work was reached" in solution.message


@pytest.mark.slow
def test_what_ends_a_solve_is_named_though_an_earlier_attempt_is_better():
    """The limit of trajectories, not the error."""
    problem = ro.Problem.from_strings(
        {"x": "-x + abs(a + b + c - 1.5)"}, {"x": "1"}, dict.fromkeys("abc", (0, 1)), (0, 2)
    )
    solution = ro.solve(problem, 1e-6, method="cross", max_trajectories=20_000)
    assert solution.status is ro.Status.TRAJECTORY_LIMIT
    assert "raise max_trajectories" in solution.message
    assert solution.error < 0.5  # and not that of the trajectory at the centre


def test_states_whose_products_are_lost():
    small = "1e-170"
    rates = {"x": f"x*(1.5 - y/{small})", "y": f"-y*(3 - x/{small})"}
    starts = {"x": f"a*{small}", "y": f"b*{small}"}
    problem = ro.Problem.from_strings(rates, starts, {"a": (8, 12), "b": (4, 6)}, (0, 6))
    with pytest.raises(ro.ConvergenceError, match="its products are not floating-point numbers"):
        ro.solve(problem, 1e-5)


@pytest.mark.parametrize(
    ("rate", "start", "said"),
    [("k*x*1e308", "1", "derivative at the start"), ("-k*x", "1e308*k", "initial value")],
)
def test_starts_that_are_not_finite(rate, start, said):
    problem = ro.Problem.from_strings({"x": rate}, {"x": start}, {"k": (1, 3)}, (0, 1))
    with pytest.raises(ro.RankoneError, match=f"the {said} of `x` is not finite"):
        ro.solve(problem, 1e-3)


def test_the_time_limit_is_looked_at_in_every_call_of_a_slow_function():
    calls = []

    def value(u):
        calls.append(u)
        time.sleep(0.1)
        return u

    slow = ro.function("slow", value, np.ones_like)
    solution = ro.solve(plain(sp.Eq(x.diff(t), -k * slow(x))), 1e-3, max_seconds=1)
    assert not solution.success
    assert len(calls) < 40  # a first step alone takes a dozen, and an integration hundreds


def test_counts_that_no_memory_holds():
    solution = ro.solve(text("-k*x"), 1e-3)
    for ask in (
        lambda: solution.sample(10**12),
        lambda: solution.quantile(0.5, 1.0, count=10**9),
        lambda: solution.density(1.0, count=10**30),
        lambda: solution.probability(1.0, above=0.5, count=10**9),
        lambda: solution.main_effects(1.0, count=10**9),
    ):
        with pytest.raises(ro.OptionError, match="choose an integer from"):
            ask()
    with pytest.raises(ro.OptionError, match="choose an integer from"):
        ro.GreedyOptions(parameter_nodes=10**30)


@pytest.mark.parametrize("length", [243, 244, 250, 255, 256, 260, 5000])
def test_names_of_files_of_any_length(length, tmp_path):
    """Written, or refused as too long, and nothing beside is left."""
    solution = ro.solve(text("-k*x"), 1e-3)
    for suffix in (".npz", ".nc", ".c", ".html"):
        path = tmp_path / ("a" * (length - len(suffix)) + suffix)
        write = solution.save if suffix in (".npz", ".nc") else solution.export
        if length > 255:
            with pytest.raises((ro.StorageError, ro.ExportError), match="too long"):
                write(path)
        else:
            write(path)
            path.with_suffix(".h").unlink(missing_ok=True)
            path.unlink()
    assert not list(tmp_path.iterdir())
    with pytest.raises(ro.StorageError, match=r"there is no file|cannot be read"):
        ro.load(tmp_path / ("a" * length))
    with pytest.raises(ro.ProblemError, match=r"there is no file|cannot be read"):
        load_problem(tmp_path / ("a" * (length - 5) + ".toml"))


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler (cc)")
@pytest.mark.parametrize("full", ["write_text", "fsync"])
def test_an_fmu_on_a_full_disk(full, tmp_path, monkeypatch):
    solution = ro.solve(text("-k*x"), 1e-3)

    def refuse(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(*((os, full) if full == "fsync" else (Path, full)), refuse)
    with pytest.raises(ro.ExportError, match="No space left"):
        solution.export(tmp_path / "model.fmu")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("where", ["rate", "initial", "state"])
def test_the_absolute_value_of_a_remainder(where):
    """SymPy differentiates it without end where symbols may be complex."""
    given = f"exp(Abs(Mod({'x' if where == 'state' else 'k'}-246.043,2.48))/2.71)"
    problem = text("-k*x", initial=given) if where == "initial" else text(f"{given} - x")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ro.RankoneWarning)
        compiled = ro.compile(problem)
    p, u = np.array([0.3]), np.array([0.7])
    factor = np.exp(np.mod((0.7 if where == "state" else 0.3) - 246.043, 2.48) / 2.71)
    if where == "initial":
        values = compiled.system.parameter_factors(0, p)
        assert np.isclose(values, factor, rtol=1e-12).any()
    else:
        assert compiled.system.rhs(0.0, u, p)[0] == pytest.approx(factor - 0.7, rel=1e-12)


@pytest.mark.slow
def test_long_sums_of_text():
    """Like terms gather; sums of others are compiled up to a length that is named."""
    compiled = ro.compile(text("+".join("k*x" for _ in range(6_000))))
    assert compiled.system.rhs(0.0, np.array([2.0]), np.array([0.5]))[0] == 6_000.0
    signs = "".join(f"{'-' if i % 3 else '+'}{i}e-1*x" for i in range(1, 1200))
    exact = sum((-i if i % 3 else i) for i in range(1, 1200)) / 10
    rate = ro.compile(text(f"k{signs}")).system.rhs(0.0, np.array([1.0]), np.array([0.5]))[0]
    assert rate == pytest.approx(0.5 + exact, rel=1e-12)
    rates = "+".join(f"{i}*k**{i}" for i in range(1, 251))
    value = ro.compile(text(rates)).system.rhs(0.0, np.array([1.0]), np.array([0.5]))[0]
    assert value == pytest.approx(2.0, rel=1e-12)


@pytest.mark.slow
def test_sums_that_are_too_long():
    with pytest.raises(ro.ProblemError, match="equation 1: a sum has 6000 terms; at most 5000"):
        text("+".join(f"k**{i}" for i in range(1, 6001)))
    with pytest.raises(ro.ProblemError, match="a sum of more than 500 terms"):
        text(f"x*({'+'.join(f'k**{i}' for i in range(1, 6001))})")
    with pytest.raises(ro.ProblemError, match="nested too deep"):
        text("x" + "**k" * 400)


ENDLESS = "exp(exp(exp(exp(100))))"


@pytest.mark.parametrize(
    "call",
    [
        lambda huge: text(f"-k*x + {ENDLESS}"),
        lambda huge: text(f"-k*x/{ENDLESS}"),
        lambda huge: text("-k*x", initial=ENDLESS),
        lambda huge: text("-k*x", jumps={0.5: {"x": ENDLESS}}),
        lambda huge: plain(initial={x: huge}),
        lambda huge: plain(time=(t, 0, huge)),
        lambda huge: plain(parameters={k: (1, huge)}),
        lambda huge: text("-k*x + 10**10**10**10"),
        lambda huge: text("-k*x + (2.71828*x)**123456.5"),
        lambda huge: text("-k*x + cosh(exp(30))"),
    ],
)
def test_numbers_beyond_all_reason_are_refused_at_once(call):
    huge = sp.exp(sp.exp(sp.exp(sp.exp(100))))
    with pytest.raises(ro.ProblemError, match=r"out of the range|too large a number|not a real"):
        ro.compile(call(huge))


@pytest.mark.parametrize(
    "rate",
    [
        "1/(1 + (k/x)**300) - x",
        "1/(1 + (x/k)**-200) - x",
        "1/(1 + exp((k + c + d)/0.03)) - x",
        "1/(1 + exp((t - k)/0.013712345678901234)) - x",
        "1/(exp((t - k)/0.0137) + exp((k - t)/0.0137) - 1) - x",
    ],
)
def test_high_powers_are_not_factored(rate):
    ro.compile(text(rate, box={"k": (0.5, 1), "c": (0, 1), "d": (0, 1)}, initial="0.8"))
