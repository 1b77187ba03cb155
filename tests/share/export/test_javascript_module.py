"""What a model in JavaScript says of itself, its types, and errors for bad input."""

from __future__ import annotations

import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

import rankone as ro
import rankone.share.export
from rankone.share.export.model_js import _packed
from rankone.support.errors import ExportError
from tests.share.export.node import NODE, close, needs_node, run_driver, script
from tests.share.export.solutions import points, solved, synthetic, synthetic_with_breaks
from tests.solution.evaluation.functions import oscillator

TSC = shutil.which("tsc")
needs_typescript = pytest.mark.skipif(TSC is None, reason="no TypeScript compiler (tsc)")


# --- what it says ------------------------------------------------------------------------------


@needs_node
def test_names_ranges_errors(tmp_path):
    synthetic().export(tmp_path / "synthetic.mjs")
    solution = solved("decay")
    solution.export(tmp_path / "model.mjs")
    text = """import * as s from "./synthetic.mjs";
    const frozen = [m.ranges, m.ranges.k, m.errors, m.names].every(Object.isFrozen);
    console.log(JSON.stringify([m.errors, m.units, frozen, s.names, s.parameters, s.time, s.ranges,
      s.errors]));"""
    errors, units, frozen, names, parameters, time, ranges, unknown = script(tmp_path, text)
    assert errors == solution.errors
    assert units == {}
    assert frozen
    assert (names, parameters, time) == (["x", "int"], ["lambda", "x_{0}", "α"], "t")
    assert ranges == {"t": [-1, 2], "lambda": [-2, 3], "x_{0}": [0.1, 0.7], "α": [1, 2]}
    assert unknown == {"x": None, "int": None}


@needs_node
def test_units(tmp_path):
    solution = solved("decay")
    units = (("t", "s"), ("u", "<kg>"))
    metadata = replace(solution.metadata, units=units)
    ro.Solution(solution.outcome, metadata).export(tmp_path / "model.mjs")
    assert script(tmp_path, "console.log(JSON.stringify(m.units));") == dict(units)


def test_header_and_bytes(tmp_path):
    solution = solved("decay")
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        solution.export(tmp_path / name / "decay.js")
        files = {path.name for path in (tmp_path / name).iterdir()}
        assert files == {"decay.js", "decay.d.ts"}
    module, types = ((tmp_path / "a" / f"decay.{s}").read_text() for s in ("js", "d.ts"))
    assert module == (tmp_path / "b" / "decay.js").read_text()
    for text in (module, types):
        assert all(line in text for line in solution.metadata.equations)
        assert solution.message in " ".join(text.replace("\n *", "").split())
        assert not re.search(r"@\w+@", text)
        assert max(map(len, text.splitlines())) <= 100
    assert 'from "./decay.js"' in module


def test_it_can_be_part_of_a_page(tmp_path):
    """Names end neither a comment nor a script."""
    t, a = sp.symbols("t a</script>")
    u = sp.Function("*/ u<!--")(t)
    solution = ro.solve(ro.Problem([u.diff(t) + a * u], (t, 0, 1), {a: (1, 2)}, {u: 1}), rtol=1e-6)
    solution.export(tmp_path / "model.mjs")
    text = (tmp_path / "model.mjs").read_text()
    assert "</script" not in text
    assert "<!--" not in text
    if NODE:
        show = "console.log(JSON.stringify([m.names, m.parameters, m.evaluate(1, [1])[0]]));"
        names, parameters, value = script(tmp_path, show)
        assert (names, parameters) == (["*/ u<!--"], ["a</script>"])
        assert value == pytest.approx(np.exp(-1.0), rel=1e-5)


@needs_node
def test_units_are_those_of_what_it_has(tmp_path):
    solution = oscillator().solution
    units = (("s", "s"), ("x", "m"), ("x_t", "m/s"))
    solution = ro.Solution(solution.outcome, replace(solution.metadata, units=units))
    for states, wanted in (("unknowns", dict(units[:2])), ("all", dict(units))):
        solution.export(tmp_path / "model.mjs", states=states, overwrite=True)
        assert script(tmp_path, "console.log(JSON.stringify(m.units));") == wanted


def test_shared_cores_are_there_once(tmp_path):
    solution = solved("lotka_volterra")
    assert all(slab.shares_parameters(solution.outcome.slabs[0]) for slab in solution.outcome.slabs)
    size = solution.export(tmp_path / "model.js").stat().st_size
    first, *others = solution.outcome.slabs[0].cores
    count = len(solution.outcome.slabs) * len(solution.unknowns) * first[0].size
    count += sum(core.size for core in others)
    assert size <= 1.02 * count * 8 * 4 / 3 + 30_000


@pytest.mark.parametrize("shape", [(1, 3, 1), (3, 4, 5), (2, 1, 4), (5, 2, 1)])
def test_packed(shape):
    """Zeros above some degree are left out, zeros below it stay."""
    rng = np.random.default_rng(0)
    tensor = rng.standard_normal(shape)
    runs, values = _packed(tensor)
    assert values.size == tensor.size
    assert set(runs) == {shape[1]}
    tensor[:, 1:] = 0.0
    runs, values = _packed(tensor)
    assert set(runs) == {1}
    np.testing.assert_array_equal(values, tensor[:, 0].T.ravel())
    assert _packed(np.zeros(shape))[1].size == 0


def thinned_out():
    """High degrees of some entries are zero."""
    solution = synthetic_with_breaks()
    slabs = []
    for slab in solution.outcome.slabs:
        first = slab.cores[0].copy()
        first[:, 3:, 2:] = 0.0
        first[:, :, 4:] = 0.0
        slabs.append(slab.with_first(first))
    return ro.Solution(replace(solution.outcome, slabs=tuple(slabs)), solution.metadata)


@needs_node
def test_zeros_are_left_out(tmp_path):
    solution = thinned_out()
    thin = solution.export(tmp_path / "model.mjs").stat().st_size
    assert thin < synthetic_with_breaks().export(tmp_path / "full.mjs").stat().st_size
    where = points(solution, 100)
    values, _, slopes, _ = run_driver(tmp_path, solution, where)
    assert close(values, solution(where), 1e-12)
    assert close(slopes, solution.gradient(where), 1e-12)
    p = [0.5, 0.3, 1.2]
    text = f"console.log(JSON.stringify(Array.from(m.curve({p}, [-0.5, 0, 1, 2]))));"
    wanted = solution([-0.5, 0, 1, 2], dict(zip(solution.parameters, p)))
    got = np.reshape(script(tmp_path, text), wanted.shape)
    np.testing.assert_allclose(got, wanted, rtol=1e-11, atol=1e-11)


# --- bad input ---------------------------------------------------------------------------------

ATTEMPT = """
const attempt = (call) => {
  try {
    call();
    return ["none"];
  } catch (error) {
    const is = error instanceof m.ModelError && error instanceof Error;
    return [error.name, error.message, error.coordinate ?? null, error.index ?? null, is];
  }
};
const out = new Float64Array(9).fill(7);
console.log(JSON.stringify([CALLS].map((call) => {
  const out = new Float64Array(9).fill(7);
  return [...attempt(() => call(out)), out.every((value) => value === 7)];
})));
"""
BAD = {
    "m.evaluate(2.1, P, out)": ("OutOfRange", "t is 2.1, not in [-1, 2]", "t"),
    "m.evaluate(-Infinity, P, out)": ("OutOfRange", "t is -Infinity", "t"),
    "m.gradient(0, [1, 0.8, 1.5], out)": ("OutOfRange", "x_{0} is 0.8, not in [0.1, 0.7]", "x_{0}"),
    "m.timeDerivative(NaN, P, out)": ("NotANumber", "t is NaN, not a number", "t"),
    "m.evaluate('0', P, out)": ("NotANumber", 't is "0", not a number', "t"),
    "m.evaluate(undefined, P, out)": ("NotANumber", "t is undefined", "t"),
    "m.evaluate(0, [1, 0.5, null], out)": ("NotANumber", "α is null", "α"),
    "m.evaluate(0, { lambda: 1, α: 1.5 }, out)": (
        "MissingParameter",
        "no value for x_{0}; the parameters are lambda, x_{0}, α",
        "x_{0}",
    ),
    "m.evaluate(0, undefined, out)": (
        "MissingParameter",
        "no value for lambda, x_{0}, α",
        "lambda",
    ),
    "m.evaluate(0, { lambda: 1, 'x_{0}': 0.5, α: 1.5, k: 1 }, out)": (
        "UnknownParameter",
        "no parameter k; the parameters are",
        "k",
    ),
    "m.evaluate(0, [1, 0.5], out)": ("Shape", "2 parameters were given, not 3", None),
    "m.evaluate(0, 1, out)": ("Shape", "the parameters are 1, neither", None),
    "m.evaluate(0, P, new Float64Array(1))": ("Shape", "out is 1 numbers; it needs 2", None),
    "m.gradient(0, P, 'x')": ("Shape", 'out is "x", not a Float64Array', None),
    "m.gradient(0, P, Symbol('x'))": ("Shape", "out is Symbol(x), not a Float64Array", None),
    "m.evaluate(0, P, new Int32Array(2))": ("Shape", "out is Int32Array, not a Float64", None),
    "m.evaluate(0, P, new BigInt64Array(2))": ("Shape", "out is BigInt64Array, not", None),
    "m.evaluate(0, P, Object.freeze([0, 0]))": ("Shape", "out is frozen", None),
    "m.evaluate(Object.create(null), P, out)": ("NotANumber", "t is an object, not a number", "t"),
    "m.evaluate(Symbol('x'), P, out)": ("NotANumber", "t is Symbol(x), not a number", "t"),
    "m.evaluate(0, [1, 0.5, 1n], out)": ("NotANumber", "α is 1, not a number", "α"),
    "m.evaluateBatch([], [1, 0.9, 1.5], out)": ("OutOfRange", "x_{0} is 0.9, not in", "x_{0}"),
    "m.curve(P, 0, out)": ("Shape", "the times are 0, not an array", None),
    "m.curve(P, [0, 1, 3], out)": ("OutOfRange", "t is 3 at position 2", "t"),
    "m.evaluateBatch([0, 0], [1, [0.5, 0.9], 1.5], out)": (
        "OutOfRange",
        "x_{0} is 0.9 at position 1",
        "x_{0}",
    ),
    "m.evaluateBatch([0, 0], [1, [0.5], 1.5], out)": (
        "Shape",
        "1 values of x_{0}, but 2 of t",
        None,
    ),
    "m.evaluateBatch([0, 0, 0, 0, 0], P, out)": ("Shape", "out is 9 numbers; it needs 10", None),
    "m.evaluateBatch([0, 0], { lambda: [1, 1] }, out)": ("MissingParameter", "x_{0}, α", "x_{0}"),
}


@pytest.fixture(scope="module")
def attempts(tmp_path_factory):
    """What came of each bad call."""
    folder = tmp_path_factory.mktemp("bad")
    synthetic().export(folder / "model.mjs")
    calls = ",\n".join(f"(out) => {call.replace('P,', '[1, 0.5, 1.5],')}" for call in BAD)
    return dict(zip(BAD, script(folder, ATTEMPT.replace("CALLS", calls))))


@needs_node
@pytest.mark.parametrize("call", BAD)
def test_bad_input(call, attempts):
    """Each error says what was given and what is expected; nothing is written."""
    kind, message, coordinate = BAD[call]
    name, text, where, index, is_one, kept = attempts[call]
    assert name == f"{kind}Error"
    assert message in text
    assert (index is not None) == ("at position" in text)
    if coordinate is not None:
        assert where == coordinate
    assert is_one
    assert kept


@needs_node
def test_names_that_every_object_has(tmp_path):
    """A parameter may be called as something that objects inherit."""
    problem = ro.Problem.from_strings(
        rhs={"u": "-constructor*u"},
        initial={"u": 1},
        parameters={"constructor": (1, 2)},
        time=(0, 1),
    )
    solution = ro.solve(problem, rtol=1e-6)
    solution.export(tmp_path / "model.mjs")
    text = """let name = "";
    try { m.evaluate(1, {}); } catch (error) { name = error.name; }
    console.log(JSON.stringify([m.evaluate(1, { constructor: 1.5 })[0], name]));"""
    value, name = script(tmp_path, text)
    assert value == pytest.approx(solution(t=1, constructor=1.5)[0], rel=1e-12)
    assert name == "MissingParameterError"


@needs_node
def test_out_may_be_what_is_read(tmp_path):
    """Times and parameters may be in the memory that is written to."""
    synthetic().export(tmp_path / "model.mjs")
    text = """
    const times = Float64Array.of(0, 0.3, 0.8, 1.9);
    const p = [1, 0.5, 1.5];
    const calls = [(t, out) => m.evaluateBatch(t, p, out), (t, out) => m.curve(p, t, out)];
    console.log(JSON.stringify(calls.map((call) => {
      const memory = new Float64Array(16);
      const part = memory.subarray(4, 8);
      part.set(times);
      const wanted = Array.from(call(times));
      const got = Array.from(call(part, memory.subarray(0, 8)));
      return [wanted, got];
    })));"""
    for wanted, got in script(tmp_path, text):
        assert got == wanted


@needs_node
def test_arrays_that_call_the_model(tmp_path):
    """Reading an element may evaluate the model at another point."""
    synthetic().export(tmp_path / "model.mjs")
    text = """
    const calling = (values, j) => {
      const array = [...values];
      const get = () => (m.evaluate(2, [1.4, 0.2, 1.1]), values[j]);
      return Object.defineProperty(array, j, { get });
    };
    const [p, times] = [[1, 0.5, 1.5], [0, 0.3, 1.9]];
    const calls = [
      (wrap) => m.evaluate(1, wrap(p, 1)),
      (wrap) => m.gradient(1, wrap(p, 2)),
      (wrap) => m.curve(wrap(p, 1), wrap(times, 2)),
      (wrap) => m.evaluateBatch(wrap(times, 1), [1, wrap([0.5, 0.2, 0.6], 1), 1.5]),
    ];
    console.log(JSON.stringify(calls.map((call) =>
      [Array.from(call((values) => values)), Array.from(call(calling))])));"""
    for wanted, got in script(tmp_path, text):
        assert got == wanted


@needs_node
def test_round_off_counts_as_the_end(tmp_path):
    """The slack is that of the solution."""
    solution = synthetic()
    solution.export(tmp_path / "model.mjs")
    text = """const slack = 1e-12 * (0.7 - 0.1);
    const end = m.evaluate(2, [1, 0.7, 1.5]);
    const near = m.evaluate(2 + 2e-12, [1, 0.7 + 0.9 * slack, 1.5]);
    let far = "inside";
    try { m.evaluate(2, [1, 0.7 + 1.1 * slack, 1.5]); } catch (error) { far = error.name; }
    console.log(JSON.stringify([end.every((value, i) => value === near[i]), far]));"""
    assert script(tmp_path, text) == [True, "OutOfRangeError"]


def test_paths(tmp_path):
    solution = solved("decay")
    (tmp_path / "model.d.ts").write_text("mine")
    with pytest.raises(ExportError, match=r"model\.d\.ts` exists"):
        solution.export(tmp_path / "model.js")
    solution.export(tmp_path / "model.js", overwrite=True)
    assert "evaluate" in (tmp_path / "model.d.ts").read_text()
    with pytest.raises(ExportError, match="names no target"):
        solution.export(tmp_path / "model.ts")
    with pytest.raises(ExportError, match="cannot be imported"):
        solution.export(tmp_path / "a\nb.js")


# --- types -------------------------------------------------------------------------------------


USE = """
declare const console: { log(...values: unknown[]): void };
import * as m from "./model.mjs";
const values: Float64Array = m.evaluate(0.5, { k: 2 });
const rows: number[] = m.gradient(0.5, [2], [0]);
const line: Float64Array = m.curve({ k: 2 }, [0, 1]);
const many: Float64Array = m.evaluateBatch([0, 1], { k: 2 });
const range: readonly [number, number] = m.ranges.k;
const error: number | null = m.errors.u;
const name: "t" = m.time;
// @ts-expect-error no such parameter
m.evaluate(0.5, { q: 2 });
// @ts-expect-error a parameter is missing
m.evaluate(0.5);
// @ts-expect-error no such unknown
m.errors.v;
console.log(values, rows, line, many, range, error, name, m.OutOfRangeError);
"""


@needs_typescript
def test_declarations_compile(tmp_path):
    solved("decay").export(tmp_path / "model.mjs")
    (tmp_path / "use.mts").write_text(USE)
    command = [TSC, "--noEmit", "--strict", "--target", "es2022", "--module", "nodenext"]
    run = subprocess.run([*command, "use.mts"], cwd=tmp_path, capture_output=True, text=True)
    assert run.returncode == 0, run.stdout
