"""Functions of a user that workers import: with NumPy alone, so that a worker starts soon."""

from __future__ import annotations

import multiprocessing
import os
import time
from pathlib import Path

import numpy as np

FLAG = "RANKONE_TEST_FLAG"
"""Environment variable that names a file; processes that are spawned inherit it."""


def sine(x):
    return np.sin(x)


def cosine(x):
    return np.cos(x)


def in_a_worker():
    return multiprocessing.parent_process() is not None


def raising(x):
    if in_a_worker():
        raise ValueError("not today")
    return np.sin(x)


def shapeless(x):
    return np.zeros(3) if in_a_worker() else np.sin(x)


def dying_once(x):
    """The first worker that takes the flag away dies."""
    if in_a_worker():
        try:
            Path(os.environ[FLAG]).unlink()
        except FileNotFoundError:
            return np.sin(x)
        os._exit(1)
    return np.sin(x)


def dying(x):
    if in_a_worker():
        os._exit(1)
    return np.sin(x)


def slow(x):
    if in_a_worker():
        time.sleep(0.2)
    return np.sin(x)
