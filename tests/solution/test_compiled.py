"""The pipeline object: stages, timings, pickling, errors."""

import inspect
import itertools
import pickle
import types

import numpy as np
import pytest

import rankone as ro
from tests.problems import REFERENCE


def test_every_stage_can_be_looked_at():
    compiled = ro.compile(REFERENCE["lotka_volterra"]())
    assert "dx/dt" in str(compiled.weak_form)
    assert "x*y" in str(compiled.separated)
    assert "def rhs(" in compiled.source
    assert set(compiled.timings) == {
        *("first order", "weak form", "separation", "lowering", "code generation", "import"),
        "agreement",
    }
    assert "x, y" in repr(compiled)


def test_timings_of_a_solution_begin_with_building_the_problem(monkeypatch):
    """With reading texts, which comes before the checks."""
    ticks = itertools.count()
    clock = types.SimpleNamespace(perf_counter=lambda: next(ticks))
    monkeypatch.setattr("rankone.problem.problem.clock", clock)
    problem = ro.Problem.from_strings(
        {"x": "-k*x"}, {"x": "x0"}, {"k": (1, 2), "x0": (8, 12)}, (0, 1)
    )
    assert problem.seconds == 3
    assert ro.Problem(**problem.written).seconds == 1
    solution = ro.solve(problem, 1e-4)
    assert solution.timings["problem"] == problem.seconds
    assert list(solution.timings)[:2] == ["problem", "compile"]
    assert problem.set(x0=9.0).seconds == 3
    assert solution.restrict(x0=(8, 9)).timings["problem"] == problem.seconds


def test_a_compiled_problem_survives_pickling_and_solves_the_same():
    compiled = ro.compile(REFERENCE["coupled"]())
    again = pickle.loads(pickle.dumps(compiled))
    assert again.source == compiled.source
    one, two = compiled.solve(1e-4), again.solve(1e-4)
    names = dict(zip(one.parameters, (0.7, 1.1, 1.3)))
    np.testing.assert_array_equal(one(t=0.4, **names), two(t=0.4, **names))


def test_the_generated_module_is_found_in_tracebacks():
    system = ro.compile(REFERENCE["decay"]()).system
    with pytest.raises(ValueError, match="unpack"):
        system.rhs(0.0, [1.0, 2.0], [1.0])


def test_compile_wants_a_problem():
    with pytest.raises(ro.OptionError, match=r"rankone\.Problem"):
        ro.compile("x' = -x")


def test_compiling_warns_of_a_parameter_that_appears_nowhere():
    with pytest.warns(ro.RankoneWarning, match="unused"):
        problem = ro.Problem.from_strings(
            rhs={"x": "-k*x"},
            initial={"x": 1},
            parameters={"k": (1, 2), "unused": (0, 1)},
            time=(0, 1),
        )
    solution = ro.solve(problem, rtol=1e-6)
    assert solution.success
    assert solution["x"](t=1.0, k=1.5, unused=0.3) == pytest.approx(np.exp(-1.5), rel=1e-5)


@pytest.mark.parametrize(
    ("arguments", "options", "message"),
    [
        ((1e-3,), {"preset": "slides"}, "'preset' belongs to method='greedy', not to method='auto"),
        ((1e-3,), {"method": "greedy", "max_rank": 3}, "'max_rank' belongs to method='train'"),
        (
            (1e-3,),
            {"on_failur": "raise"},
            r"did you mean `on_failure`\?.*solve itself takes rtol, ",
        ),
    ],
)
def test_options_of_solve_that_are_refused(arguments, options, message):
    problem = ro.Problem.from_strings({"x": "-k*x"}, {"x": "1"}, {"k": (1, 2)}, time=(0, 1))
    with pytest.raises(ro.OptionError, match=message):
        ro.solve(problem, *arguments, **options)


def test_all_but_the_tolerance_is_given_by_keyword(tmp_path):
    problem = ro.Problem.from_strings({"x": "-k*x"}, {"x": "1"}, {"k": (1, 2)}, time=(0, 1))
    for name, call in (
        ("solve", lambda: ro.solve(problem, 1e-3, "greedy")),
        ("compile", lambda: ro.compile(problem, 1e-3)),
        ("CompiledProblem.solve", lambda: ro.compile(problem).solve(1e-3, "greedy")),
        ("export", lambda: ro.compile(problem).export(tmp_path / "solver.py", "greedy")),
        ("solve_many", lambda: ro.solve_many(problem, problem.split(k=2), 1e-3, 2)),
    ):
        with pytest.raises(TypeError, match=rf"{name}\(\) takes .* positional argument"):
            call()


def test_signatures_show_the_options_of_a_solve_with_their_defaults():
    own = inspect.signature(ro.CompiledProblem.solve).parameters
    options = [p for p in own.values() if p.kind in (p.KEYWORD_ONLY, p.VAR_KEYWORD)]
    shown = inspect.signature(ro.solve).parameters
    assert list(shown) == ["problem", "rtol", *(p.name for p in options)]
    assert all(shown[p.name] == p for p in options)
    assert inspect.signature(ro.solve_many).parameters["effort"].default == "normal"
    assert ro.solve.__name__ == "solve"
    assert "\nproblem : Problem" in ro.solve.__doc__
    assert '\neffort : {"low", "normal", "high"}' in ro.solve.__doc__
    assert pickle.loads(pickle.dumps(ro.solve)) is ro.solve


def test_the_keywords_of_solve_are_those_of_its_errors():
    problem = ro.Problem.from_strings({"x": "-k*x"}, {"x": "1"}, {"k": (1, 2)}, time=(0, 1))
    compiled = ro.compile(problem)
    parameters = inspect.signature(compiled.solve).parameters.values()
    wanted = {p.name for p in parameters if p.kind not in (p.VAR_KEYWORD, p.VAR_POSITIONAL)}
    with pytest.raises(ro.OptionError) as caught:
        compiled.solve(zzz=1)
    assert set(str(caught.value).split("solve itself takes ")[1].split(", ")) == wanted
