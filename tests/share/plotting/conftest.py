"""What the tests of plots share."""

from __future__ import annotations

from importlib.util import find_spec

import pytest

collect_ignore_glob = [] if find_spec("matplotlib") else ["test_*.py"]


@pytest.fixture(autouse=True)
def _nothing_is_shown(monkeypatch):
    import matplotlib.pyplot as plt

    def shown(*args, **kwargs):
        raise AssertionError("a plot was shown")

    plt.switch_backend("Agg")
    monkeypatch.setattr(plt, "show", shown)
    yield
    plt.close("all")
