"""Solved models in JavaScript agree with the solution they were made from."""

from __future__ import annotations

import base64
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import sympy as sp

import rankone as ro
import rankone.share.export
from tests.problems import EXAMPLES
from tests.share.export.node import needs_node, script
from tests.share.export.solutions import (
    solved,
    synthetic,
    synthetic_with_breaks,
    synthetic_with_scales,
)

WAT = shutil.which("wat2wasm")
needs_assembler = pytest.mark.skipif(WAT is None, reason="no WebAssembly assembler (wat2wasm)")
COUNT = 1000

SOLUTIONS = {
    **{name: lambda name=name: solved(name) for name in EXAMPLES},
    "synthetic": synthetic,
    "unequal": synthetic_with_breaks,
    "scaled": synthetic_with_scales,
}


@needs_assembler
def test_webassembly_is_that_of_its_text(tmp_path):
    folder = Path(rankone.share.export.__file__).parent
    text = (folder / "model_train.js.in").read_text()
    carried = base64.b64decode(re.search(r"KERNELS = `(.*?)`", text, re.S)[1])
    run = [WAT, str(folder / "model.wat"), "-o", str(tmp_path / "model.wasm")]
    subprocess.run(run, check=True)
    assert (tmp_path / "model.wasm").read_bytes() == carried


def unparametrised():
    problem = ro.Problem.from_strings(rhs={"u": "-u"}, initial={"u": 1}, parameters={}, time=(0, 1))
    return ro.solve(problem, rtol=1e-6)


@needs_node
def test_without_parameters(tmp_path):
    solution = unparametrised()
    solution.export(tmp_path / "model.mjs")
    text = """console.log(JSON.stringify([m.parameters, ...[
      m.evaluate(0.5), m.evaluate(0.5, {}), m.evaluate(0.5, []), m.evaluateBatch([0, 0.5]),
      m.evaluateBatch([0, 0.5], {}), m.curve(undefined, [0.5]), m.timeDerivative(0.5),
      m.gradient(0.5)].map((values) => Array.from(values))]));"""
    names, *values = script(tmp_path, text)
    u = solution(t=0.5)[0]
    assert names == []
    lengths = [1, 1, 1, 2, 2, 1, 1, 0]
    assert [len(row) for row in values] == lengths
    wanted = [u, u, u, solution(t=0)[0], u, solution(t=0)[0], u, u, -u]
    np.testing.assert_allclose(np.concatenate(values), wanted, rtol=1e-5)


@needs_node
def test_zeros_alone(tmp_path):
    """A solution of zeros has no coefficients at all."""
    t = sp.Symbol("t")
    u = sp.Function("u")(t)
    ro.solve(ro.Problem([u.diff(t) + u], (t, 0, 1), {}, {u: 0})).export(tmp_path / "model.mjs")
    assert script(tmp_path, "console.log(JSON.stringify(m.evaluate(0.5)[0]));") == 0.0


@needs_node
def test_out_and_batches(tmp_path):
    """`out` is written and returned, in any array of numbers; a batch may have no points."""
    solution = synthetic()
    solution.export(tmp_path / "model.mjs")
    text = """
    const p = [1, 0.5, 1.5];
    const out = new Float64Array(12);
    const same = [m.evaluate(0, p, out), m.gradient(0, p, out), m.timeDerivative(0, p, out)];
    console.log(JSON.stringify([
      same.every((array) => array === out), m.evaluate(0, p, [0, 0, 7]),
      m.evaluateBatch([], [[], [], []]).length, m.evaluateBatch([], p).length,
      m.evaluateBatch([0, 1], { "x_{0}": 0.5, α: [1.5, 1.25], lambda: 1 }, [0, 0, 0, 0]),
      Array.from(m.evaluateBatch(0, p)), m.curve(p, []).length,
    ]));"""
    same, one, none, nothing, two, scalar, empty = script(tmp_path, text)
    wanted = solution({"t": [0.0, 1.0], "lambda": 1, "x_{0}": 0.5, "α": [1.5, 1.25]})
    assert same
    np.testing.assert_allclose(one[:2], wanted[:, 0], rtol=1e-12)
    assert one[2] == 7
    np.testing.assert_allclose(np.reshape(two, (2, 2)), wanted, rtol=1e-12)
    np.testing.assert_allclose(scalar, wanted[:, 0], rtol=1e-12)
    assert none == nothing == empty == 0


@needs_node
def test_states(tmp_path):
    solution = synthetic()
    solution.export(tmp_path / "model.mjs", states="all")
    text = "console.log(JSON.stringify([m.names, Array.from(m.evaluate(0, [1, 0.5, 1.5]))]));"
    names, values = script(tmp_path, text)
    at = {"t": 0.0, "lambda": 1.0, "x_{0}": 0.5, "α": 1.5}
    assert tuple(names) == solution.states
    np.testing.assert_allclose(values, [solution[name](at) for name in names], rtol=1e-12)
