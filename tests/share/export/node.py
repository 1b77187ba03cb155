"""Models in JavaScript are run by Node.js."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

__all__ = ["NODE", "close", "needs_node", "run_driver", "script"]

DRIVER = Path(__file__).parent / "model_driver.mjs"
NODE = shutil.which("node")
needs_node = pytest.mark.skipif(NODE is None, reason="no Node.js (node)")


def run_node(*arguments):
    run = subprocess.run([NODE, *map(str, arguments)], capture_output=True, text=True, timeout=600)
    assert run.returncode == 0, run.stderr
    return run.stdout


def script(folder, text):
    """What a script prints that imports the model as `m`, as JSON."""
    file = folder / "script.mjs"
    file.write_text(f'import * as m from "./model.mjs";\n{text}')
    return json.loads(run_node(file))


def run_driver(folder, solution, where, *flags):
    """Values, values of a batch, gradients and time derivatives, the points last."""
    (folder / "points").write_bytes(np.stack(list(where.values())).tobytes())
    run_node(DRIVER, folder / "model.mjs", folder / "points", folder / "out", *flags)
    out = np.frombuffer((folder / "out").read_bytes())
    n, d, count = (
        len(solution.unknowns),
        len(solution.parameters),
        len(where[solution.metadata.time]),
    )
    ends = np.cumsum([n * count, n * count, n * d * count])
    values, batch, slopes, rates = np.split(out, ends)
    slopes = np.moveaxis(slopes.reshape(count, n, d), 0, 2)
    return values.reshape(count, n).T, batch.reshape(n, count), slopes, rates.reshape(count, n).T


def close(got, wanted, tolerance):
    """Within a tolerance of the largest value along the points."""
    size = np.abs(wanted).max(axis=-1, keepdims=True)
    return np.all(np.abs(got - wanted) <= tolerance * size)
