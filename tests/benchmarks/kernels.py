"""The tests on other processors: python tests/benchmarks/kernels.py [ARGUMENTS OF PYTEST]

OpenBLAS has a kernel for each kind of processor, and NumPy loops for each set of instructions; both
round in ways of their own. Here the tests run with the kernels and loops of older processors, as
far as this one has them. Printed for each run are the kernels in use, what NumPy still dispatches,
the versions, and which tests fail. Run it in an environment with the oldest dependencies as well.
"""

from __future__ import annotations

import os
import subprocess
import sys

from numpy._core import _multiarray_umath as loops

DISPATCHED = [name for name in loops.__cpu_dispatch__ if loops.__cpu_features__.get(name)]
WIDE = [name for name in DISPATCHED if name.startswith(("AVX512", "X86_V4"))]
RUNS = {
    "this processor": {},
    "Haswell": {"OPENBLAS_CORETYPE": "Haswell", "NPY_DISABLE_CPU_FEATURES": " ".join(WIDE)},
    "Prescott": {"OPENBLAS_CORETYPE": "Prescott", "NPY_DISABLE_CPU_FEATURES": " ".join(DISPATCHED)},
}
# OpenBLAS calls the kernel of Prescott Katmai where it has no older one, and that of Zen Haswell
IN_USE = """
import numpy, scipy.linalg, threadpoolctl
print("NumPy", numpy.__version__, "SciPy", scipy.__version__)
for pool in threadpoolctl.threadpool_info():
    print(pool["filepath"].rpartition("/")[2], pool["architecture"])
"""


def main() -> None:
    failed = False
    for name, changes in RUNS.items():
        environment = os.environ | {"OMP_NUM_THREADS": "1"} | changes
        off = changes.get("NPY_DISABLE_CPU_FEATURES") or "nothing"
        print(f"== {name}: NumPy without {off}", flush=True)
        subprocess.run([sys.executable, "-c", IN_USE], env=environment, check=True)
        tests = [sys.executable, "-m", "pytest", "-q", "--no-header", "--tb=no", *sys.argv[1:]]
        ran = subprocess.run(tests, env=environment, capture_output=True, text=True, check=False)
        told = ("FAILED", "ERROR")
        lines = ran.stdout.strip().splitlines() or [ran.stderr.strip()]
        print(*(line for line in lines[:-1] if line.startswith(told)), lines[-1], sep="\n")
        failed |= ran.returncode != 0
    raise SystemExit(failed)


if __name__ == "__main__":
    main()
