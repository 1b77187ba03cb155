"""Plots hold the data of the history; they show nothing."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import pytest

import rankone as ro
from examples import coupled, decay, free_fall
from rankone import plotting


@pytest.fixture(scope="module")
def greedy():
    return ro.solve(free_fall.problem, rtol=1e-3, method="greedy", max_attempts=1)


def _lines(axes):
    return [np.asarray(line.get_ydata(), float) for line in axes.get_lines()]


def test_greedy_history(greedy):
    fixed_point, residual, amplitudes, changes = plotting.plot_history(greedy)
    record = greedy.history[-1]
    modes = [mode for equation in record.equations for mode in equation.modes]
    assert [line.tolist() for line in _lines(fixed_point)] == [list(m.differences) for m in modes]
    drawn = np.concatenate([line for line in _lines(residual)[:-1] if line.size])
    assert drawn.tolist() == [mode.residual for mode in modes]
    assert _lines(residual)[-1].tolist() == [record.tolerance] * 2
    assert _lines(amplitudes)[0].tolist() == list(record.equations[-1].amplitudes)
    assert [line.size for line in _lines(changes)] == [len(r.residuals) for r in greedy.history]


def test_slabs_can_be_chosen(greedy):
    count = len(greedy.history)
    assert count > 1
    first = plotting.plot_history(greedy, slab=0)
    assert f"{greedy.history[0].end:.3g}]" in first[0].figure.get_suptitle()
    with pytest.raises(ro.OptionError, match=f"there are {count}"):
        plotting.plot_history(greedy, slab=count)


def test_train_history():
    solution = ro.solve(coupled.problem, rtol=1e-4, method="train")
    changes, ranks = plotting.plot_history(solution)
    last = solution.history[-1]
    assert _lines(changes)[-1].tolist() == list(last.residuals)
    assert [patch.get_data().values.tolist()[-1] for patch in ranks.patches] == list(last.ranks)
    assert changes.figure.get_suptitle() == f"train, {len(solution.history)} slabs"


def test_cross_history():
    """One record for each attempt: highest modes and ranks over the parameters."""
    solution = ro.solve(coupled.problem, rtol=1e-4, method="cross")
    first = solution.history[0]
    records = (replace(first, attempt=0, slabs=2, ranks=(9, 5, 2)), replace(first, attempt=1))
    two = ro.Solution(replace(solution.outcome, history=records), solution.metadata)
    for solved, title in (
        (solution, "cross, 1 slab, 1 attempt"),
        (two, "cross, 1 slab, 2 attempts"),
    ):
        modes, ranks = plotting.plot_history(solved)
        assert modes.figure.get_suptitle() == title
        assert [tick.get_text() for tick in modes.get_xticklabels()] == list(solved.parameters)
        assert [tuple(line) for line in _lines(modes)] == [r.residuals for r in solved.history]
        assert [tuple(line) for line in _lines(ranks)] == [r.ranks for r in solved.history]


def test_modes_of_one_parameter():
    solution = ro.solve(decay.problem, rtol=1e-5)
    form = solution.to_canonical(1e-3)["u"]
    for unknown in (None, "u", decay.u):
        panels = plotting.plot_modes(solution, unknown, modes=2)
        in_time, in_k, amplitudes = panels
        assert [axes.get_xlabel() for axes in panels] == ["t", "k", "mode"]
        assert len(in_time.get_lines()) == len(in_k.get_lines()) == 2
        np.testing.assert_allclose(_lines(amplitudes)[0], form.amplitudes)
    # the modes drawn add up to the solution
    panels = plotting.plot_modes(solution, modes=form.rank)
    times, rates = (axes.get_lines()[0].get_xdata() for axes in panels[:2])
    t_modes, k_modes = (np.stack(_lines(axes)) for axes in panels[:2])
    total = np.einsum("i,it,ik->tk", form.amplitudes, t_modes, k_modes)
    exact = np.exp(-np.outer(times, rates))
    assert np.sqrt(np.mean((total - exact) ** 2) / np.mean(exact**2)) < 2e-3


def test_modes_ask_for_the_unknown():
    solution = ro.solve(coupled.problem, rtol=1e-3)
    with pytest.raises(ro.EvaluationError, match="u1, u2, u3"):
        plotting.plot_modes(solution)
    with pytest.raises(ro.EvaluationError, match="no unknown `v`"):
        plotting.plot_modes(solution, "v")
    with pytest.raises(ro.OptionError, match="at least 1"):
        plotting.plot_modes(solution, "u1", modes=0)
    assert len(plotting.plot_modes(solution, coupled.u2)) == 5


def test_axes_that_are_given(greedy):
    """They are drawn into, and a figure of others gets no title."""
    solution = ro.solve(decay.problem, rtol=1e-3)
    draws = (
        (4, lambda ax: plotting.plot_history(greedy, ax=ax)),
        (2, lambda ax: plotting.plot_history(solution, ax=ax)),
        (3, lambda ax: plotting.plot_modes(solution, ax=ax)),
    )
    for count, draw in draws:
        figure, given = plt.subplots(1, count)
        before = plt.get_fignums()
        assert [*draw(given)] == [*given]
        assert all(axes.has_data() for axes in given)
        assert (figure.get_suptitle(), plt.get_fignums()) == ("", before)
        for wrong in (given[1:], given[0]):
            said = "1 axes were given" if wrong is given[0] else f"{count - 1} axes were given"
            with pytest.raises(ro.OptionError, match=f"{said} for {count} panels"):
                draw(wrong)
        with pytest.raises(ro.OptionError, match="not axes of Matplotlib"):
            draw([figure] * count)


@pytest.mark.slow
def test_without_matplotlib(greedy, tmp_path):
    """Importing does not need it; plotting says what to install."""
    script = (
        "import sys, rankone as ro, rankone.plotting as plotting\n"
        "assert 'matplotlib' not in sys.modules\n"
        "sys.modules['matplotlib'] = sys.modules['matplotlib.pyplot'] = None\n"
        "solution = ro.load(sys.argv[1])\n"
        "for draw in (plotting.plot_history, plotting.plot_bands, plotting.plot_sobol):\n"
        "    try: draw(solution)\n"
        "    except ro.RankoneError as error: print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, greedy.save(tmp_path / "fall.npz")],
        capture_output=True,
        text=True,
        check=True,
        env={"PYTHONPATH": ":".join(path for path in sys.path if path)},
    )
    assert done.stdout.count("remedy: pip install matplotlib") == 3


def test_a_loaded_solution_shows_the_same(greedy, tmp_path):
    loaded = ro.load(greedy.save(tmp_path / "fall.npz"))
    shown = [plotting.plot_history(solution) for solution in (greedy, loaded)]
    assert [len(_lines(axes)) for axes in shown[0]] == [len(_lines(axes)) for axes in shown[1]]
    assert len(shown[1]) == 4


@pytest.mark.parametrize("method", ["train", "greedy"])
@pytest.mark.filterwarnings("error")
def test_without_parameters(method):
    problem = ro.Problem.from_strings(
        rhs={"x": "-x*x"}, initial={"x": "1"}, parameters={}, time=(0, 1)
    )
    solution = ro.solve(problem, rtol=1e-4, method=method)
    assert len(plotting.plot_history(solution)) == (4 if method == "greedy" else 2)
    assert len(plotting.plot_modes(solution)) == 2
