"""Pages with sliders: ``python tests/benchmarks/explorer.py [PROBLEM ...]``.

The size of the page, the seconds it takes to write it beside those of the solve, and the median
milliseconds from the move of a slider to the end of the drawing, in headless Chromium. With
``--pictures DIR`` pictures of the page, 1280 and 390 pixels wide, light and dark. ``--update``
takes the picture of the guide anew, and nothing else.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import re
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

sys.path[:0] = [str(Path(__file__).parents[2]), str(Path(__file__).parents[2] / "src")]

import rankone as ro  # noqa: E402
from tests.problems import EXAMPLES, GENERAL  # noqa: E402
from tests.share.export.browser import Browser, browser, settle  # noqa: E402

GUIDE = Path(__file__).parents[2] / "docs" / "export" / "explorer.md"
MOVES = 60
VIEWS = ((1280, "light"), (1280, "dark"), (390, "light"), (390, "dark"))


def redraws(page: Any) -> list[float]:
    """Milliseconds of each redraw while a slider is moved."""
    slider = page.locator("#parameters input[type=range]").first
    slider.focus()
    page.evaluate("rankone.latencies.length = 0")
    for _ in range(MOVES):
        page.keyboard.press("ArrowRight")
        settle(page)
    found: list[float] = page.evaluate("rankone.latencies")
    return found


def pictures(chromium: Browser, path: Path, place: Path) -> None:
    for width, scheme in VIEWS:
        with chromium.open(path, width=width, scheme=scheme) as page:
            page.locator("#time").fill("450")
            page.locator("#time").blur()
            settle(page)
            target = place / f"{path.stem}_{width}_{scheme}.png"
            page.screenshot(path=target, full_page=True)


def update(chromium: Browser, folder: Path) -> None:
    """The picture of the guide: the page of its first example."""
    from PIL import Image

    code = re.search(r"^```python\n(.*?)^```", GUIDE.read_text(encoding="utf-8"), re.M | re.S)
    assert code is not None
    names: dict[str, Any] = {}
    with contextlib.chdir(folder):
        exec(code[1], names)
    with chromium.open(folder / "pendulum.html", width=1240) as page:
        page.evaluate("rankone.set({t: 2.25})")
        settle(page)
        picture = Image.open(io.BytesIO(page.screenshot(full_page=True)))
    target = GUIDE.with_suffix(".png")
    picture.convert("RGB").quantize(128).save(target, "png", optimize=True)
    print(f"wrote {target}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("problems", nargs="*", default=["pendulum", "lotka_volterra", "kirchhoff"])
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--update", action="store_true")
    arguments = parser.parse_args()
    every = {**EXAMPLES, **GENERAL}
    with tempfile.TemporaryDirectory() as folder, browser() as chromium:
        if arguments.update:
            update(chromium, Path(folder))
            return
        for name in arguments.problems:
            solution = ro.solve(every[name].problem, rtol=every[name].RTOL)
            before = time.perf_counter()
            path = solution.explore(Path(folder) / f"{name}.html")
            seconds = time.perf_counter() - before
            with chromium.open(path) as page:
                found = redraws(page)
            print(
                f"{name}: {path.stat().st_size / 1e3:.0f} kB, written in {seconds:.2f} s (solve "
                f"{solution.timings['solve']:.2f} s), redraw {statistics.median(found):.1f} ms "
                f"(largest {max(found):.1f} of {len(found)})"
            )
            if arguments.pictures:
                pictures(chromium, path, arguments.pictures)


if __name__ == "__main__":
    main()
