"""Make every figure and number of the gallery: ``python examples/gallery/make_all.py``.

``--to DIR`` names the folder for the figures; ``--update`` rewrites the docs.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import convergence_study
import coupled
import coupled_scaling
import free_fall
import linear_model
import lotka_volterra
import rigid_body
from common import run_script

SCRIPTS = (
    linear_model,
    free_fall,
    coupled,
    coupled_scaling,
    lotka_volterra,
    rigid_body,
    convergence_study,
)


def main(folder: Path) -> None:
    began = time.perf_counter()
    for script in SCRIPTS:
        start = time.perf_counter()
        print(f"--- {script.__name__}")
        script.main(folder)
        print(f"{time.perf_counter() - start:.0f} s")
    print(f"all in {time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    run_script(main)
