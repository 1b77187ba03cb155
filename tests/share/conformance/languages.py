"""What exported models say: one function for each language, all with the same answers."""

from __future__ import annotations

import importlib.util
import json
import re
import shutil
import subprocess
import zipfile
from dataclasses import fields
from functools import cache
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from tests.share.conformance.cases import (
    Answers,
    along,
    points,
    reference,
    solution_of,
    timeline,
    without_time,
)

try:
    import fmpy
    from fmpy.fmi1 import FMICallException
    from fmpy.validation import validate_fmu

    from tests.share.export.fmu_slaves import slave
except ImportError:
    fmpy = None

FOLDER = Path(__file__).parent
COMPILER = shutil.which("gcc") or shutil.which("clang") or shutil.which("cc")
NODE = shutil.which("node")
STRICT = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic"]
SANITIZED = ["-g", "-O0", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
FMU_POINTS = 40
NAMES = ["python", "c", "javascript", "page", "fmu2", "fmu3"]
FMI = {"fmu2": "2.0", "fmu3": "3.0"}


def skip_without_tools(language: str) -> None:
    if language in ("c", *FMI) and COMPILER is None:
        pytest.skip("no C compiler (gcc, clang or cc)")
    if language in ("javascript", "page") and NODE is None:
        pytest.skip("no Node.js (node)")
    if language in FMI and fmpy is None:
        pytest.skip("FMPy is not installed: extra fmi")


class Models:
    """Writes each model once, below one folder, and asks it once."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.answers = cache(self._answers)
        self.javascript = cache(self._javascript)
        self.c = cache(self._c)
        self.imported = cache(self._imported)

    def exported(self, name: str, suffix: str, rtol: float | None = None, **options) -> Path:
        """The file of a model, in a folder of its own."""
        kind = re.sub(r"\W", "", f"{name}{suffix}{rtol or ''}{''.join(options.values())}")
        path = self.folder / kind / f"model{suffix}"
        if not path.parent.exists():
            path.parent.mkdir()
            solution_of(name).export(path, rtol=rtol, **options)
        return path

    def _answers(self, language: str, name: str) -> Answers:
        skip_without_tools(language)
        if language == "python":
            return from_python(self.imported(name), name)
        if language == "c":
            return self.c(name)
        if language in FMI:
            return from_fmu(self.fmu(name, FMI[language]), name)
        return from_javascript(self.javascript(language, name), name)

    def _imported(self, name: str, rtol: float | None = None) -> ModuleType:
        path = self.exported(name, ".py", rtol)
        spec = importlib.util.spec_from_file_location(path.stem, path)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    def _c(self, name: str, *flags: str, count: int | None = None) -> Answers:
        program = self.program(name, *(flags or ("-O2",)))
        return from_c(program, name, count)

    def program(self, name: str, *flags: str) -> Path:
        """Compile a model with the driver; skip if the compiler lacks what the flags ask for."""
        path = self.exported(name, ".c")
        program = path.parent / re.sub(r"\W", "", "".join(flags))
        shapes = ["-DASK_EVENTS"] * (timeline(name) is not None)
        shapes += ["-DASK_BRANCHES"] * (reference(name).branch is not None)
        files = [str(path), str(FOLDER / "driver.c")]
        command = [COMPILER, *STRICT, *flags, *shapes, f"-I{path.parent}", "-o", str(program)]
        run = subprocess.run([*command, *files, "-lm"], capture_output=True, text=True)
        if run.returncode and "sanitize" in " ".join(flags) and "cannot find" in run.stderr:
            pytest.skip("the compiler has no sanitizers")
        assert run.returncode == 0, run.stderr
        return program

    def _javascript(self, language: str, name: str, kinds=("fast",)) -> dict[str, dict]:
        """What a module says, with WebAssembly or without ("plain")."""
        if language == "javascript":
            module = self.exported(name, ".mjs")
        else:
            page = self.page(name).read_text()
            text, names = re.search(
                r"^const model = \(\(\) => \{\n(.*?)\nreturn \{ ([\w, ]+) \};\n\}\)\(\);$",
                page,
                re.M | re.S,
            ).groups()
            module = self.folder / f"{re.sub(r'[^a-z]', '', name)}_page.mjs"
            module.write_text(f"{text}\nexport {{ {names} }};\n")
        asked = module.with_suffix(".json")
        asked.write_text(json.dumps([row.tolist() for row in points(name).values()]))
        requests = [
            {
                "model": str(module),
                "points": str(asked),
                "answers": str(module.with_suffix(f".{kind}.json")),
                "plain": kind == "plain",
            }
            for kind in kinds
        ]
        asking = module.with_suffix(".requests.json")
        asking.write_text(json.dumps(requests))
        command = [NODE, str(FOLDER / "driver.mjs"), str(asking)]
        run = subprocess.run(command, capture_output=True, text=True, timeout=600)
        assert run.returncode == 0, run.stderr
        answers = [json.loads(Path(request["answers"]).read_text()) for request in requests]
        return dict(zip(kinds, answers))

    def page(self, name: str) -> Path:
        return self.exported(name, ".html")

    def fmu(self, name: str, fmi: str) -> Path:
        """The folder that an archive with a binary is extracted to, which FMPy finds valid."""
        path = self.exported(name, ".fmu", fmi=fmi)
        folder = path.parent / "inside"
        if not folder.exists():
            assert validate_fmu(str(path)) == []
            zipfile.ZipFile(path).extractall(folder)
        return folder


def from_python(model: ModuleType, name: str) -> Answers:
    where = points(name)
    at = without_time(name, where)
    names, ranges, events = list(where), reference(name).ranges, timeline(name)
    slopes = model.gradient(where)
    middle = {key: float(0.5 * (a + b)) for key, (a, b) in zip(names, ranges)}

    def refused(key, value):
        for ask in (model.value, model.gradient):
            with pytest.raises(ValueError, match=f"{re.escape(key)} is .*, not in ") as caught:
                ask({**middle, key: value})
        return "NaN" if "nan" in str(caught.value) else "range"

    values = model.value(where)
    singly = [model.value({key: float(row[i]) for key, row in where.items()}) for i in range(40)]
    return Answers(
        values=np.c_[np.transpose(singly), values[:, 40:]],
        batch=values,
        rates=slopes[:, 0],
        gradient=slopes[:, 1:],
        times={e: along(model.event_times(e, at)) for e in events.events} if events else {},
        end=along(model.end(at)) if events else None,
        branch=along(model.branch(at)) if hasattr(model, "branch") else None,
        unknowns=model.UNKNOWNS,
        parameters=model.COORDINATES[1:],
        ranges=np.array(model.INTERVALS),
        refused=tuple(
            refused(key, value)
            for key, (low, high) in zip(names, ranges)
            for value in (low - (high - low), high + (high - low), np.nan)
        ),
    )


def from_c(program: Path, name: str, count: int | None = None) -> Answers:
    solution, wanted = solution_of(name), reference(name)
    table = np.stack(list(points(name).values()), axis=1)[:count]
    count, width = table.shape
    data = np.concatenate([[float(count)], table.ravel()]).tobytes()
    run = subprocess.run([str(program)], input=data, capture_output=True)
    said = run.stderr.decode()
    assert run.returncode == 0, said
    n, events = len(solution.unknowns), timeline(name)
    names = said.splitlines()
    instants = names[n + width - 1 :]
    sizes = [count * n * (1 + width), count * n]
    sizes += [count * (len(instants) + 1)] * bool(events) + [count] * (wanted.branch is not None)
    out = np.frombuffer(run.stdout)
    single, batch, *timed, ranges, refused = np.split(out, np.cumsum([*sizes, 2 * width]))
    assert refused.size == 3 * width
    rows = single.reshape(count, n * (1 + width))
    gradients = np.moveaxis(rows[:, n:].reshape(count, n, width), 0, 2)
    times = timed[0].reshape(count, -1).T if events else np.empty((1, count))
    by_event = {
        event: np.array([row for row, at in zip(times, instants) if event in at.split(" and ")])
        for event in (events.events if events else ())
    }
    return Answers(
        values=rows[:, :n].T,
        batch=batch.reshape(count, n).T,
        rates=gradients[:, 0],
        gradient=gradients[:, 1:],
        times=by_event,
        end=times[-1] if events else None,
        branch=timed[1] if wanted.branch is not None else None,
        unknowns=tuple(names[:n]),
        parameters=tuple(names[n : n + width - 1]),
        ranges=ranges.reshape(width, 2),
        refused=tuple({1: "NaN", 2: "range"}.get(int(kind), str(kind)) for kind in refused),
    )


def from_javascript(said: dict[str, dict], name: str) -> Answers:
    said = said["fast"]

    def numbers(key):
        return np.array(said[key], dtype=float)

    n = len(said["unknowns"])
    kinds = {"OutOfRangeError": "range", "NotANumberError": "NaN"}
    times = {event: np.array(rows, dtype=float).T for event, rows in said.get("times", {}).items()}
    count = numbers("values").shape[0]
    return Answers(
        values=numbers("values").T,
        batch=numbers("batch").reshape(n, -1),
        rates=numbers("rates").T,
        gradient=np.moveaxis(numbers("gradient").reshape(count, n, -1), 0, 2),
        times=times,
        end=numbers("end") if times else None,
        branch=numbers("branch") if "branch" in said else None,
        unknowns=tuple(said["unknowns"]),
        parameters=tuple(said["parameters"]),
        units=said["units"],
        ranges=numbers("ranges"),
        refused=tuple(kinds.get(kind, kind) for kind in said["refused"]),
    )


def from_fmu(folder: Path, name: str) -> Answers:
    """Each point is a simulation of one step; where there are no values the step is discarded."""
    solution, where = solution_of(name), points(name)
    clock, (start, stop) = solution.metadata.time, solution.time
    rows, slopes, refused = [], [], []
    with slave(folder, start) as one:
        begin = one.fmu.getFMUState()
        references = [one.references[u] for u in solution.unknowns]
        for i in range(FMU_POINTS):
            at = {key: float(row[i]) for key, row in where.items()}
            time = at.pop(clock)
            one.fmu.setFMUState(begin)
            try:
                one.set(**at)
                if time > start:
                    one.step(start, time - start)
                reached = one.get(clock)[0]
                values = one.get(*solution.unknowns)
                known = abs(reached - time) <= 1e-9 * (stop - start)
                rates = [
                    one.fmu.getDirectionalDerivative(references, [one.references[key]], [1.0])
                    for key in (clock, *at)
                ]
            except FMICallException:
                known = False
            empty = np.full((len(references), 1 + len(at)), np.nan)
            rows.append(values if known else empty[:, 0])
            slopes.append(np.transpose(rates) if known else empty)
        for key, (low, high) in zip(solution.parameters, reference(name).ranges[1:]):
            for value in (low - (high - low), high + (high - low), np.nan):
                one.fmu.setFMUState(begin)
                with pytest.raises(FMICallException):
                    one.set(**{key: float(value)})
                refused.append("range" if "is outside its range" in one.messages[-1] else "NaN")
        one.fmu.freeFMUState(begin)
        names = list(one.references)
    gradients = np.moveaxis(np.array(slopes), 0, 2)
    about = fmpy.read_model_description(str(folder))
    kinds = {variable.name: variable for variable in about.modelVariables}
    return Answers(
        values=np.transpose(rows),
        rates=gradients[:, 0],
        gradient=gradients[:, 1:],
        unknowns=tuple(names[1 + len(solution.parameters) :]),
        parameters=tuple(names[1 : 1 + len(solution.parameters)]),
        units={key: kind.unit for key, kind in kinds.items() if kind.unit},
        ranges=np.array(
            [solution.time, *([kinds[p].min, kinds[p].max] for p in solution.parameters)], float
        ),
        refused=tuple(refused),
    )


_EVERYTHING = frozenset(field.name for field in fields(Answers))
_OF_FMUS = ("values", "rates", "gradient", "unknowns", "parameters", "units", "ranges", "refused")
OFFERED = {
    "python": _EVERYTHING - {"units"},
    "c": _EVERYTHING - {"units"},
    "javascript": _EVERYTHING,
    "page": _EVERYTHING,
    "fmu2": frozenset(_OF_FMUS),
    "fmu3": frozenset(_OF_FMUS),
}
"""What each language can be asked."""
