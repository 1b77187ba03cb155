"""Answers of workers in files of memory."""

import os

import numpy as np
import pytest

from rankone.support.tasks import Filed, MemoryFile, filed

pytestmark = pytest.mark.skipif(not hasattr(os, "memfd_create"), reason="needs Linux")


def answer():
    """Arrays in both orders, one of an odd size, and other things."""
    rng = np.random.default_rng(1)
    return {
        "c": rng.random((300, 700)),
        "f": rng.random((40, 50)).T,
        "bytes": np.arange(7, dtype="u1"),
        "n": 3,
    }


def test_arrays_come_back_as_they_were_and_can_be_written():
    sent, file = answer(), MemoryFile()
    there = filed(sent, file.place)
    assert isinstance(there, Filed)
    assert len(there.data) < 2000
    back = file.answer(there)
    file.close()
    assert back["n"] == 3
    for name in ("c", "f", "bytes"):
        np.testing.assert_array_equal(back[name], sent[name])
        back[name][...] = 0
    assert back["f"].flags.f_contiguous


def test_there_is_none_where_a_process_may_open_no_more(monkeypatch):
    def none_left(name):
        raise OSError(24, "Too many open files")

    monkeypatch.setattr(os, "memfd_create", none_left)
    assert MemoryFile.for_workers(2) is None


def test_small_answers_are_sent_as_they_are():
    file = MemoryFile()
    assert filed([1.0], file.place) == [1.0]
    assert file.answer([1.0]) == [1.0]
    file.close()
    assert filed([1.0], None) == [1.0]


def test_a_late_worker_writes_to_no_other_file(tmp_path):
    """Its descriptor may be that of another file when nobody waits for the answer any more."""
    file, sent = MemoryFile(), answer()
    descriptor = int(file.place.path.rpartition("/")[2])
    (tmp_path / "own").write_bytes(b"precious")
    own = os.open(tmp_path / "own", os.O_RDWR)
    os.dup2(own, descriptor)  # closes what it was
    assert filed(sent, file.place) is sent
    os.close(descriptor)
    assert filed(sent, file.place) is sent
    os.close(own)
    assert (tmp_path / "own").read_bytes() == b"precious"


def test_executors_elsewhere_get_no_files():
    assert MemoryFile.for_workers("tcp://scheduler:8786") is None
