"""Pages are looked at in Chromium without a window, driven by Playwright, without a network."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

__all__ = ["Browser", "NoBrowserError", "browser"]

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


class NoBrowserError(Exception):
    """Why there is none."""


@contextmanager
def browser() -> Iterator[Browser]:
    """A browser: Playwright's own, or else the one of the system."""
    try:
        from playwright.sync_api import Error, sync_playwright
    except ImportError:
        raise NoBrowserError("Playwright is not installed: extra browser") from None
    found = next(filter(None, map(shutil.which, NAMES)), None)
    with sync_playwright() as playwright:
        try:
            chromium = playwright.chromium.launch(executable_path=found, args=["--no-sandbox"])
        except Error as error:
            reason = str(error).strip().splitlines()[0]
            raise NoBrowserError(f"no Chromium (playwright install chromium): {reason}") from None
        yield Browser(chromium)
        chromium.close()


class Browser:
    """Opens pages from files."""

    def __init__(self, chromium: Any) -> None:
        self._chromium = chromium

    @contextmanager
    def open(
        self,
        path: Path,
        fragment: str = "",
        width: int = 1280,
        scheme: str = "light",
        scripts: bool = True,
    ) -> Iterator[Any]:
        """A page; an AssertionError at the end if it complained or asked for anything else."""
        context = self._chromium.new_context(
            viewport={"width": width, "height": 844},
            color_scheme=scheme,
            offline=True,
            java_script_enabled=scripts,
        )
        page = context.new_page()
        wrong: list[str] = []
        page.on("console", lambda said: wrong.append(said.text))
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("request", lambda asked: wrong.append(asked.url))
        address = path.resolve().as_uri() + fragment
        page.goto(address)
        if scripts:
            settle(page)
        try:
            yield page
            own = ("file://", "blob:", "data:")
            assert [line for line in wrong if not line.startswith(own)] == []
            assert {line.partition("#")[0] for line in wrong if line.startswith("file://")} == {
                path.resolve().as_uri()
            }
        finally:
            context.close()


def settle(page: Any) -> None:
    """Wait until what was asked for is drawn."""
    page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
