"""Speed of the models in JavaScript: ``python tests/benchmarks/javascript.py [PROBLEM ...]``.

The processor time of one call in Node.js, with WebAssembly, without, and of a model made smaller,
against the Python call and the model in C99 of the same solution. Without names all reference
problems are measured; names of systems with events are those of ``events.py``.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path[:0] = [str(Path(__file__).parents[2]), str(Path(__file__).parents[2] / "src")]

import rankone as ro  # noqa: E402
from tests.benchmarks.events import SYSTEMS  # noqa: E402
from tests.benchmarks.export import c_times, python_time  # noqa: E402
from tests.problems import EXAMPLES  # noqa: E402

PROBLEMS = {name: (example.problem, example.RTOL) for name, example in EXAMPLES.items()} | SYSTEMS
DRIVER = Path(__file__).with_suffix(".mjs")


def times(model: Path, *flags: str) -> dict[str, float]:
    """Microseconds of one call of each function."""
    command = ["node", str(DRIVER), str(model), *flags]
    run = subprocess.run(command, capture_output=True, text=True, check=True)
    found: dict[str, float] = json.loads(run.stdout)
    return found


def main(names: list[str]) -> None:
    for name in names or EXAMPLES:
        problem, rtol = PROBLEMS[name]
        solution = ro.solve(problem, rtol=rtol)
        with tempfile.TemporaryDirectory() as place:
            model = solution.export(Path(place) / "model.mjs")
            solution.export(Path(place) / "model.c")
            c = c_times(solution, Path(place), ["-O2"], np.float64) * 1e6
            sizes = model.stat().st_size / 1e3, solution.nbytes / 1e3
            print(f"{name}: {sizes[0]:.0f} kB, cores of the solution {sizes[1]:.0f} kB")
            print(f"  Python call {python_time(solution) * 1e6:.1f} us, C {c:.2f} us")
            small = Path(place) / "small.mjs"
            solution.export(small, rtol=solution.rtol)
            size = small.stat().st_size / 1e3
            for what, file, flags in (
                ("WebAssembly", model, ()),
                ("plain JavaScript", model, ("plain",)),
                (f"made smaller with rtol={solution.rtol:g}, {size:.0f} kB", small, ()),
            ):
                found = times(file, *flags)
                print(f"  {what}, microseconds:")
                print("    " + ", ".join(f"{call} {us:.2f}" for call, us in found.items()))
                print(f"    {1e6 / found['evaluate']:.2g} evaluations a second")


if __name__ == "__main__":
    main(sys.argv[1:])
