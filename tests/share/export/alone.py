"""Python without rankone and SymPy, in which exported solvers run."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

__all__ = ["PythonAlone", "clean_environment"]

_SERVER = """
import contextlib, io, json, os, sys, traceback

class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("rankone", "sympy", "threadpoolctl", "tqdm"):
            raise ModuleNotFoundError(f"{name} is blocked", name=name)

sys.meta_path.insert(0, Blocked())
import numpy as np

def run(task):
    import solver
    if not isinstance(task, str):
        sys.argv[1:] = task
        return solver.main()
    exec(task, {"__name__": "__main__", "np": np, "solver": solver, "sys": sys})

here = None
for line in sys.stdin:
    folder, tasks = json.loads(line)
    if folder != here:
        for name in [*sys.modules]:
            if name.partition(".")[0] in ("solver", "package"):
                del sys.modules[name]
        os.chdir(folder)
        sys.path[0] = here = folder
    runs = []
    for task in tasks:
        out, err = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            try:
                status = run(task)
            except SystemExit as end:
                status = end.code
            except Exception:
                traceback.print_exc()
                status = 1
        runs.append([status or 0, out.getvalue(), err.getvalue()])
    print(json.dumps(runs), flush=True)
"""


def clean_environment() -> dict[str, str]:
    """The environment without what leads Python to rankone."""
    variables = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    return {**variables, "OMP_NUM_THREADS": "1"}


class PythonAlone:
    """One process for many runs: each would start for a second of its own.

    A solver is imported once as long as runs are in its folder.
    """

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", _SERVER],
            env=clean_environment(),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def runs(
        self, folder: Path, *tasks: str | Sequence[str]
    ) -> list[subprocess.CompletedProcess[str]]:
        """Run scripts that find ``solver``, ``np`` and ``sys``, and arguments of the program."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps([str(folder), tasks]) + "\n")
        self._process.stdin.flush()
        ends = json.loads(self._process.stdout.readline())
        return [
            subprocess.CompletedProcess(task, *end) for task, end in zip(tasks, ends, strict=True)
        ]

    def close(self) -> None:
        """Let the process end."""
        self._process.communicate()
