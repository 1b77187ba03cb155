"""Find the numeric constants that matter: python tests/benchmarks/constants.py --room tensors

Each constant of a module or class in src/rankone is doubled and halved (a power of ten for tiny and
huge ones, halfway to 1 for factors near 1, integers rounded and at least 1) while small systems of
all kinds are solved. It *matters* to a system whose verdict changes, or whose counted work does by
more than 5 %. Only systems that run a function which reads the constant are solved. All constants
of a file are changed at once first, and those of a group that changes nothing are *inert*; other
groups are split. A constant that no system reads is *unread*.

Each change is made in a process of its own, forked after the library is imported: the name is bound
to the other value in every module that has it, and in defaults of arguments and fields, and module
constants computed from it are computed again. The tuning of an engine, one frozen value, is changed
field by field. Results are JSON lines, one for each constant; what is there already is not tried
again. ``--report`` prints the table.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import argparse
import ast
import importlib
import inspect
import json
import math
import multiprocessing
import pickle
import resource
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

import numpy as np  # noqa: E402
from scipy.stats import beta, norm  # noqa: E402

import rankone as ro  # noqa: E402
from rankone.support.budget import limited  # noqa: E402

SOURCE = ROOT / "src" / "rankone"
WITHIN = 5.0
"""Error over tolerance up to which a value of a success is right."""
STRAY = 0.03
"""Part of the values that may be off: those beside the time of an event are."""
CHANGED = 0.05
"""Relative change of the work above which a constant matters."""
POINTS, TIMES = 8, 12
MOST_SYSTEMS = 14
"""Most systems on which a constant is tried: the quickest that read it."""


# -----------------------------------------------------------------------------
# The systems.


def systems() -> dict[str, Callable[[], Outcome]]:
    """Small systems of all kinds by name: each is solved when it is called."""
    from examples import doses, falling_card
    from tests.benchmarks import events, steep, switches
    from tests.honesty.cases import case
    from tests.problems import GENERAL, REFERENCE
    from tests.reference.decades import DECADES
    from tests.reference.published import PUBLISHED
    from tests.reference.relaxation import RELAXATION
    from tests.reference.saturations import SATURATIONS
    from tests.reference.steady_states import STEADY

    problems: dict[str, Callable[[], Outcome]] = {}

    def add(name: str, make: Callable[[], Any], rtol: float, **options: Any) -> None:
        problems[name] = lambda: solved(name, make(), rtol, options)

    for name, make in REFERENCE.items():
        add(name, make, 1e-6)
    add("linear, train", REFERENCE["linear"], 1e-6, method="train")
    add("coupled, train", REFERENCE["coupled"], 1e-5, method="train")
    add("lotka_volterra, train", REFERENCE["lotka_volterra"], 1e-3, method="train")
    add("robertson, train", REFERENCE["robertson"], 1e-3, method="train")
    add("kirchhoff, train", REFERENCE["kirchhoff"], 1e-2, method="train")
    add("decay, greedy", REFERENCE["decay"], 1e-4, method="greedy")
    add("linear, greedy", REFERENCE["linear"], 1e-3, method="greedy")
    add("coupled, greedy", REFERENCE["coupled"], 1e-2, method="greedy")
    add("free_fall, greedy", REFERENCE["free_fall"], 1e-2, method="greedy")
    add("pendulum, train", lambda: GENERAL["pendulum"].problem, 1e-3, method="train")
    add("doses", lambda: doses.problem, 1e-5)
    add("falling card", lambda: falling_card.problem, 1e-3)
    for name in PUBLISHED_HERE:
        add(name, PUBLISHED[name].problem, 1e-5)
    for name in ("logistic_12", "arrhenius", "clearance", "enzyme"):
        add(f"{name}, decades", DECADES[name].problem, 1e-4)
    add("thermal explosion", RELAXATION["thermal_explosion"].problem, 1e-3)
    for name, (problem, rtol) in events.SYSTEMS.items():
        add(name, lambda problem=problem: problem, rtol)
    for system in switches.systems():
        add(system.name, system.problem, 1e-4)
    saturations = SATURATIONS.values() if isinstance(SATURATIONS, dict) else SATURATIONS
    for system in list(saturations)[::9]:
        add(f"{system.name}, saturation", system.problem, 1e-3)
    for kind in HOSTILE:
        for seed in (0,):
            system = case(kind, seed)
            add(f"{kind} {seed}", system.problem, system.rtol)
    for i, (name, rtol, rhs, box, start, end) in enumerate(steep.cases()):
        if i < 5:
            problem = ro.Problem(
                [steep.sp.Eq(steep.x.diff(steep.t), rhs)], (steep.t, 0, end), box, {steep.x: start}
            )
            add(f"steep {i}: {name}", lambda problem=problem: problem, rtol)
    for resting in STEADY[::8]:
        problems[f"rest: {resting.name}"] = lambda resting=resting: rested(resting)
    add("distributions", _uncertain, 1e-5)
    add("heat", _heat, 1e-4)
    return problems


PUBLISHED_HERE = (
    "piecewise_oscillator",
    "resonance",
    "morris_lecar",
    "richards",
    "budworm",
    "flame",
    "one_compartment",
    "van_der_pol",
    "oregonator",
    "hires",
    "prothero_robinson",
)
HOSTILE = (
    *("pulses", "features", "systems", "steep", "products", "general", "doses", "events"),
    *("passages", "surfaces", "peaks", "moving", "data", "orders", "switches", "levels"),
)


def _uncertain() -> ro.Problem:
    """Two unknowns that depend on a normal and a beta-distributed number."""
    rates = {"x": "-a*x + y", "y": "-b*y**2 + 0.1*x"}
    box = {"a": norm(1.0, 0.1), "b": beta(2.0, 3.0, 0.2, 0.7)}
    return ro.Problem.from_strings(rates, {"x": 1, "y": "b"}, box, (0, 4))


def _heat() -> ro.Problem:
    """A rod of 66 cells, which has the tables of many states."""
    n = 66
    rates = {
        f"u{i}": f"k*({f'u{i - 1}' if i else 'a'} - 2*u{i} + {f'u{i + 1}' if i < n - 1 else '0'})"
        for i in range(n)
    }
    box = {"k": (0.5, 1.5), "a": (0.5, 1.0)}
    return ro.Problem.from_strings(rates, dict.fromkeys(rates, 0), box, (0, 20))


# -----------------------------------------------------------------------------
# What a system comes to.


@dataclass
class Outcome:
    """Verdict, counted work, and values at some points: (states, points, times)."""

    verdict: str
    work: float
    values: Any = None
    rtol: float = 0.0

    def change(self, other: Outcome) -> str:
        """What is different in another outcome; empty if nothing is that matters."""
        if self.verdict != other.verdict:
            return f"{self.verdict} → {other.verdict}"
        ratio = other.work / self.work if self.work else 1.0
        if abs(ratio - 1.0) > CHANGED:
            return f"work × {ratio:.2f}"
        if self.values is not None:
            if other.values is None or other.values.shape != self.values.shape:
                return "values of another shape"
            size = np.nanmax(np.abs(self.values), axis=(1, 2), initial=1e-300)[:, None, None]
            off = np.abs(other.values - self.values) > WITHIN * self.rtol * size
            off |= np.isnan(other.values) != np.isnan(self.values)
            if off.mean() > STRAY:
                return f"{off.mean():.0%} of the values are off"
        return ""


def solved(name: str, problem: ro.Problem, rtol: float, options: Mapping[str, Any]) -> Outcome:
    """The outcome of a solve, and mean and deviation with its values."""
    with limited() as account:
        try:
            solution = ro.solve(problem, rtol, **{"effort": 0.3, **options})
        except ro.RankoneError as error:
            return Outcome(type(error).__name__, account.done)
    if not solution.success:
        return Outcome("refused", account.done)
    box = np.array(list(solution.parameters.values()))
    shares = np.random.default_rng(5).uniform(size=(POINTS, len(box)))
    points = dict(
        zip(solution.parameters, (box[:, 0] + shares * np.ptp(box, axis=1)).T, strict=True)
    )
    start, end = solution.time
    times = np.linspace(start, end, TIMES + 1)[1:]
    values = solution(t=times[None, :], **{key: p[:, None] for key, p in points.items()})
    return Outcome("ok", account.done, np.asarray(values), rtol)


def rested(resting: Any) -> Outcome:
    """The outcome of a search for steady states: values are those at random points."""
    with limited() as account:
        try:
            solution = ro.steady_state(
                resting.system.problem(), settle=resting.settle, rtol=resting.rtol, effort=0.3
            )
        except ro.RankoneError as error:
            return Outcome(type(error).__name__, account.done)
    box = np.array(list(solution.parameters.values()))
    shares = np.random.default_rng(5).uniform(size=(POINTS, len(box)))
    points = (box[:, 0] + shares * np.ptp(box, axis=1)).T
    values = solution(**dict(zip(solution.parameters, points, strict=True)))
    verdict = "ok" if solution.success else "refused"
    return Outcome(verdict, account.done, np.asarray(values)[:, :, None], resting.rtol)


# -----------------------------------------------------------------------------
# The constants, and how they are changed.

Number = Any
"""An int, a float, a tuple or slice of them, or a cost of two."""


@dataclass(frozen=True, eq=False)
class Constant:
    """A constant of a module, or of one of its classes."""

    path: str
    line: int
    owner: str
    name: str

    @property
    def key(self) -> str:
        return f"{self.path}:{self.owner + '.' if self.owner else ''}{self.name}"

    @property
    def module(self) -> str:
        return "rankone." + self.path.removesuffix(".py").replace("/", ".").removesuffix(
            ".__init__"
        )

    @property
    def holder(self) -> Any:
        """The module, or the class, that has it."""
        module = importlib.import_module(self.module)
        return getattr(module, self.owner) if self.owner else module

    @property
    def value(self) -> Number:
        return getattr(self.holder, self.name)


def scaled(value: Number, factor: float) -> Number:
    """The value doubled or halved, as its size asks for."""
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return type(value)(*(scaled(x, factor) for x in value))
    if isinstance(value, tuple | list):
        return type(value)(scaled(x, factor) for x in value)
    if isinstance(value, slice):
        return slice(*(None if x is None else scaled(x, factor) for x in (value.start, value.stop)))
    if isinstance(value, bool) or value == 0:
        return value
    if isinstance(value, int):
        return max(1, round(value * factor)) if value > 0 else round(value * factor)
    if not isinstance(value, float):
        return type(value)(*(scaled(getattr(value, f.name), factor) for f in fields(value)))
    if 0.5 < value < 1.0:
        return 1.0 - (1.0 - value) / 2.0 if factor > 1.0 else value / 2.0
    if 1.0 < value <= 1.5:
        return 1.0 + (value - 1.0) * factor
    if abs(value) < 1e-6 or abs(value) > 1e7:
        other = value * (10.0 if factor > 1.0 else 0.1)
        return other if math.isfinite(other) else sys.float_info.max
    return value * factor


def _numeric(node: ast.expr) -> bool:
    if isinstance(node, ast.Constant):
        return isinstance(node.value, int | float) and not isinstance(node.value, bool)
    if isinstance(node, ast.UnaryOp):
        return _numeric(node.operand)
    if isinstance(node, ast.BinOp):
        return _numeric(node.left) and _numeric(node.right)
    if isinstance(node, ast.Tuple | ast.List):
        return bool(node.elts) and all(map(_numeric, node.elts))
    if isinstance(node, ast.Call):
        named = isinstance(node.func, ast.Name) and node.func.id in ("slice", "Cost")
        return named and all(_numeric(a) or isinstance(a, ast.BinOp) for a in node.args)
    return False


def assigned(body: Sequence[ast.stmt]) -> Iterator[tuple[str, ast.expr, int]]:
    """Names that statements bind, with the expressions."""
    for statement in body:
        if isinstance(statement, ast.Assign):
            target, value = statement.targets[0], statement.value
        elif isinstance(statement, ast.AnnAssign) and statement.value is not None:
            target, value = statement.target, statement.value
        else:
            continue
        if isinstance(target, ast.Name):
            yield target.id, value, statement.lineno


@dataclass
class House:
    """All modules of the library, read and imported."""

    trees: dict[str, ast.Module] = field(default_factory=dict)
    modules: dict[str, ModuleType] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for path in sorted(SOURCE.rglob("*.py")):
            name = str(path.relative_to(SOURCE))
            if name == "__main__.py":
                continue
            try:
                module = importlib.import_module(Constant(name, 0, "", "").module)
            except ImportError:  # of an extra that is not installed
                continue
            self.trees[name] = ast.parse(path.read_text(encoding="utf-8"))
            self.modules[name] = module

    @cached_property
    def constants(self) -> list[Constant]:
        """Those of all files: numbers of modules, and of classes but enumerations."""
        constants = []
        for path, tree in self.trees.items():
            bodies = [("", tree.body)]
            for node in tree.body:
                if isinstance(node, ast.ClassDef) and "Enum" not in "".join(
                    map(ast.unparse, node.bases)
                ):
                    bodies.append((node.name, node.body))
            for owner, body in bodies:
                for name, value, line in assigned(body):
                    named = name.isupper() or owner.endswith("Tuning")
                    if named and _numeric(value) and "SEED" not in name:
                        constants.append(Constant(path, line, owner, name))
        return constants

    @cached_property
    def derived(self) -> list[tuple[str, str, ast.expr, set[str]]]:
        """Constants of modules computed from others: path, name, expression, names in it."""
        derived = []
        for path, tree in self.trees.items():
            for name, value, _ in assigned(tree.body):
                names = {n.id for n in ast.walk(value) if isinstance(n, ast.Name)}
                upper = {n for n in names if n.isupper()}
                if name.isupper() and upper:
                    derived.append((path, name, value, upper))
        return derived

    @cached_property
    def readers(self) -> dict[str, set[tuple[str, int]]]:
        """For each name the functions that read it, as files and first lines."""
        readers: dict[str, set[tuple[str, int]]] = {}

        def read(code: CodeType, path: str) -> None:
            if code.co_name != "<module>":
                for name in code.co_names:
                    readers.setdefault(name, set()).add((path, code.co_firstlineno))
            for inner in code.co_consts:
                if isinstance(inner, CodeType):
                    read(inner, path)

        for path, tree in self.trees.items():
            file = str(SOURCE / path)
            read(compile(tree, file, "exec"), file)
            for node in ast.walk(tree):
                for default in _defaults(node):
                    for inner in ast.walk(default):
                        if isinstance(inner, ast.Name) and inner.id.isupper():
                            readers.setdefault(inner.id, set()).add((file, node.lineno))
        fields = [
            (of.id, name)
            for tree in self.trees.values()
            for node in ast.walk(tree)
            if isinstance(node, ast.ClassDef)
            for name, of, _ in assigned(node.body)
            if isinstance(of, ast.Name) and of.id.isupper()
        ]
        computed = [(of, name) for _, name, _, names in self.derived for of in names]
        for of, name in (*computed, *fields):
            readers.setdefault(of, set()).update(readers.get(name, set()))
        return readers

    def sharing(self, constant: Constant) -> list[str]:
        """The files whose modules have the constant."""
        value = constant.value
        return [
            path
            for path, module in self.modules.items()
            if vars(module).get(constant.name, None) is value
        ]

    def read_by(self, constant: Constant, runs: set[tuple[str, int]]) -> bool:
        """Whether any of the functions that ran reads the constant."""
        return bool(self.readers.get(constant.name, set()) & runs)

    def change(self, constants: Sequence[Constant], factor: float) -> None:
        """Bind constants to other values, in this process for good."""
        changed = {constant.name for constant in constants}
        for constant in constants:
            new = scaled(constant.value, factor)
            files = self.sharing(constant)
            self._bind(constant, new, files)
            for path in files:
                self._redefault(path, constant.name, new)
            if constant.owner.endswith("Tuning"):
                tuned = vars(self.modules[constant.path]).values()
                kept = next(each for each in tuned if type(each).__name__ == constant.owner)
                object.__setattr__(kept, constant.name, new)
            elif constant.owner:
                setattr(constant.holder, constant.name, new)
        for path, name, value, names in self.derived:
            if names & changed:
                module = self.modules[path]
                shared = Constant(path, 0, "", name)
                files = self.sharing(shared)
                code = compile(ast.Expression(value), path, "eval")
                self._bind(shared, eval(code, vars(module)), files)
                changed.add(name)

    def _bind(self, constant: Constant, value: Number, files: Sequence[str]) -> None:
        for path in files:
            setattr(self.modules[path], constant.name, value)

    def _redefault(self, path: str, name: str, value: Number) -> None:
        """Bind defaults of arguments and fields that are the constant."""
        module = self.modules[path]
        for node in ast.walk(self.trees[path]):
            if isinstance(node, ast.FunctionDef):
                if any(isinstance(d, ast.Name) and d.id == name for d in _defaults(node)):
                    for function in _functions(module, node.name):
                        _rebind(function, _arguments(node, name), value)
            elif isinstance(node, ast.ClassDef) and hasattr(module, node.name):
                same = [
                    field
                    for field, default, _ in assigned(node.body)
                    if isinstance(default, ast.Name) and default.id == name
                ]
                holder = getattr(module, node.name)
                if same and inspect.isfunction(holder.__init__):
                    _rebind(holder.__init__, same, value)
                    for each in same:
                        if not hasattr(holder, "__slots__"):
                            setattr(holder, each, value)
                        for kept in vars(module).values():  # the frozen value of a tuning
                            if type(kept) is holder:
                                object.__setattr__(kept, each, value)


def _defaults(node: ast.AST) -> list[ast.expr]:
    if isinstance(node, ast.FunctionDef):
        return [*node.args.defaults, *(d for d in node.args.kw_defaults if d is not None)]
    return []


def _arguments(node: ast.FunctionDef, name: str) -> list[str]:
    """The arguments whose default is the name."""
    plain = [*node.args.posonlyargs, *node.args.args]
    pairs = list(
        zip(plain[len(plain) - len(node.args.defaults) :], node.args.defaults, strict=True)
    )
    pairs += list(zip(node.args.kwonlyargs, node.args.kw_defaults, strict=True))  # type: ignore[arg-type]
    return [a.arg for a, d in pairs if isinstance(d, ast.Name) and d.id == name]


def _functions(module: ModuleType, name: str) -> Iterator[Any]:
    for holder in [module, *(c for c in vars(module).values() if inspect.isclass(c))]:
        function = inspect.unwrap(vars(holder).get(name, None) or (lambda: None))
        function = getattr(function, "__func__", function)
        if inspect.isfunction(function) and function.__name__ == name:
            yield function


def _rebind(function: Any, arguments: Sequence[str], value: Number) -> None:
    code = function.__code__
    positional = code.co_varnames[: code.co_argcount]
    defaults = list(function.__defaults__ or ())
    first = len(positional) - len(defaults)
    for argument in arguments:
        if argument in (function.__kwdefaults__ or {}):
            function.__kwdefaults__[argument] = value
        elif argument in positional and positional.index(argument) >= first:
            defaults[positional.index(argument) - first] = value
    function.__defaults__ = tuple(defaults) or None


# -----------------------------------------------------------------------------
# Runs in forked processes.


def forked(call: Callable[[Callable[[Any], None]], None], seconds: float = 0.0) -> list[Any]:
    """What a call hands to its argument in a process of its own, within a processor time."""
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)

    def run() -> None:
        receiver.close()
        warnings.simplefilter("ignore")
        if seconds:
            resource.setrlimit(resource.RLIMIT_CPU, (math.ceil(seconds), math.ceil(seconds) + 1))
        try:
            call(sender.send)
        except BaseException as error:
            sender.send(error if isinstance(error, MemoryError) else traceback.format_exc())
        sender.close()
        os._exit(0)

    process = context.Process(target=run)
    process.start()
    sender.close()
    answers = []
    try:
        while True:
            answers.append(receiver.recv())
    except EOFError:
        process.join()
    return answers


def attempt(run: Callable[[], Outcome]) -> Outcome:
    """The outcome, also where it is an error that nobody should see."""
    try:
        return run()
    except Exception as error:
        return Outcome(f"{type(error).__name__}: {error}"[:120], 0.0)


@dataclass
class Bench:
    """The systems, what each comes to and runs, and what has been found out."""

    house: House
    runs: Mapping[str, Callable[[], Outcome]]
    most_seconds: float
    outcomes: dict[str, Outcome] = field(default_factory=dict)
    reached: dict[str, set[tuple[str, int]]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)

    def measure(self, kept: Path) -> None:
        """Solve each system once, and note the functions it runs; leave slow ones out.

        What is measured is kept in a file, and read from there the next time.
        """
        measured: dict[str, tuple[Outcome, float, set[tuple[str, int]]]] = {}
        if kept.exists():
            measured = pickle.loads(kept.read_bytes())
        for name, run in self.runs.items():
            if name not in measured:

                def traced(send: Callable[[Any], None], run: Callable[[], Outcome] = run) -> None:
                    ran: set[CodeType] = set()
                    began = time.process_time()
                    sys.setprofile(lambda frame, event, _: ran.add(frame.f_code))
                    outcome = attempt(run)
                    sys.setprofile(None)
                    codes = {(code.co_filename, code.co_firstlineno) for code in ran}
                    here = {code for code in codes if code[0].startswith(str(SOURCE))}
                    send((outcome, time.process_time() - began, here))

                answers = forked(traced, 2.0 + self.most_seconds)
                if not answers or isinstance(answers[0], str):
                    answers = [(Outcome("slow", 0.0), math.inf, set())]
                measured[name] = answers[0]
                kept.write_bytes(pickle.dumps(measured))
            outcome, seconds, _ = measured[name]
            print(f"{name}: {outcome.verdict}, {seconds:.2f} s", flush=True)
            if seconds < self.most_seconds:
                self.outcomes[name], self.seconds[name], self.reached[name] = measured[name]

    @property
    def quickest(self) -> list[str]:
        """The systems, those that take least time first."""
        return sorted(self.reached, key=lambda name: self.seconds[name])

    def affected(self, constants: Sequence[Constant]) -> tuple[str, float, str] | None:
        """The first system that a change of these constants matters to, with factor and change."""
        chosen: set[str] = set()
        for constant in constants:
            reading = [n for n in self.quickest if self.house.read_by(constant, self.reached[n])]
            chosen.update(reading[:MOST_SYSTEMS])
        names = [name for name in self.quickest if name in chosen]
        for factor in (2.0, 0.5):

            def changed(send: Callable[[Any], None], factor: float = factor) -> None:
                self.house.change(constants, factor)
                for name in names:
                    send(name)
                    change = self.outcomes[name].change(attempt(self.runs[name]))
                    if change:
                        send((name, factor, change))
                        return
                send(None)

            limit = 5.0 + 4.0 * sum(self.seconds[name] for name in names)
            answers = forked(changed, limit)
            if not answers:
                return "import", factor, "ends"
            if isinstance(answers[-1], tuple):
                return answers[-1]
            if answers[-1] is not None:
                detail = "takes far longer, or ends the process"
                if "Traceback" in answers[-1]:
                    detail = answers[-1].strip().splitlines()[-1][:120]
                return answers[-2] if len(answers) > 1 else "import", factor, detail
        return None

    def split(self, constants: Sequence[Constant], note: Callable[..., None]) -> None:
        """Note for each constant whether it matters."""
        if not constants:
            return
        effect = self.affected(constants)
        if effect is None:
            for constant in constants:
                note(constant, "inert", None)
        elif len(constants) == 1:
            note(constants[0], "matters", effect)
        else:
            half = len(constants) // 2
            self.split(constants[:half], note)
            self.split(constants[half:], note)


def report(rows: Sequence[Mapping[str, Any]], total: int) -> str:
    """The results as Markdown tables."""
    lines = [f"{len(rows)} of {total} constants are done.", ""]
    for state in ("inert", "unread", "matters"):
        chosen = sorted(
            (row for row in rows if row["state"] == state), key=lambda row: row["constant"]
        )
        lines += [
            f"## {state} ({len(chosen)})",
            "",
            "| constant | value | changed by |",
            "| --- | --- | --- |",
        ]
        lines += [f"| {r['constant']} | {r['value']} | {r['by']} |" for r in chosen] + [""]
    return "\n".join(lines)


def main() -> None:
    """Go through the files of rooms."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument(
        "--room", nargs="*", default=[""], help="folders or files below src/rankone"
    )
    parser.add_argument("--results", type=Path, default=Path("constants.jsonl"))
    parser.add_argument("--table", type=Path, help="where the table is kept up to date")
    parser.add_argument("--seconds", type=float, default=1.5, help="longest system")
    parser.add_argument("--report", action="store_true", help="print the table and end")
    options = parser.parse_args()
    house = House()
    rows = []
    if options.results.exists():
        rows = [json.loads(line) for line in options.results.read_text().splitlines()]
    asked: list[Constant] = []
    for room in options.room:
        asked += [c for c in house.constants if c.path.startswith(room) and c not in asked]
    if options.report:
        print(report(rows, len(asked)))
        return
    done = {row["constant"] for row in rows}
    bench = Bench(house, systems(), options.seconds)
    bench.measure(options.results.with_suffix(".measured"))
    print(f"{len(asked)} constants, {len(bench.outcomes)} systems", flush=True)

    def note(constant: Constant, state: str, effect: tuple[str, float, str] | None) -> None:
        by = f"{effect[0]} × {effect[1]}: {effect[2]}" if effect else ""
        row = {"constant": constant.key, "value": str(constant.value), "state": state, "by": by}
        rows.append(row)
        with options.results.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row, ensure_ascii=False) + "\n")
        if options.table:
            options.table.write_text(report(rows, len(asked)), encoding="utf-8")
        print(f"{constant.key} = {constant.value}: {state} {by}", flush=True)

    files: dict[str, list[Constant]] = {}
    for constant in asked:
        if constant.key not in done:
            files.setdefault(constant.path, []).append(constant)
    for constants in files.values():
        read = []
        for constant in constants:
            if any(house.read_by(constant, reached) for reached in bench.reached.values()):
                read.append(constant)
            else:
                note(constant, "unread", None)
        bench.split(read, note)


if __name__ == "__main__":
    main()
