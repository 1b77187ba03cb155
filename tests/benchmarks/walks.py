"""How far a reader walks through the source: python tests/benchmarks/walks.py [SRC]

Two walks are recorded while the calls happen: from ``solve(rtol=...)`` to the comparison that
decides, and from an equation in SymPy to a number of its solution. A walk visits the functions that
lead to each milestone, and goes back to the caller when a call is done. A room is a folder at the
top of the package. Printed are the functions in order, how many files and rooms they are in, and
how often a room is entered again. SRC is the ``src`` folder of another checkout.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Hashable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

SRC = Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).resolve().parents[2] / "src")
sys.path.insert(0, str(SRC.resolve()))

import rankone as ro  # noqa: E402

PACKAGE = Path(ro.__file__).resolve().parent
RTOL = 1.2345e-4
COEFFICIENT = "1.2345"
STAGES = ("Problem", "FirstOrderSystem", "WeakForm", "SeparatedForm", "QuadraticSystem")
SOLVED = ("SlabTrain", "Solution")

Milestone = Callable[[FrameType, str, Any], Hashable]
Calls = list[FrameType]


def inside(frame: FrameType) -> bool:
    """Whether a frame runs code of the package."""
    return Path(frame.f_code.co_filename).is_relative_to(PACKAGE)


def calls_to(frame: FrameType | None) -> Calls:
    """The calls of functions of the package that led to a frame, the outermost first."""
    calls = []
    while frame is not None:
        if inside(frame) and not frame.f_code.co_name.startswith("<"):
            calls.append(frame)
        frame = frame.f_back
    return calls[::-1]


def recorded(run: Callable[[], Any], milestone: Milestone) -> tuple[Any, list[Calls]]:
    """What a run returns, and the calls that led to each milestone when it was first met."""
    walk: dict[Hashable, Calls] = {}

    def profile(frame: FrameType, event: str, argument: Any) -> None:
        name = milestone(frame, event, argument)
        if name is not None and name not in walk:
            walk[name] = calls_to(frame)

    sys.setprofile(profile)
    try:
        returned = run()
    finally:
        sys.setprofile(None)
    return returned, list(walk.values())


def steps(walk: list[Calls]) -> Iterator[tuple[str, str, str]]:
    """Arrow, file and function of each step of a walk."""
    before: Calls = []
    for calls in walk:
        common = 0
        while common < min(len(calls), len(before)) and calls[common] is before[common]:
            common += 1
        back = [("<-", calls[common - 1])] if 0 < common < len(before) else []
        for arrow, frame in [*back, *(("->", frame) for frame in calls[common:])]:
            path = Path(frame.f_code.co_filename).relative_to(PACKAGE)
            yield arrow, path.as_posix(), frame.f_code.co_qualname
        before = calls


def show(title: str, walk: list[Calls]) -> None:
    """Print a walk and its length."""
    print(title)
    rooms: list[str] = []
    files = set()
    for arrow, path, function in steps(walk):
        print(f"  {arrow} {path} {function}")
        files.add(path)
        room = path.partition("/")[0]
        if rooms[-1:] != [room]:
            rooms.append(room)
    entered = len(set(rooms))
    print(f"  {' > '.join(rooms)}")
    print(f"  {len(files)} files, {entered} rooms, {len(rooms) - entered} returns\n")


def tolerance_milestone() -> Milestone:
    """Where ``rtol`` is checked, and where it is first met."""
    decided = []

    def milestone(frame: FrameType, event: str, argument: Any) -> Hashable:
        if decided or not inside(frame):
            return None
        if event == "return" and getattr(argument, "name", None) == "CONVERGED":
            decided.append(True)
            return "decided"
        floats = [local for local in frame.f_locals.values() if isinstance(local, float)]
        if event == "call" and frame.f_code.co_name.startswith("checked") and RTOL in floats:
            return frame.f_code
        return None

    return milestone


def compile_milestone(frame: FrameType, event: str, argument: Any) -> Hashable:
    """Where the stages of a problem, its generated text and its module are made."""
    name = frame.f_code.co_name
    if event == "call" and name in ("__init__", "__post_init__"):
        class_name = type(frame.f_locals.get("self")).__name__
        return class_name if class_name in STAGES else None
    if event != "return" or not inside(frame):
        return None
    if isinstance(argument, str) and COEFFICIENT in argument and "codegen" in str(frame.f_code):
        return "module" if '"""' in argument else "coefficient"
    return "loaded" if name == "load_module" else None


def solve_milestone(frame: FrameType, event: str, argument: Any) -> Hashable:
    """Where the generated right-hand side is first called, a train and the solution are made."""
    if event == "call" and frame.f_code.co_name == "rhs" and not inside(frame):
        return "rates"
    if event == "call" and frame.f_code.co_name in ("__init__", "__post_init__"):
        class_name = type(frame.f_locals.get("self")).__name__
        return class_name if class_name in SOLVED else None
    return None


def deepest(run: Callable[[], Any]) -> list[Calls]:
    """The calls to the innermost function of a run."""
    _, walk = recorded(run, lambda frame, event, _: frame if event == "call" else None)
    return [max(walk, key=len)]


def main() -> None:
    def problem() -> ro.Problem:
        return ro.Problem.from_strings(
            rhs={"x": f"x*({COEFFICIENT} - y)", "y": "-y*(3 - x)"},
            initial={"x": "x0", "y": "y0"},
            parameters={"x0": (8, 12), "y0": (4, 6)},
            time=(0, 1),
        )

    compiled = ro.compile(problem())
    _, walk = recorded(lambda: compiled.solve(RTOL, method="cross"), tolerance_milestone())
    show("From rtol to the comparison that decides:", walk)
    stated, first = recorded(problem, compile_milestone)
    compiled, second = recorded(lambda: ro.compile(stated), compile_milestone)
    solution, third = recorded(lambda: compiled.solve(RTOL, method="cross"), solve_milestone)
    last = deepest(lambda: solution(t=0.5, x0=9, y0=5))
    show("From an equation to its number:", [*first, *second, *third, *last])


if __name__ == "__main__":
    main()
