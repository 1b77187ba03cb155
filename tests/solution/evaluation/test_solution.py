"""What a solution says about itself; partial solutions; pickling; the canonical form."""

from __future__ import annotations

import copy
import math
import pickle
from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

from rankone.solution.solution import Solution
from rankone.support.errors import EvaluationError, RankoneWarning
from rankone.trajectories.system.verdict import Remedy, Status
from tests.solution.evaluation.functions import decay, oscillator, two_unknowns

SOLUTION = two_unknowns().solution


def test_attributes() -> None:
    assert SOLUTION.success
    assert SOLUTION.status is Status.CONVERGED
    assert SOLUTION.error == 2e-7
    assert SOLUTION.errors == {"x": 1e-7, "y": 2e-7}
    assert SOLUTION.corner_error == 4e-7
    assert SOLUTION.ranks == ((3, 3),) * 3
    assert SOLUTION.rank == 3
    assert SOLUTION.nodes == (14, 15)
    assert SOLUTION.rtol == 1e-6
    assert SOLUTION.unknowns == ("x", "y")
    assert SOLUTION.parameters == {"x0": (-1.0, 1.0), "y0": (2.0, 3.0)}
    assert SOLUTION.time == (0.0, 3.0)
    assert [record.attempt for record in SOLUTION.history] == [0, 1]
    assert SOLUTION.timings == {"reference": 0.01, "march": 0.25, "check": 0.125}


def test_error_is_the_largest_of_all_states() -> None:
    solution = oscillator().solution
    assert solution.errors == {"x": 1e-7, "x_t": 2e-7}
    assert solution.error == 2e-7


def test_unchecked() -> None:
    outcome = replace(SOLUTION.outcome, measured=None, status=Status.UNCHECKED)
    solution = Solution(outcome, SOLUTION.metadata)
    assert not solution.success
    assert math.isnan(solution.error)
    assert math.isnan(solution.corner_error)
    assert set(solution.errors) == {"x", "y"}
    assert "not measured" in repr(solution)


def test_a_summary_without_timings_has_no_line_of_them() -> None:
    timed = replace(SOLUTION.outcome, timings={"march": 0.5})
    assert "timings" in repr(Solution(timed, SOLUTION.metadata))
    untimed = replace(SOLUTION.outcome, timings={})
    assert "timings" not in repr(Solution(untimed, SOLUTION.metadata))


def test_partial() -> None:
    outcome = replace(SOLUTION.outcome, slabs=SOLUTION.outcome.slabs[:2], status=Status.BLOW_UP)
    solution = Solution(outcome, SOLUTION.metadata)
    assert solution.time == (0.0, 1.5)
    assert "t in [0, 1.5] of [0, 3]" in repr(solution)
    solution(1.5, x0=0, y0=2)
    with pytest.raises(EvaluationError, match=r"horizon \[0, 1.5\]"):
        solution(1.6, x0=0, y0=2)


def test_nothing_solved() -> None:
    solution = Solution(
        replace(SOLUTION.outcome, slabs=(), status=Status.RANK_LIMIT), SOLUTION.metadata
    )
    assert solution.rank == 0
    assert "the rank limit was reached" in repr(solution)
    with pytest.raises(EvaluationError, match="nothing was solved: the rank limit was reached"):
        solution(0.0, x0=0, y0=2)
    with pytest.raises(EvaluationError, match="nothing was solved"):
        solution.to_canonical()


def test_repr_fits_one_screen() -> None:
    box = tuple((0.0, 1.0) for _ in range(60))
    names = tuple(f"parameter_{j}" for j in range(60))
    metadata = replace(SOLUTION.metadata, parameters=names, box=box)
    many = Solution(replace(SOLUTION.outcome, slabs=()), metadata)
    for solution in (SOLUTION, many, decay().solution):
        lines = repr(solution).splitlines()
        assert len(lines) <= 24
        assert max(map(len, lines)) <= 100
    assert repr(SOLUTION) == (
        "Solution (rankone 0.1.0)\n"
        "  unknowns  x, y\n"
        "  over      t in [0, 3], x0 in [-1, 1], y0 in [2, 3]\n"
        "  success   yes: the measured error is within the tolerance\n"
        "  error     2e-07 measured on 256 trajectories (stack, DOP853), tolerance 1e-06; "
        "x 1e-07, y\n"
        "            2e-07\n"
        "  train     3 slabs, rank 3, ranks up to (3, 3), nodes up to (14, 15), 5.83 kB\n"
        "  timings   reference 0.01 s, march 0.25 s, check 0.125 s"
    )


def test_html_is_escaped() -> None:
    solution = Solution(replace(SOLUTION.outcome, notes=(Remedy("<b>"),)), SOLUTION.metadata)
    assert "&lt;b&gt;" in solution._repr_html_()
    assert "<b>" not in solution._repr_html_()


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda s: pickle.loads(pickle.dumps(s))])
def test_copies_are_equal(duplicate: object) -> None:
    SOLUTION(1.0, x0=0.5, y0=2.5)
    again = duplicate(SOLUTION)  # type: ignore[operator]
    values = {"x0": np.linspace(-1, 1, 9), "y0": 2.5}
    np.testing.assert_array_equal(again(1.0, values), SOLUTION(1.0, values))
    assert repr(again) == repr(SOLUTION)
    assert again["x"](1.0, x0=0.5, y0=2.5) == SOLUTION["x"](1.0, x0=0.5, y0=2.5)


def test_canonical_of_all_unknowns() -> None:
    x = sp.Function("x")(sp.Symbol("t"))
    forms = SOLUTION.to_canonical(1e-5)
    assert list(forms) == ["x", "y"]
    assert forms[x] is forms["x"]
    assert forms["y"].rank == 1
    assert forms["x"].rank == 2
    assert forms.rank == 2
    assert forms.error <= 1e-5
    times = np.linspace(0, 3, 11)
    values = SOLUTION(times, x0=0.3, y0=2.3)
    for row, name in enumerate(forms):
        np.testing.assert_allclose(forms[name](times, x0=0.3, y0=2.3), values[row], atol=1e-3)
    with pytest.raises(EvaluationError, match="2 canonical forms: `x` and `y`"):
        _ = forms.amplitudes
    assert SOLUTION.modes["y"].factors["t"].shape == (SOLUTION.modes["y"].nodes["t"].size, 1)


def test_canonical_of_a_single_unknown() -> None:
    forms = oscillator().solution.to_canonical(1e-10)
    assert forms.amplitudes.shape == (1,)
    assert set(forms.factors) == set(forms.nodes) == {"s", "k"}


def test_derivatives_have_the_same_names_everywhere() -> None:
    solution = oscillator().solution
    s = sp.Symbol("s")
    velocity = sp.Function("x")(s).diff(s)
    assert solution.unknowns == ("x",)
    assert solution.states == tuple(solution.errors) == ("x", "x_t")
    assert list(solution.modes) == ["x"]
    assert "x_t" not in solution.modes
    assert "x" in solution.modes
    assert 3 not in solution.modes
    form = solution.modes["x_t"]
    assert form is solution.modes[velocity]
    assert form.name == solution[velocity].name == "x_t"
    times = np.linspace(0, 3, 7)
    np.testing.assert_allclose(form(times, k=1.5), np.cos(times), atol=5e-3)
    assert solution.errors[velocity] == solution.errors["x_t"]
    for mapping in (solution.modes, solution.errors):
        with pytest.raises(KeyError, match=r"x_tt .did you mean `x_t`.*known are `x` and `x_t`"):
            mapping["x_tt"]
    assert "x_tt" not in solution.errors
    assert solution.errors.get("x_tt") is None


def test_warnings_are_at_the_line_of_the_user() -> None:
    """Also through properties that are computed once."""
    solution = Solution(SOLUTION.outcome, SOLUTION.metadata)
    for call in (
        lambda: solution.to_canonical(1e-9, max_rank=1),
        lambda: solution.to_canonical(1e-9, max_rank=1)["x"],
    ):
        with pytest.warns(RankoneWarning, match="canonical form of x: 1 terms") as caught:
            call()
        assert {warning.filename for warning in caught} == {__file__}
