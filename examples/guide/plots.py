"""Make the pictures of the guide to plots: ``python examples/guide/plots.py``.

The code is that of the guide itself: its blocks are run, and the pictures that they save are
written to ``docs/guide/plots``, or to ``DIR`` with ``--to DIR``.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

import matplotlib  # noqa: E402

matplotlib.use("Agg")

from PIL import Image  # noqa: E402

PAGE = ROOT / "docs" / "guide" / "plots.md"
FOLDER = PAGE.with_suffix("")
MOST_BYTES = 60_000
_BLOCK = re.compile(r"^```python\n(.*?)^```", re.M | re.S)


def make(folder: Path) -> list[Path]:
    """Run the blocks of the guide and write the pictures they save."""
    folder = folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    before = Path.cwd()
    with tempfile.TemporaryDirectory() as scratch:
        os.chdir(scratch)
        try:
            namespace: dict[str, object] = {"__name__": "__main__"}
            for code in _BLOCK.findall(PAGE.read_text()):
                exec(compile(code, str(PAGE), "exec"), namespace)
        finally:
            os.chdir(before)
        return [_small(path, folder) for path in sorted(Path(scratch).glob("*.png"))]


def _small(path: Path, folder: Path) -> Path:
    """Write a picture with a palette, which makes the file a third as large."""
    written = folder / path.name
    Image.open(path).convert("RGB").quantize(128).save(written, optimize=True)
    assert written.stat().st_size <= MOST_BYTES, f"{path.name}: {written.stat().st_size} bytes"
    return written


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Make the pictures of the guide to plots.")
    parser.add_argument("--to", metavar="DIR", type=Path, default=FOLDER, help="their folder")
    for picture in make(parser.parse_args().to):
        print(picture)
