"""FMUs are valid, agree with the solution they were made from, and refuse what they cannot do."""

from __future__ import annotations

import io
import itertools
import math
import re
import shutil
import struct
import subprocess
import sys
import zipfile
from dataclasses import replace
from functools import cache
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

import rankone as ro
from rankone.share.export.model_fmu import checked_fmi, fmu_model
from rankone.share.export.packing import pack
from rankone.support.errors import ExportError, OptionError, RankoneWarning
from rankone.trajectories.system.verdict import Status
from tests.problems import EXAMPLES
from tests.share.export.solutions import points, solved, synthetic

COMPILER = shutil.which("gcc") or shutil.which("clang") or shutil.which("cc")
DRIVER = Path(__file__).parent / "fmu_driver.c"
VERSIONS = ["2.0", "3.0"]
STRICT = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-shared", "-fPIC"]

try:
    import fmpy
    from fmpy.fmi1 import FMICallException
    from fmpy.validation import validate_fmu

    from tests.share.export.fmu_slaves import Slave, slave
except ImportError:
    fmpy = None

needs_compiler = pytest.mark.skipif(COMPILER is None, reason="no C compiler (gcc, clang or cc)")
needs_fmpy = pytest.mark.skipif(fmpy is None, reason="FMPy is not installed: extra fmi")
runs = pytest.mark.skipif(
    COMPILER is None or fmpy is None, reason="no C compiler, or FMPy is not installed"
)
both = pytest.mark.parametrize("fmi", VERSIONS)
newer = pytest.mark.parametrize("fmi", [pytest.param("2.0", marks=pytest.mark.slow), "3.0"])
"""What is the same in both versions is tried with one in every run."""


@cache
def lotka_volterra():
    return ro.solve(EXAMPLES["lotka_volterra"].problem, rtol=1e-3)


@cache
def doses():
    problem = ro.Problem.from_strings(
        rhs={"c": "-k*c"},
        initial={"c": "1"},
        parameters={"k": (0.5, 1)},
        time=(0, 3),
        jumps={(1, 2): {"c": "c + 1"}},
    )
    return ro.solve(problem, rtol=1e-6)


@cache
def alone():
    return solved("decay").fix(k=2.0)


@cache
def before_zero():
    problem = ro.Problem.from_strings(
        rhs={"u": "-k*u"}, initial={"u": "1"}, parameters={"k": (0.5, 5)}, time=(-2, 0)
    )
    return ro.solve(problem, rtol=1e-6)


@cache
def with_units():
    solution = solved("decay")
    units = (("t", "h"), ("k", "1/h"), ("u", "µg/m³"))
    return ro.Solution(solution.outcome, replace(solution.metadata, units=units))


@cache
def far_from_zero():
    problem = ro.Problem.from_strings(
        rhs={"u": "-k*u"}, initial={"u": 1}, parameters={"k": (1, 2)}, time=(1.7e9, 1.7e9 + 10)
    )
    return ro.solve(problem, rtol=1e-4)


SOLUTIONS = {
    "decay": lambda: solved("decay"),
    "lotka_volterra": lotka_volterra,
    "doses": doses,
    "before zero": before_zero,
    "far from zero": far_from_zero,
    "no parameters": alone,
    "no time": lambda: solved("decay").at(1.0),
    "awkward names": synthetic,
    "units": with_units,
}


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    """The file of a solution for a version of FMI, and the folder that it is extracted to."""

    @cache
    def made(name, fmi):
        folder = tmp_path_factory.mktemp("fmu")
        path = SOLUTIONS[name]().export(folder / "model.fmu", fmi=fmi)
        zipfile.ZipFile(path).extractall(folder / "inside")
        return path, folder / "inside"

    return made


@pytest.fixture(scope="module")
def sources(tmp_path_factory):
    """The same without a binary, for tests that read the archive and never run it."""

    @cache
    def made(name, fmi):
        return without_binary(SOLUTIONS[name](), tmp_path_factory.mktemp("fmu"), fmi)

    return made


def without_binary(solution, folder, fmi, **options):
    """Write an FMU whose compiler fails, and extract it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CC", "false")
        with pytest.warns(RankoneWarning, match="no binary, its sources alone"):
            path = solution.export(folder / "model.fmu", fmi=fmi, **options)
    zipfile.ZipFile(path).extractall(folder / "inside")
    return path, folder / "inside"


def sizes(solution):
    """The largest value of each unknown."""
    return np.abs(solution(points(solution, 500))).max(axis=1)


def described(folder):
    return ElementTree.parse(folder / "modelDescription.xml").getroot()


# --- the archive -------------------------------------------------------------------------------


@needs_fmpy
@both
@pytest.mark.parametrize("name", ["no parameters", "no time", "awkward names", "units"])
def test_valid(name, fmi, sources):
    """Simulations validate archives with a binary."""
    path, _ = sources(name, fmi)
    assert validate_fmu(str(path)) == []


@pytest.mark.slow
@runs
def test_valid_on_the_command_line(sources):
    path, _ = sources("units", "3.0")
    command = [sys.executable, "-m", "fmpy", "validate", str(path)]
    run = subprocess.run(command, capture_output=True, text=True)
    assert run.returncode == 0, run.stdout + run.stderr
    assert "No problems found" in run.stdout + run.stderr


@pytest.mark.slow
@needs_compiler
@both
def test_strict_c(fmi, sources, tmp_path):
    """Without a warning, also behind a prefix, and against the headers of the standard."""
    for name in ("decay", "no parameters", "no time", "awkward names"):
        _, folder = sources(name, fmi)
        copy = shutil.copytree(folder / "sources", tmp_path / name)
        compile_strictly(copy, "-O2", "-o", str(tmp_path / "library"))
        compile_strictly(copy, f"-DFMI{fmi[0]}_FUNCTION_PREFIX=model_", "-fsyntax-only")
        if fmpy is not None:
            headers = Path(fmpy.__file__).parent / "c-code"
            interface = copy / f"fmi{fmi[0]}_interface.h"
            interface.write_text(f'#include "fmi{fmi[0]}Functions.h"\n')
            compile_strictly(copy, "-isystem", str(headers), "-fsyntax-only")


def compile_strictly(sources, *flags):
    files = map(str, sources.glob("*.c"))
    run = subprocess.run([COMPILER, *STRICT, *flags, *files], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr


LOG = """\
x 3 logStatusError: modelDescription.xml belongs to another binary: its token is not {token}
x 3 logStatusError: the model is not for model exchange
 3 logStatusError: the instance has no name
t=1.0000 k=2.7500 u=0.0639
t=0.0000 k=1.0000 u=1.0000
first 2 logStatusDiscard: parameter `k`: 99 is outside its range [0.5, 5]
first 3 logStatusError: {no_whole_numbers}
first 2 logStatusDiscard: the step ends at 5, after the stop time 2
0 1 0 0.0000
second 3 logStatusError: fmi{version}DoStep cannot be called before the initialization
0.0000
t=0.5000 k=1.0000 u=0.6065
t=0.0000 k=2.7500 u=1.0000
"""


@pytest.mark.slow
@needs_compiler
@both
def test_sanitized(fmi, sources, tmp_path):
    """No leak and no undefined behaviour; the log says all that is refused."""
    _, folder = sources("decay", fmi)
    text, program = folder / "sources", tmp_path / "driver"
    flags = ["-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", f"-I{text}"]
    flags.append(f"-DFMI={fmi[0]}")
    files = [*map(str, text.glob("*.c")), str(DRIVER)]
    strict = [flag for flag in STRICT if flag not in ("-shared", "-fPIC")]
    command = [COMPILER, *strict, *flags, *files, "-o", str(program)]
    run = subprocess.run(command, capture_output=True, text=True)
    if run.returncode and "cannot find" in run.stderr:
        pytest.skip("the compiler has no sanitizers")
    assert run.returncode == 0, run.stderr
    token = described(folder).get("instantiationToken" if fmi == "3.0" else "guid")
    run = subprocess.run([str(program), token], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    whole = {
        "2.0": "there are no variables of type Integer",
        "3.0": "fmi3GetInt32: the model has nothing of this kind",
    }
    wanted = LOG.format(token=token, version=fmi[0], no_whole_numbers=whole[fmi])
    if fmi == "3.0":  # whose log does not name instances
        wanted = re.sub(r"(?m)^\w* (?=\d \w+:)", "any ", wanted)
    assert run.stdout.replace("-0.0000", "0.0000") == wanted


@both
def test_description(fmi, sources):
    _, folder = sources("units", fmi)
    root = described(folder)
    assert "u' = -k*u" in root.get("description")
    assert "measured error" in root.get("description")
    assert root.find("DefaultExperiment").attrib == {"startTime": "0.0", "stopTime": "2.0"}
    assert [unit.get("name") for unit in root.find("UnitDefinitions")] == ["h", "1/h", "µg/m³"]
    found = {}
    for variable in root.find("ModelVariables"):
        number = variable if fmi == "3.0" else variable.find("Real")
        found[variable.get("name")] = {**variable.attrib, **number.attrib}
    assert list(found) == ["t", "k", "u"]
    asked = {"min": "0.5", "max": "5.0", "start": "2.75", "unit": "1/h"}
    asked |= {"causality": "parameter", "variability": "tunable"}
    assert asked.items() <= found["k"].items()
    assert {"causality": "output", "unit": "µg/m³"}.items() <= found["u"].items()


@both
def test_can_be_passed_on(fmi, sources):
    _, folder = sources("decay", fmi)
    for source in folder.glob("sources/*.[ch]"):
        assert "used, changed and passed on without restriction" in source.read_text()


@pytest.mark.slow
@needs_compiler
@newer
def test_names(fmi, tmp_path):
    """Other characters than XML has, and line breaks, become underscores; names stay distinct."""
    solution = synthetic()
    names = {"parameters": ("a\nb", "a_b", "<&\"' %#\x07"), "time": "a\tb"}
    path = ro.Solution(solution.outcome, replace(solution.metadata, **names)).export(
        tmp_path / "naïve model-1.fmu", fmi=fmi
    )
    zipfile.ZipFile(path).extractall(tmp_path)
    root = described(tmp_path)
    variables = [variable.get("name") for variable in root.find("ModelVariables")]
    assert variables == ["a_b_", "a_b__", "a_b", "<&\"' %#_", "x", "int"]
    assert root.get("modelName") == "naïve model-1"
    model = pack(ro.Solution(solution.outcome, replace(solution.metadata, **names)))
    content = fmu_model(model, Path("a.fmu"), fmi=fmi, name="Pendulum")[Path("a.fmu")]
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        assert b'modelName="Pendulum"' in archive.read("modelDescription.xml")
    assert root.find("CoSimulation").get("modelIdentifier") == "naive_model_1"
    if fmpy is not None:
        assert validate_fmu(str(path)) == []
        with slave(tmp_path) as one:
            with pytest.raises(FMICallException):
                one.set(**{"<&\"' %#_": 9.0})
            (message,) = one.messages
            assert (r"%%##" if fmi == "2.0" else "%#") in message


@both
def test_deterministic(fmi, sources, tmp_path):
    path, folder = sources("decay", fmi)
    again, _ = without_binary(solved("decay"), tmp_path, fmi)
    assert again.read_bytes() == path.read_bytes()
    part = solved("decay").restrict(k=(1, 2))
    (tmp_path / "part").mkdir()
    other, _ = without_binary(part, tmp_path / "part", fmi)
    text = zipfile.ZipFile(other).read("modelDescription.xml").decode()
    key = "instantiationToken" if fmi == "3.0" else "guid"
    assert described(folder).get(key) not in text


def test_smaller(sources, tmp_path):
    """A tolerance makes the model smaller, and its description says so."""
    whole, _ = sources("lotka_volterra", "2.0")
    small, _ = without_binary(lotka_volterra(), tmp_path, "2.0", rtol=0.01)
    assert small.stat().st_size < 0.8 * whole.stat().st_size
    text = zipfile.ZipFile(small).read("modelDescription.xml").decode()
    assert "within 0.01 of the solution" in text


@both
def test_without_a_compiler(fmi, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    with pytest.warns(RankoneWarning, match="no binary, its sources alone: there is no C compiler"):
        path = solved("decay").export(tmp_path / "model.fmu", fmi=fmi)
    names = zipfile.ZipFile(path).namelist()
    assert f"sources/fmi{fmi[0]}.c" in names
    assert not any(name.startswith("binaries") for name in names)
    if fmpy is not None:
        assert validate_fmu(str(path)) == []


@needs_compiler
@pytest.mark.parametrize(
    ("command", "why"), [("no-such-compiler -m32", "that CC names is not found"), ("false", "fail")]
)
def test_compilers_that_fail(command, why, tmp_path, monkeypatch):
    monkeypatch.setenv("CC", command)
    with pytest.warns(RankoneWarning, match=why):
        solved("decay").export(tmp_path / "model.fmu")


def test_refused(tmp_path):
    solution = solved("decay")
    assert [checked_fmi(fmi, ".fmu") for fmi in (2, 2.0, "3", 3)] == [*2 * ["2.0"], *2 * ["3.0"]]
    for fmi in ("1.0", 2.5, ["2.0"], "", True, 20):
        with pytest.raises(OptionError, match=r"use fmi='2.0' or fmi='3.0'"):
            solution.export(tmp_path / "model.fmu", fmi=fmi)
    with pytest.raises(OptionError, match=r"fmi='2.0' does not apply to a `.py` file"):
        solution.export(tmp_path / "model.py", fmi="2.0")
    with pytest.raises(ExportError, match="there is no directory"):
        solution.export(tmp_path / "missing" / "model.fmu")
    with pytest.raises(ExportError, match="not a success"):
        synthetic(Status.TOLERANCE).export(tmp_path / "model.fmu")
    (tmp_path / "model.fmu").write_text("mine")
    with pytest.raises(ExportError, match="exists"):
        solution.export(tmp_path / "model.fmu")
    assert (tmp_path / "model.fmu").read_text() == "mine"


# --- simulation --------------------------------------------------------------------------------


@runs
@both
@pytest.mark.parametrize("name", ["decay", "lotka_volterra"])
def test_simulate(name, fmi, archive):
    """FMPy's simulation, which validates, is the solution, with start values and without."""
    solution = SOLUTIONS[name]()
    path, _ = archive(name, fmi)
    scale = sizes(solution)
    centre = {key: 0.5 * (a + b) for key, (a, b) in solution.parameters.items()}
    given = {key: a + 0.3 * (b - a) for key, (a, b) in solution.parameters.items()}
    for values in (centre, given):
        found = fmpy.simulate_fmu(
            str(path),
            output_interval=(solution.time[1] - solution.time[0]) / 40,
            start_values={} if values is centre else values,
        )
        assert found["time"][[0, -1]] == pytest.approx(solution.time)
        wanted = solution(np.minimum(found["time"], solution.time[1]), values)
        for row, unknown in enumerate(solution.unknowns):
            assert np.abs(found[unknown] - wanted[row]).max() <= 1e-10 * scale[row]


@runs
@newer
@pytest.mark.parametrize("name", ["lotka_volterra", "no time"])
def test_changes_of_parameters(name, fmi, archive):
    """Outputs after a change belong to the trajectory that had the values from its start."""
    solution = SOLUTIONS[name]()
    rng = np.random.default_rng(5)
    scale = 1.0 if solution.metadata.timeless else sizes(solution)
    start, stop = solution.time
    with slave(archive(name, fmi)[1], start) as one:
        time, size = start, (stop - start) / 20
        for _ in range(20):
            values = {k: float(rng.uniform(a, b)) for k, (a, b) in solution.parameters.items()}
            one.set(**values)
            for now in (time, time + size):
                if now > time:
                    one.step(time, size)
                at = values if solution.metadata.timeless else {"t": min(now, stop), **values}
                found = np.array(one.get(*solution.unknowns))
                assert np.all(np.abs(found - solution(at)) <= 1e-10 * scale)
                assert one.get("t")[0] == pytest.approx(now)
            time = one.get("t")[0]
        assert one.get(*values) == list(values.values())
        assert one.messages == []
        with pytest.raises(FMICallException):
            one.step(time, math.inf)
        assert "the time inf is outside" in one.messages[0]


@runs
@newer
def test_jumps(fmi, archive):
    """At a jump the value is that after it."""
    solution = doses()
    with slave(archive("doses", fmi)[1], 0.0, k=0.7) as one:
        for k in range(6):
            one.step(0.5 * k, 0.5)
            assert one.get("c")[0] == pytest.approx(solution(t=0.5 * (k + 1), k=0.7)[0], abs=1e-12)
            exact = sum(np.exp(-0.7 * (0.5 * (k + 1) - j)) for j in range(3) if j <= 0.5 * (k + 1))
            assert one.get("c")[0] == pytest.approx(exact, rel=1e-5)


@runs
@both
def test_refused_values(fmi, archive):
    """Nothing is extrapolated and nothing changes, and a message says why."""
    _, folder = archive("lotka_volterra", fmi)
    with slave(folder, 0.0, x0=9.0, y0=5.0) as one:
        one.step(0.0, 1.0)
        before = one.get("t", "x0", "y0", "x", "y")
        bad = [
            (2, lambda: one.set(x0=12.5), "parameter `x0`: 12.5 is outside its range [8, 12]"),
            (2, lambda: one.set(x0=12 + 1e-9), "parameter `x0`: 12.000000001 is outside "),
            (2, lambda: one.set(y0=5.5, x0=7.0), "parameter `x0`: 7 is outside its range"),
            (2, lambda: one.set(y0=float("nan")), "parameter `y0`: "),
            (3, lambda: one.set(x=1.0), "the variable with the reference 3 is not a parameter"),
            (3, lambda: one.set(t=1.0), "the variable with the reference 0 is not a parameter"),
            (2, lambda: one.step(1.0, 5.5), "the time 6.5 is outside [0, 6], which was solved"),
            (2, lambda: one.step(1.0, float("inf")), "the time inf is outside [0, 6]"),
            (3, lambda: one.step(1.0, 0.0), "the step 0 is not positive"),
            (3, lambda: one.step(1.0, -0.5), "the step -0.5 is not positive"),
            (3, lambda: one.step(1.0, float("nan")), "the step "),
            (3, lambda: one.step(2.0, 0.5), "the step begins at 2, but the time is 1"),
            (3, lambda: one.enter(0.0), "cannot be called between steps"),
        ]
        for count, (status, call, message) in enumerate(bad, 1):
            with pytest.raises(FMICallException) as caught:
                call()
            assert (caught.value.status, one.statuses[-1]) == (status, status)
            assert len(one.messages) == count
            assert message in one.messages[-1]
            assert one.get("t", "x0", "y0", "x", "y") == before
        one.references["none"] = 99
        with pytest.raises(FMICallException):
            one.get("none")
        assert one.messages[-1] == "there is no variable with the reference 99"


@runs
@both
def test_ends_of_ranges(fmi, archive):
    """A value outside by round-off counts as the end of the range."""
    with slave(archive("lotka_volterra", fmi)[1], 0.0) as one:
        one.set(x0=12 + 1e-12)
        assert one.get("x0") == [12.0]
        wanted = one.get("x", "y")
        one.set(x0=12.0)
        assert one.get("x", "y") == wanted


@runs
@newer
def test_far_from_zero(fmi, archive):
    """Seconds since 1970: a millisecond is round-off, a second is none."""
    start, stop = far_from_zero().time
    with slave(archive("far from zero", fmi)[1], start) as one:
        one.step(start, 1.0)
        (before,) = one.get("u")
        with pytest.raises(FMICallException, match="3"):
            one.step(start, 1.0)
        with pytest.raises(FMICallException, match="2"):
            one.step(start + 1.0, stop - start + 0.5)
        assert one.get("u") == [before]
        one.step(start + 1.0, stop - start - 1.0 + 1e-3)
        assert one.get("u")[0] == pytest.approx(far_from_zero()(t=stop, k=1.5)[0], rel=1e-9)


@runs
@newer
@pytest.mark.parametrize(
    ("name", "count", "above"), [("decay", 30, False), ("before zero", 300_000, True)]
)
def test_steps_that_add_up(name, count, above, fmi, archive):
    """The last of many steps ends at the end of the horizon but for round-off, on either side."""
    solution, (_, folder) = SOLUTIONS[name](), archive(name, fmi)
    (start, stop), size = solution.time, 2.0 / count
    times = list(itertools.accumulate(itertools.repeat(size, count), initial=start))
    end = times[-1]
    assert (end > stop + 2e-12) if above else (stop - 1e-12 < end < stop)
    with slave(folder, start, k=2.0) as one:
        one.step(start, times[-20] - start)
        for at in times[-20:-1]:
            one.step(at, size)
        assert one.get("t") == [end]
        assert one.get("u")[0] == pytest.approx(solution(t=stop, k=2.0)[0], rel=1e-10)
        one.set(k=3.0)  # computed anew, at this time
        assert one.get("u")[0] == pytest.approx(solution(t=stop, k=3.0)[0], rel=1e-10)
        state = one.fmu.getFMUState()
        one.fmu.setFMUState(state)
        one.fmu.freeFMUState(state)
        slope = one.fmu.getDirectionalDerivative([one.references["u"]], [0], [1.0])
        assert slope[0] == pytest.approx(-3.0 * one.get("u")[0], rel=1e-3)
        with pytest.raises(FMICallException) as caught:
            one.step(end, size)
        assert caught.value.status == 2
    with slave(folder, start, stop) as one:
        one.step(start, times[-2] - start)
        one.step(times[-2], size)
        assert one.messages == []


@runs
@both
def test_steps_after_discarded_ones(fmi, archive):
    """A discarded step asks for the end, changes nothing, and a shorter one can be taken."""
    with slave(archive("decay", fmi)[1], 0.0, k=2.0) as one:
        one.step(0.0, 1.5)
        assert one.ends() == (False, 1.5)
        before = one.get("t", "k", "u")
        with pytest.raises(FMICallException) as caught:
            one.step(1.5, 1.0)
        assert caught.value.status == 2
        assert one.ends() == (True, 1.5)
        assert one.get("t", "k", "u") == before
        one.step(1.5, 0.5)
        assert one.ends() == (False, 2.0)
        assert one.get("u")[0] == pytest.approx(solved("decay")(t=2.0, k=2.0)[0])


@runs
@both
def test_simulations_beyond_the_horizon(fmi, archive):
    """FMPy fails with a message, or, told nothing of a stop time, does not get beyond."""
    path, _ = archive("decay", fmi)
    said = []

    def logger(*text):  # without one FMPy calls the last one it was given, even if that is gone
        said.append(text[-1])

    with pytest.raises(FMICallException) as caught:
        fmpy.simulate_fmu(str(path), stop_time=3.0, output_interval=0.5, logger=logger)
    assert caught.value.status == 3
    with pytest.raises(FMICallException) as caught:
        fmpy.simulate_fmu(str(path), start_values={"k": 9.0}, logger=logger)
    assert caught.value.status == 2
    beyond = {"stop_time": 3.0, "output_interval": 0.8, "set_stop_time": False, "timeout": 600}
    if fmi == "3.0":
        with pytest.raises(FMICallException) as caught:
            fmpy.simulate_fmu(str(path), logger=logger, **beyond)
        assert caught.value.status == 2
        return
    said.clear()
    found = fmpy.simulate_fmu(str(path), logger=logger, **beyond)
    assert set(found["time"]) == {0.0, 0.8, 1.6}
    wanted = solved("decay")(found["time"], k=2.75)[0]
    np.testing.assert_allclose(found["u"], wanted, rtol=1e-10)
    (message,) = said
    assert b"the time 2.4 is outside [0, 2]" in message


@runs
@both
def test_logging(fmi, archive):
    """Discards are said unless that is switched off, errors always; categories have to be known."""
    one = Slave(archive("decay", fmi)[1], logging=False)

    def messages():
        one.messages.clear()
        for name, value in (("k", 9.0), ("u", 1.0)):
            with pytest.raises(FMICallException):
                one.set(**{name: value})
        return [message.split()[0] for message in one.messages]

    assert messages() == (["parameter", "the"] if fmi == "2.0" else ["the"])
    for on, categories, count in (
        (True, [], 2),
        (False, ["logStatusDiscard"], 1),
        (True, ["logStatusError"], 1),
        (True, ["logStatusError", "logStatusDiscard"], 2),
        (False, [], 1),
    ):
        one.fmu.setDebugLogging(on, categories)
        assert len(messages()) == count
    with pytest.raises(FMICallException) as caught:
        one.fmu.setDebugLogging(True, ["logStatusDiscard", "nope"])
    assert caught.value.status == 3
    assert one.messages[-1] == "there is no log category `nope`"
    assert len(messages()) == 1
    one.free()


@runs
def test_initialization_without_a_start(archive):
    """In FMI 2.0 the start time has to be known first, also after a reset."""
    one = Slave(archive("decay", "2.0")[1])
    for _ in range(2):
        with pytest.raises(FMICallException) as caught:
            one.fmu.enterInitializationMode()
        assert caught.value.status == 3
        assert "before fmi2SetupExperiment" in one.messages[-1]
        one.begin(0.0)
        one.step(0.0, 1.0)
        one.fmu.reset()
    one.free()


@runs
@both
def test_refused_times(fmi, archive):
    _, folder = archive("lotka_volterra", fmi)
    for at, message in (
        ((-1.0,), "the time -1 is outside [0, 6]"),
        ((float("nan"),), "is outside [0, 6]"),
        ((0.0, 7.0), "the time 7 is outside [0, 6]"),
        ((3.0, 2.0), "the stop time 2 is before the start time 3"),
    ):
        one = Slave(folder)
        with pytest.raises(FMICallException) as caught:
            one.begin(*at)
        assert caught.value.status == 3
        assert message in one.messages[0]
        one.free()
    with slave(folder, 0.0, 2.0) as one:
        with pytest.raises(FMICallException) as caught:
            one.step(0.0, 3.0)
        assert caught.value.status == 2
        assert one.messages == ["the step ends at 3, after the stop time 2"]
    with slave(folder, 2.0) as one:  # a later start is a point of the same trajectory
        wanted = lotka_volterra()(t=2.0, x0=10, y0=5)
        np.testing.assert_allclose(one.get("x", "y"), wanted, rtol=1e-10)


@runs
@both
def test_instances(fmi, archive):
    """Several at once, each for itself; reset, end, and a new one."""
    solution, (_, folder) = solved("decay"), archive("decay", fmi)
    many = [Slave(folder, f"number {k}") for k in range(4)]
    rates = [0.5 + k for k in range(4)]
    for one, k in zip(many, rates):
        one.begin(0.0, k=k)
    for step, (one, k) in itertools.product(range(3), zip(many, rates)):
        one.step(0.25 * step, 0.25)
        assert one.get("u", "k") == [pytest.approx(solution(t=0.25 * (step + 1), k=k)[0]), k]
    first, *rest = many
    first.fmu.terminate()
    assert first.get("u")[0] == pytest.approx(solution(t=0.75, k=0.5)[0])
    for refused in (lambda: first.step(0.75, 0.25), lambda: first.set(k=1.0)):
        with pytest.raises(FMICallException):
            refused()
        assert "cannot be called after the end" in first.messages[-1]
    first.fmu.reset()
    assert first.get("t", "k") == [0.0, 0.5 * sum(solution.parameters["k"])]
    first.begin(0.0, k=3.0)
    first.step(0.0, 1.0)
    assert first.get("u")[0] == pytest.approx(solution(t=1.0, k=3.0)[0])
    first.free()
    new = Slave(folder)
    new.begin(0.0, k=2.0)
    assert [one.get("k")[0] for one in (new, *rest)] == [2.0, *rates[1:]]
    for one in (new, *rest):
        one.free()
    with pytest.raises(Exception, match="Failed to instantiate"):
        Slave(folder, token="{another}")


@runs
@both
def test_states(fmi, archive):
    """A state is saved and brought back, also as bytes and in another instance."""
    _, folder = archive("lotka_volterra", fmi)
    everything = ("t", "x0", "y0", "x", "y")
    with slave(folder, 0.0, x0=9.0) as one, slave(folder) as other:
        one.step(0.0, 1.0)
        before, state = one.get(*everything), one.fmu.getFMUState()
        one.set(x0=11.0)
        one.step(1.0, 2.0)
        assert one.get(*everything) != before
        one.fmu.setFMUState(state)
        assert one.get(*everything) == before
        data = one.fmu.serializeFMUState(state)
        copy = other.fmu.deserializeFMUState(data)
        other.fmu.setFMUState(copy)
        assert other.get(*everything) == before
        wrong = other.fmu.deserializeFMUState(b"\xff" * len(data))
        with pytest.raises(FMICallException):
            other.fmu.setFMUState(wrong)
        assert other.messages[-1] == "the state is none of this model"
        assert other.get(*everything) == before
        with pytest.raises(FMICallException):
            other.fmu.deserializeFMUState(data[:-1])
        for owner, held in ((one, state), (other, copy), (other, wrong)):
            owner.fmu.freeFMUState(held)
            assert held.value is None


@runs
@both
def test_corrupt_states(fmi, archive):
    """Each part of a state is looked at: its three times, mode, start known or not, parameters."""
    with slave(archive("decay", fmi)[1], 0.0, k=2.0) as one:
        one.step(0.0, 1.0)
        state = one.fmu.getFMUState()
        layout = struct.Struct("dddiid")
        parts = list(layout.unpack(one.fmu.serializeFMUState(state)))
        one.fmu.freeFMUState(state)
        assert parts == [1.0, sys.float_info.max, 1.0, 4, 1, 2.0]

        def set_state(**changes):
            names = ("time", "stop", "until", "mode", "set_up", "k")
            values = (changes.get(name, part) for name, part in zip(names, parts, strict=True))
            copy = one.fmu.deserializeFMUState(layout.pack(*values))
            try:
                one.fmu.setFMUState(copy)
            finally:
                one.fmu.freeFMUState(copy)

        for changes in (
            *({"mode": mode} for mode in (0, 3, 5, 15, 16, -1)),
            *({"stop": stop} for stop in (math.nan, -math.inf, 2.5, -1.0)),
            *({"time": time} for time in (math.nan, math.inf, 2.5)),
            *({"until": until} for until in (math.nan, math.inf, 0.9)),
            *({"k": k} for k in (math.nan, 9.0)),
            *({"set_up": 0, "mode": mode} for mode in (2, 4, 8)),
            {"set_up": 7, "mode": 1},
        ):
            with pytest.raises(FMICallException):
                set_state(**changes)
            assert one.messages[-1] == "the state is none of this model", changes
            assert one.get("t", "k") == [1.0, 2.0]
        one.messages.clear()
        for changes in ({}, {"stop": 2.0}, {"mode": 8}, {"mode": 1, "set_up": 0}, {"k": 3.0}):
            set_state(**changes)
        assert one.get("k") == [3.0]
        assert one.messages == []


@runs
@both
def test_derivatives(fmi, archive):
    """Directional derivatives are those of the solution."""
    solution, (_, folder) = lotka_volterra(), archive("lotka_volterra", fmi)
    at = {"t": 1.3, "x0": 9.0, "y0": 5.5}
    with slave(folder, 1.3, x0=9.0, y0=5.5) as one:
        names = one.references
        rows, columns = [names["y"], names["x"]], [names[n] for n in ("y0", "t", "x0")]
        found = one.fmu.getDirectionalDerivative(rows, columns, [0.3, -2.0, 1.7])
        gradient, slope = solution.gradient(at), solution.diff("t")(at)
        wanted = 0.3 * gradient[:, 1] - 2.0 * slope + 1.7 * gradient[:, 0]
        np.testing.assert_allclose(found, wanted[::-1], rtol=1e-8)
        for rows, columns in (([names["x0"]], [0]), ([names["x"]], [names["y"]])):
            with pytest.raises(FMICallException):
                one.fmu.getDirectionalDerivative(rows, columns, [1.0])
