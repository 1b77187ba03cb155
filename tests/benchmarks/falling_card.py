"""What a frame of the falling card's page costs: ``python tests/benchmarks/falling_card.py``.

A frame evaluates 51 cards and one path of 200 times. Wall-clock medians in Node, for the model as
it is and for smaller ones, beside one SciPy trajectory in Python; and the milliseconds from frame
to frame of the page in headless Chromium, while a slider moves.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import scipy.integrate

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

import rankone as ro  # noqa: E402
from examples import falling_card  # noqa: E402
from tests.reference.systems import INDEPENDENT  # noqa: E402
from tests.share.export.browser import NoBrowserError, browser  # noqa: E402

CARDS, PATH, FRAMES = 51, 200, 300

FRAME = """
const {{ curve, evaluate, names, parameters, ranges, time }} = await import("{model}");
const within = ([lower, upper]) => lower + (upper - lower) * Math.random();
const point = () => parameters.map((name) => within(ranges[name]));
const [start, end] = ranges[time];
const step = (end - start) / {path};
const times = Float64Array.from({{ length: {path} }}, (_, i) => start + step * i);
const trail = new Float64Array(names.length * {path});
const card = new Float64Array(names.length);
const took = [];
for (let frame = 0; frame < {frames}; frame++) {{
  const points = Array.from({{ length: {cards} }}, point);
  const t = within(ranges[time]);
  const began = performance.now();
  for (const p of points) evaluate(t, p, card);
  const middle = performance.now();
  curve(points[0], times, trail);
  took.push([middle - began, performance.now() - middle]);
}}
const median = (values) => values.sort((a, b) => a - b)[values.length >> 1];
console.log(JSON.stringify([0, 1].map((k) => median(took.map((pair) => pair[k])))));
"""

MOVED = """
(count) => new Promise((done) => {
  const slider = document.querySelector("#sliders input");
  const [lower, upper] = [slider.min, slider.max].map(Number);
  const times = [];
  const step = (now) => {
    times.push(now);
    slider.value = lower + ((upper - lower) * times.length) / count;
    slider.dispatchEvent(new Event("input"));
    if (times.length > count) done(times.slice(1).map((time, i) => time - times[i]));
    else requestAnimationFrame(step);
  };
  requestAnimationFrame(step);
})
"""


def frames(solution: ro.Solution) -> list[float]:
    """Milliseconds from frame to frame of the page, while a slider moves with every one."""
    with tempfile.TemporaryDirectory() as folder, browser() as chromium:
        path = Path(folder) / "card.html"
        path.write_text(falling_card.page(solution), encoding="utf-8")
        with chromium.open(path) as page:
            return sorted(page.evaluate(MOVED, FRAMES))


def frame(solution: ro.Solution, rtol: float | None) -> tuple[int, float, float]:
    """Bytes of a model, and milliseconds of its cards and of its path."""
    with tempfile.TemporaryDirectory() as folder:
        model = solution.export(Path(folder) / "card.mjs", rtol=rtol)
        script = Path(folder) / "frame.mjs"
        script.write_text(FRAME.format(model=model.as_uri(), cards=CARDS, path=PATH, frames=FRAMES))
        run = subprocess.run(["node", script], capture_output=True, text=True, check=True)
        return model.stat().st_size, *json.loads(run.stdout)


def trajectory() -> float:
    """Milliseconds of one SciPy trajectory at the tolerance of the example."""
    system = INDEPENDENT["falling_card"]
    p = np.array(system.box).mean(axis=1)
    took = []
    for _ in range(5):
        began = time.perf_counter()
        scipy.integrate.solve_ivp(
            lambda t, u: system.rhs(t, u, p),
            (0, system.end),
            system.initial(p),
            "DOP853",
            rtol=falling_card.RTOL,
            atol=1e-5,
        )
        took.append(time.perf_counter() - began)
    return 1000 * float(np.median(took))


def main() -> None:
    solution = ro.solve(falling_card.problem, rtol=falling_card.RTOL)
    print(solution)
    print(f"one SciPy trajectory: {trajectory():.1f} ms")
    for rtol in (None, 1e-4, 5e-4):
        size, cards, path = frame(solution, rtol)
        kind = "as it is" if rtol is None else f"rtol={rtol:g}"
        print(
            f"{kind:>10}: {size / 1000:.0f} kB, {CARDS} cards {cards:.2f} ms "
            f"({1000 * cards / CARDS:.0f} us each), path of {PATH} times {path:.2f} ms"
        )
    try:
        took = frames(solution)
    except NoBrowserError as reason:
        print(f"frames were not measured: {reason}")
        return
    median, late = took[FRAMES // 2], sum(time > 25 for time in took)
    print(
        f"page in Chromium: a frame every {median:.1f} ms, {late} of {FRAMES} after more than 25 ms"
    )


if __name__ == "__main__":
    main()
