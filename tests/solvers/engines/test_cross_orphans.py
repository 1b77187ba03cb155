"""Worker processes end with the process that started them, however it ends."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

fcntl = pytest.importorskip("fcntl")  # locks, which the system lifts when a process ends

PARENT = '''\
import fcntl, os, pathlib, signal, sys, time
from rankone.trajectories.integrators.workers import open_workers

signal.signal(signal.SIGHUP, signal.SIG_DFL)  # a test run under nohup ignores it
signal.signal(signal.SIGINT, signal.default_int_handler)  # one in the background ignores it
folder = pathlib.Path(sys.argv[1])
locks = []


def say(stage):
    """Hold a lock on a file that tells the stage, for as long as this process lives."""
    locks.append(open(folder / f"{os.getpid()}.{stage}", "w"))
    fcntl.flock(locks[-1], fcntl.LOCK_EX)
    print("locked", file=locks[-1], flush=True)


if __name__ != "__main__":
    say("starts")
    time.sleep(float(sys.argv[2]))


class Specification:
    namespace = {}

    def call(self, function, *arguments):
        return function(self, *arguments)


class System:
    specification, n_differential = Specification(), 64


def endless(system, number):
    say("works")
    while True:
        sum(range(1000))


if __name__ == "__main__":
    with open_workers(System(), 2) as workers:
        workers.map(endless, [(0,), (1,)])
'''
"""Starts two workers; takes a folder, and the seconds for which a worker starts."""


@pytest.mark.parametrize(
    "number",
    [
        pytest.param(signal.SIGTERM, marks=pytest.mark.slow),
        pytest.param(signal.SIGHUP, marks=pytest.mark.slow),
        pytest.param(signal.SIGKILL, marks=pytest.mark.slow),
        pytest.param(signal.SIGINT, marks=pytest.mark.slow),
    ],
)
def test_workers_end_with_their_parent_in_the_middle_of_a_task(tmp_path, number):
    assert_workers_end(tmp_path, number, "works")


@pytest.mark.slow
def test_workers_end_with_their_parent_while_they_start(tmp_path):
    assert_workers_end(tmp_path, signal.SIGKILL, "starts", 1.0)


def assert_workers_end(folder: Path, number: int, stage: str, start: float = 0.0) -> None:
    """Send a signal to a process whose workers have come to a stage."""
    script = folder / "parent.py"
    script.write_text(PARENT)
    parent = subprocess.Popen(
        [sys.executable, script, folder, str(start)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        assert until(lambda: sum(path.read_text() != "" for path in folder.glob(f"*.{stage}")) == 2)
        parent.send_signal(number)
        parent.wait()
        assert until(lambda: all(map(is_free, folder.glob(f"*.{stage}"))))
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(parent.pid, signal.SIGKILL)


def is_free(path: Path) -> bool:
    """Whether the process that locked a file has ended."""
    with path.open() as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True


def until(holds) -> bool:
    """Whether something comes to hold, in a minute at most, which no machine is too busy for."""
    return any(holds() or time.sleep(0.05) for _ in range(1200))
