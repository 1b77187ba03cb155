"""What tasks share is loaded once by each worker."""

import pickle
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor

import pytest

from rankone.support.errors import OptionError
from rankone.support.tasks import Parcel, packed, unpacked

LOADED = []


class Counted:
    """Notes each time that it is loaded."""

    def __init__(self, tag):
        self.tag = tag

    def __setstate__(self, state):
        self.__dict__ = state
        LOADED.append(self.tag)


@pytest.fixture
def processes():
    with ProcessPoolExecutor(1) as executor:
        yield executor


def test_a_parcel_is_loaded_once_however_often_it_comes(processes):
    parcels = [packed("it", Counted("processes"), which) for which in (2, processes)]
    assert all(isinstance(parcel, Parcel) for parcel in parcels)
    for _ in range(3):
        arrived = pickle.loads(pickle.dumps(parcels[0]))
        assert unpacked(arrived).tag == "processes"
    assert LOADED.count("processes") == 1


def test_threads_get_the_object():
    content = Counted("threads")
    with ThreadPoolExecutor(1) as executor:
        assert unpacked(packed("it", content, executor)) is content


def test_what_cannot_be_sent_or_loaded():
    with pytest.raises(OptionError, match="the rate cannot be sent to another process"):
        packed("the rate", lambda: 1, 2)
    with pytest.raises(OptionError, match="a worker cannot load the rate: ValueError"):
        unpacked(Parcel("the rate", b"\x80nothing"))


def test_dask_sends_functions_of_scripts_by_value_in_one_parcel():
    distributed = pytest.importorskip("distributed")
    options = {"processes": False, "n_workers": 1, "dashboard_address": None}
    with distributed.LocalCluster(**options) as cluster, distributed.Client(cluster) as client:
        parcel = packed("it", lambda: 3, client.get_executor())
        assert isinstance(parcel, Parcel)
        assert client.submit(unpacked, parcel).result()() == 3
