"""What ``solve_many`` costs and withstands.

``python tests/benchmarks/machines.py speed`` solves 16 pieces of a double well here, on two
processes and, where distributed is installed, on a LocalCluster of two workers. Times on the clock
need a quiet machine. The speed with two free cores is taken from processor times: of the busiest
worker, or half of all, the main process with dask's scheduler included, whichever is larger.

``... kill 20`` kills worker and main process 20 times at random moments, and starts the same
command again until it ends: the bits have to be the same, and no finished file may change.
``... kill 20 0 dask`` does so with a LocalCluster in place of the processes; 0 is the seed.

``... solve`` compares the stages of solves with 300 to 2,000 states here and on two processes, and
``... reference`` the times of the reference alone, on processes that are warm.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

import numpy as np  # noqa: E402

import rankone as ro  # noqa: E402
from rankone.solvers.engines.engine_options import CrossOptions  # noqa: E402
from rankone.solvers.request import Check, SolveArguments, SolveRequest  # noqa: E402
from rankone.solvers.stretches_by_markers import clock_of, over_stretches  # noqa: E402
from rankone.solvers.verification.reference import Reference  # noqa: E402
from rankone.solvers.verification.reference_set import ReferenceSet  # noqa: E402
from rankone.support.budget import limited  # noqa: E402
from rankone.trajectories.integrators.workers import Workers, open_workers  # noqa: E402
from tests.benchmarks.many_states import CASES, Case  # noqa: E402


def double_well(horizon: float, rtol: float) -> tuple[ro.Problem, list[Any], float]:
    """A driven particle between two wells, its box in 16 pieces, and a tolerance."""
    problem = ro.Problem.from_strings(
        {"x": "v", "v": "x - x**3 - c*v + a*cos(t)"},
        {"x": "x0", "v": "v0"},
        {"c": (0.1, 0.4), "x0": (0.5, 1.3), "a": (0.0, 0.1), "v0": (-0.1, 0.1)},
        (0, horizon),
        name="double well",
    )
    return problem, problem.split(c=4, x0=4), rtol


# Those of glibc, which its workers lose since dask asks for another limit of trimming: arrays of
# more than 128 kB would be mapped anew each time, which costs a fifth of the processor time
ALLOCATION = {"MALLOC_MMAP_THRESHOLD_": "33554432", "MALLOC_TRIM_THRESHOLD_": "134217728"}
# What its workers look at all the time, a profile and the ticks of their event loop
LESS_WATCHED = {
    "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False",
    "DASK_DISTRIBUTED__ADMIN__TICK__INTERVAL": "1s",
}
SHORT, LONG = (4.0, 1e-6), (12.0, 1e-7)
"""Horizon and tolerance of solves that are killed, and of those that are timed."""


def bits(solutions: Any) -> str:
    """A digest of values of all solutions."""
    digest = hashlib.sha256()
    for solution in solutions:
        middle = {name: sum(ends) / 2 for name, ends in solution.parameters.items()}
        digest.update(solution(np.linspace(*solution.time, 33), middle).tobytes())
    return digest.hexdigest()[:16]


def processor_times(_: int) -> tuple[int, float]:
    """The number of a worker process, and the seconds of processor time that it took."""
    time.sleep(0.2)
    return os.getpid(), time.process_time()


def timed(executor: Any) -> tuple[str, float, float]:
    """The bits, seconds on the clock, and seconds of processor time of this process."""
    problem, boxes, rtol = double_well(*LONG)
    compiled = ro.compile(problem)
    began, used = time.perf_counter(), time.process_time()
    solutions = ro.solve_many(compiled, boxes, rtol, executor=executor)
    assert solutions.success, solutions
    return bits(solutions), time.perf_counter() - began, time.process_time() - used


def report(name: str, executor: Any, alone: tuple[str, float, float]) -> None:
    """Solve on an executor that is warm, and compare with the solves here."""
    dict(executor.map(processor_times, range(4)))
    before = dict(executor.map(processor_times, range(8)))
    found, seconds, main = timed(executor)
    after = dict(executor.map(processor_times, range(8)))
    used = [after[pid] - before.get(pid, 0.0) for pid in after]
    assert found == alone[0], "the bits differ"
    spent = " + ".join(f"{each:.2f}" for each in [*used, main])
    two_cores = alone[2] / max(*used, (sum(used) + main) / 2)
    print(
        f"{name}: {seconds:.2f} s, {alone[1] / seconds:.2f} x faster on the clock; {spent} s of "
        f"processor time (workers, main): {two_cores:.2f} x with two free cores; the same bits",
        flush=True,
    )


def speed() -> None:
    """Compare with and without workers."""
    os.environ.update(LESS_WATCHED)  # read when distributed is imported
    timed(None)  # imports, and what is kept between solves
    alone = timed(None)
    print(f"here: {alone[1]:.2f} s, {alone[2]:.2f} s of processor time", flush=True)
    with ProcessPoolExecutor(2, get_context("spawn")) as executor:
        ro.solve_many(*double_well(1.0, 1e-2), executor=executor)
        report("two processes", executor, alone)
    try:
        from distributed import Client, LocalCluster
    except ImportError:
        print("LocalCluster: distributed is not installed")
        return
    os.environ.update(ALLOCATION)
    with (
        LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
        Client(cluster) as client,
    ):
        executor = client.get_executor(pure=False)
        ro.solve_many(*double_well(1.0, 1e-2), executor=client)
        report("LocalCluster", executor, alone)


def command(folder: str, dask: bool) -> None:
    """What is killed: 16 pieces on two processes, or a LocalCluster, with a checkpoint."""
    problem, boxes, rtol = double_well(*SHORT)
    with ExitStack() as stack:
        executor: Any = 2
        if dask:
            from distributed import Client, LocalCluster

            options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
            executor = stack.enter_context(Client(stack.enter_context(LocalCluster(**options))))
        solutions = ro.solve_many(problem, boxes, rtol, executor=executor, checkpoint=folder)
    print(bits(solutions), solutions.success, flush=True)


def children(pid: int) -> list[int]:
    """The processes that a process started, but for the one that tracks resources."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            if parent == pid and "spawn_main" in (folder / "cmdline").read_text():
                found.append(int(folder.name))
        except (OSError, ValueError):
            continue
    return found


def left_behind(pids: list[int]) -> int:
    """How many processes are still there after half a minute."""
    end = time.monotonic() + 30.0
    while time.monotonic() < end and any(Path(f"/proc/{pid}").exists() for pid in pids):
        time.sleep(0.1)
    return sum(Path(f"/proc/{pid}").exists() for pid in pids)


def wait(main: subprocess.Popen[str], rng: random.Random) -> None:
    """Wait for a random moment: mostly one while workers work, sometimes one before."""
    if rng.random() < 0.2:
        time.sleep(rng.uniform(0.0, 5.0))
        return
    while main.poll() is None and not children(main.pid):
        time.sleep(0.1)
    time.sleep(rng.uniform(0.0, 15.0))


def kill(count: int, seed: int = 0, where: str = "processes") -> None:
    """Kill a worker or the main process ``count`` times, and start the same command again."""
    rng = random.Random(seed)
    problem, boxes, rtol = double_well(*SHORT)
    expected = bits(ro.solve_many(problem, boxes, rtol))
    killed: dict[str, int] = {"main": 0, "worker": 0}
    orphans, rewritten = 0, 0
    while sum(killed.values()) < count:
        with tempfile.TemporaryDirectory() as folder:
            stamps: dict[str, int] = {}
            while True:
                call = [sys.executable, __file__, "command", folder, where]
                main = subprocess.Popen(call, stdout=subprocess.PIPE, text=True)
                while main.poll() is None:
                    wait(main, rng)
                    finished = {p.name: p.stat().st_mtime_ns for p in Path(folder).glob("solve-*")}
                    rewritten += sum(finished.get(name) != at for name, at in stamps.items())
                    stamps |= finished
                    if main.poll() is not None or sum(killed.values()) >= count:
                        continue
                    workers = children(main.pid)
                    victim = "worker" if workers and rng.random() < 0.5 else "main"
                    target = rng.choice(workers) if victim == "worker" else main.pid
                    try:
                        os.kill(target, signal.SIGKILL)
                    except ProcessLookupError:
                        continue
                    killed[victim] += 1
                    if victim == "main":
                        main.wait()
                        orphans += left_behind(workers)
                assert main.stdout is not None
                lines = main.stdout.read().split()
                if main.returncode == 0:
                    break
            assert lines == [expected, "True"], lines
        print(f"killed so far: {killed}", flush=True)
    print(f"{killed}: the same bits, {orphans} orphans, {rewritten} finished files solved again")
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    print(f"peak of one process {peak:.0f} MB")


def solves() -> None:
    """Compare the seconds on the clock by stage, with and without two processes."""
    for name in ("mass action, 300", "chain of 1,000", "epidemic, 1,000 nodes"):
        case, found = CASES[name], []
        compiled = ro.compile(case.problem())
        for executor in (None, 2):
            solution = compiled.solve(case.rtol, executor=executor)
            found.append(bits([solution]))
            stages = (f"{key} {solution.timings[key]:.2f}" for key in ("reference", "march"))
            print(f"{name}, executor={executor}: {', '.join(stages)} s", flush=True)
        assert found[0] == found[1], "the bits differ"


def relaxing() -> ro.Problem:
    """An oscillator whose trajectories jump at times of their own: they are integrated alone."""
    rates, start = {"x": "y", "y": "mu*(1 - x**2)*y - x"}, {"x": "2", "y": "0"}
    return ro.Problem.from_strings(rates, start, {"mu": (80, 120)}, (0, 300))


def sticking() -> ro.Problem:
    """The same oscillator, slowed down each time it comes to the left."""
    brake = {"when": "x + 1", "direction": "falling", "then": {"y": "y/2"}}
    rates, start = {"x": "y", "y": "mu*(1 - x**2)*y - x"}, {"x": "2", "y": "0"}
    return ro.Problem.from_strings(rates, start, {"mu": (80, 120)}, (0, 300), events=[brake])


def references(names: list[str]) -> None:
    """Compare references here and on two processes."""
    problems = {name: CASES[name] for name in ("heat, 500", "epidemic, 1,000 nodes")}
    problems["relaxation oscillator"] = Case(relaxing, 1e-3)
    problems["relaxation oscillator with events"] = Case(sticking, 1e-3)
    chosen = [n for n in problems if not names or any(n.startswith(given) for given in names)]
    with ProcessPoolExecutor(2, get_context("spawn")) as executor:
        for name in chosen:
            case = problems[name]
            system = ro.compile(case.problem()).system
            how = "single" if len(system.states) < 64 else "auto"  # no stack is tried before
            request = SolveRequest.of(
                system, [CrossOptions], {}, SolveArguments(case.rtol, integrator=how)
            )
            if system.events:
                system, request = over_stretches(clock_of(system, request), request)
            times, found = np.linspace(*system.horizon, 9), []
            for given in (None, executor):
                with limited(), open_workers(system, given) as workers:
                    if given is not None:  # they load the system
                        integrated_by(workers, replace(request, check=Check(2)))
                    before = dict(executor.map(processor_times, range(8)))
                    began, used_here = time.perf_counter(), time.process_time()
                    reference = integrated_by(workers, request)
                    here, seconds = time.process_time() - used_here, time.perf_counter() - began
                    after = dict(executor.map(processor_times, range(8)))
                    used = [after[pid] - before.get(pid, 0.0) for pid in after]
                    times_used = here + max(used), used, here, seconds
                    found.append((reference(times).tobytes(), *times_used))
            (bits_here, alone, *_, clock), (bits_there, together, used, here, spread) = found
            assert bits_here == bits_there, "the bits differ"
            spent = " + ".join(f"{each:.2f}" for each in [*used, here])
            print(
                f"{name}, {reference.integrator}: {alone:.2f} s here; {spent} s (workers, main): "
                f"{alone / together:.2f} x with two free cores; {clock:.2f} and {spread:.2f} s on "
                f"the clock, {clock / spread:.2f} x; the same bits",
                flush=True,
            )


def integrated_by(workers: Workers, request: SolveRequest) -> Reference:
    """The reference of a solve."""
    return ReferenceSet.of(workers.system, request, None, workers).reference


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    for name, run in {"speed": speed, "solve": solves}.items():
        plain = commands.add_parser(name, help=str(run.__doc__).partition("\n")[0])
        plain.set_defaults(run=lambda _, run=run: run())
    referring = commands.add_parser("reference", help=str(references.__doc__))
    referring.add_argument("names", nargs="*", help="those whose names begin so; all by default")
    referring.set_defaults(run=lambda asked: references(asked.names))
    killing = commands.add_parser("kill", help="kill processes, and start the same command again")
    killing.add_argument("count", type=int, help="how often")
    killing.add_argument("seed", type=int, nargs="?", default=0)
    killing.add_argument("where", nargs="?", choices=("processes", "dask"), default="processes")
    killing.set_defaults(run=lambda asked: kill(asked.count, asked.seed, asked.where))
    killed = commands.add_parser("command", help=str(command.__doc__))
    killed.add_argument("folder")
    killed.add_argument("where", choices=("processes", "dask"))
    killed.set_defaults(run=lambda asked: command(asked.folder, asked.where == "dask"))
    asked = parser.parse_args()
    asked.run(asked)


if __name__ == "__main__":
    main()
