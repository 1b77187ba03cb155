"""The falling card: its page draws what the solution says, and its guide states its problem."""

from __future__ import annotations

import contextlib
import io
import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

import rankone as ro
from examples import falling_card
from tests.reference.measure import measured_errors
from tests.reference.systems import INDEPENDENT

ROOT = Path(__file__).parents[2]
GUIDE = ROOT / "docs" / "guide" / "falling-card.md"
DRIVER = Path(__file__).with_name("page_driver.mjs")
SCRIPT = re.compile(r'<script type="module">\n(.*?)</script>', re.S)
GHOSTS, TRAIL, EVERY = 50, 200, 8

pytestmark = pytest.mark.slow
needs_node = pytest.mark.skipif(shutil.which("node") is None, reason="no Node.js (node)")


@pytest.fixture(scope="module")
def run():
    """The solution of the example and what it prints."""
    solutions, solve, printed = [], ro.CompiledProblem.solve, io.StringIO()

    def recorded(*arguments, **options):
        solutions.append(solve(*arguments, **options))
        return solutions[-1]

    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(printed):
        patch.setattr(ro.CompiledProblem, "solve", recorded)
        falling_card.main()
    (solution,) = solutions
    return solution, printed.getvalue()


@pytest.fixture(scope="module")
def solution(run):
    return run[0]


@pytest.fixture(scope="module")
def page(solution):
    return falling_card.page(solution)


def drawn(page, folder, search):
    """The lines of a frame, and the texts of the page."""
    (script,) = SCRIPT.findall(page)
    file = folder / "page.mjs"
    file.write_text(script)
    command = ["node", DRIVER, file, search]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    found = json.loads(run.stdout)
    return [np.array(line).T for line in found["lines"]], found["texts"]


def test_main(run):
    solution, printed = run
    assert solution.success, solution.message
    assert printed.startswith(repr(solution))


def test_trajectories(solution):
    """Within the tolerance and a fifth of it: the trajectories are not those it was checked on."""
    errors = measured_errors(solution, INDEPENDENT["falling_card"])
    assert np.all(errors <= 1.2 * falling_card.RTOL), errors


def test_cards_turn_both_ways(solution):
    """The box is worth looking at: every card turns back at least twice and glides sideways."""
    times = np.linspace(0, 1.5, 151)
    x, _, theta = falling_card.flights(solution, 200, times)
    spin = np.sign(np.diff(theta))
    assert np.all(np.count_nonzero(np.diff(spin), axis=1) >= 2)
    assert np.all(np.ptp(x, axis=1) > falling_card.a)


def test_the_page_is_one_file(page):
    assert not re.search(r"@\w+@", page)
    assert not re.search(r"(?:src|href)=|https?://|@import", page)
    assert page.count("</script>") == 1


@needs_node
@pytest.mark.parametrize("t", [0.0, 0.9, 1.5])
def test_the_page_draws_the_solution(solution, page, tmp_path, t):
    values = {"C_D": 2.0, "C_L": 1.3, "speed": 1.4, "angle": -0.2, "spin": 4.5}
    search = "?" + "&".join(f"{name}={value}" for name, value in (values | {"t": t}).items())
    lines, texts = drawn(page, tmp_path, search)
    shown = np.count_nonzero(np.linspace(0, 1.5, TRAIL)[::EVERY] <= t)
    assert len(lines) == 2 * (GHOSTS + shown) + 1 + 2
    path, front, back = lines[-3:]

    # the path gives the scale and the origin, and then everything has its place
    exact = solution(np.linspace(0, 1.5, TRAIL), values)[:2]
    scale = np.ptp(path[1]) / np.ptp(exact[1]) * np.array([[1], [-1]])
    origin = path[:, :1] - scale * exact[:, :1]
    assert np.allclose((path - origin) / scale, exact, atol=1e-9)

    x, y, theta = solution(t, values)[:3]
    ends = ((front + back) / 2 - origin) / scale
    along = falling_card.a * np.array([np.cos(theta), np.sin(theta)])
    assert np.allclose(ends.mean(axis=1), [x, y], atol=1e-9)
    assert np.allclose((ends[:, 1] - ends[:, 0]) / 2, along, atol=1e-9)
    assert "1.40 m/s" in texts.values()
    assert f"{t:.2f} s" in texts.values()


@needs_node
def test_the_page_at_ends_of_the_box(solution, page, tmp_path):
    """Neighbours stay in the box, and so does what an address asks for."""
    corner = {name: upper + 1 for name, (_, upper) in solution.parameters.items()}
    search = "?" + "&".join(f"{name}={value}" for name, value in corner.items())
    lines, texts = drawn(page, tmp_path, search + "&t=99")
    assert all(np.isfinite(line).all() for line in lines)
    assert "2.40" in texts.values()


@pytest.mark.slow
def test_picture(solution, tmp_path):
    pytest.importorskip("matplotlib")
    falling_card.picture(solution, tmp_path / "card.png")
    for path in (tmp_path / "card.png", GUIDE.with_suffix(".png")):
        assert 5_000 < path.stat().st_size <= 100_000


def test_the_guide_states_this_problem():
    code = re.search(r"^```python\n(.*?)^```", GUIDE.read_text(), re.M | re.S)[1]
    namespace = {}
    exec(code, namespace)
    stated = namespace["problem"]
    assert stated.residuals == falling_card.problem.residuals
    assert stated.coordinates == falling_card.problem.coordinates
    assert stated.initial == falling_card.problem.initial
    assert stated.units == falling_card.problem.units
