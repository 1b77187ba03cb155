"""Files written beside their place: what a killed process leaves, and what others are writing."""

from __future__ import annotations

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest

from rankone.support.errors import StorageError
from rankone.support.files import write_files

pytest.importorskip("fcntl")

WRITER = """\
import pathlib, sys
from rankone.support.errors import StorageError
from rankone.support.files import write_files

def content(stream):
    stream.write(b"half")
    stream.flush()
    print("writing", flush=True)
    sys.stdin.readline()
    stream.write(b" and half")

write_files({pathlib.Path(sys.argv[1]): content}, True, StorageError)
"""
"""Writes half a file, says so, and waits for a line."""


def start_writer(place):
    writer = subprocess.Popen(
        [sys.executable, "-c", WRITER, place],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert writer.stdout.readline() == "writing\n"
    return writer


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_the_next_save_removes_what_a_killed_one_left_and_nothing_else(tmp_path):
    place = tmp_path / "u[1].npz"
    other = tmp_path / ".u[1].npz.notes.partial"
    other.touch()
    with start_writer(place) as killed, start_writer(place) as living:
        killed.kill()
        killed.wait()
        assert len(names(tmp_path)) == 3
        write_files({place: b"whole"}, False, StorageError)
        assert place.read_bytes() == b"whole"
        assert len(names(tmp_path)) == 3  # what the living one writes stays
        living.communicate("\n")
        assert living.returncode == 0
    assert place.read_bytes() == b"half and half"
    assert names(tmp_path) == [other.name, place.name]


def test_saves_at_once_do_not_remove_each_others_files(tmp_path):
    place = tmp_path / "u.npz"
    contents = [bytes([k]) * 10_000 for k in range(8)]
    with ThreadPoolExecutor(8) as executor:
        saves = [
            executor.submit(write_files, {place: content}, True, StorageError)
            for content in contents * 20
        ]
    assert all(save.exception() is None for save in saves)
    assert place.read_bytes() in contents
    assert names(tmp_path) == [place.name]
