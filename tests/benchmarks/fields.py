"""Fields: what a system of many entries costs, section by section.

``python tests/benchmarks/fields.py [section ...]`` runs the sections that are named, or all.

- ``compile``: 100,000 equations written as two fields, from the problem to the system
"""

import sys
import time

import numpy as np
import scipy.sparse as ss
import sympy as sp

import rankone as ro
from rankone.compiler.field_lowering import field_system

SIDE = 224  # Cells on a side of the square: two fields have 100,352 entries


def laplacian(side):
    """Second differences on a square of cells, with no flux through its sides."""
    ones = np.ones(side)
    line = ss.diags_array([ones[1:], -2.0 * ones, ones[1:]], offsets=(-1, 0, 1)).tolil()
    line[0, 0] = line[-1, -1] = -1.0
    one = ss.eye_array(side)
    return ss.csr_array(ss.kron(line, one) + ss.kron(one, line)) * side**2


def brusselator(side):
    """Two fields with diffusion and a cubic reaction."""
    t, A, B, D = sp.symbols("t A B D")
    n = side**2
    u, v = ro.field("u", n), ro.field("v", n)
    matrix = laplacian(side)
    start = np.random.default_rng(0).random(n)
    return ro.Problem(
        {
            u: D * ro.apply(matrix, u) + A - (B + 1) * u + u**2 * v,
            v: 8 * D * ro.apply(matrix, v) + B * u - u**2 * v,
        },
        (t, 0, 1),
        {A: (1, 2), B: (2, 3)},
        {u: A + ro.apply(start, 1), v: 1.0},
        constants={D: 1e-3},
    )


def seconds(build):
    """What a call returns, and the processor time it took."""
    began = time.process_time()
    made = build()
    return made, time.process_time() - began


def compile_section():
    """The time from arrays to a system, with and without the comparison with the tree."""
    brusselator(8)  # imports
    problem, building = seconds(lambda: brusselator(SIDE))
    _, plain = seconds(lambda: field_system(problem, check=False))
    system, checked = seconds(lambda: field_system(problem))
    print(f"{system.size} equations in two fields, processor time")
    print(f"  problem {building:.2f} s, system {plain:.2f} s, comparison {checked - plain:.2f} s")
    print(f"  together {building + checked:.2f} s (bar: 2 s), text of {len(system.source)} letters")


SECTIONS = {"compile": compile_section}

if __name__ == "__main__":
    for name in sys.argv[1:] or SECTIONS:
        print(f"== {name}")
        SECTIONS[name]()
