"""Pages of solutions in which the order of events changes: sliders go from one order to another."""

from __future__ import annotations

import csv
import io
from functools import cache

import numpy as np
import pytest

from rankone.tensors.bases.coordinates import round_off
from tests.share.export.browser import settle
from tests.share.export.test_branch_models import solved, values
from tests.share.export.test_event_models import assert_close
from tests.share.export.test_event_pages import chromium, data_of

__all__ = ["chromium"]

FIXED = {"washed": {"a": 2.0, "k": 0.4}, "kicked": {"c": 1.0}}


@cache
def shown(name):
    """A solution with one parameter, which has no Sobol indices: they take long."""
    return solved(name).fix(FIXED[name])


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pages")
    return {name: shown(name).explore(folder / f"{name}.html") for name in FIXED}


@pytest.mark.filterwarnings("error")
def test_what_is_written(pages):
    for name, page in pages.items():
        data, timeline = data_of(page), shown(name).timeline
        assert [len(each) for each in data["stretches"]] == [b.stretches for b in timeline.branches]
        assert all(np.isfinite(np.array(u["low"], dtype=float)).all() for u in data["unknowns"])
        assert "curves that depend on it have a gap" in " ".join(page.read_text().split())


@pytest.mark.slow
@pytest.mark.filterwarnings("error", "ignore:statistics have settled")
def test_sobol_indices_go_across_orders(tmp_path):
    data = data_of(solved("kicked").explore(tmp_path / "page.html", rtol=1e-2))
    shares = np.array(data["sobol"]["first"], dtype=float)
    assert np.nanmax(np.abs(shares)) <= 1.05


def test_curves_on_both_sides_of_a_change(pages, chromium):
    """Curves, values and times of events are those of the solution."""
    solution = shown("washed")
    rounding = round_off(*solution.time)
    with chromium.open(pages["washed"]) as page:
        for b in (1.7, 2.4):
            page.evaluate("(b) => rankone.set({ b, t: 5 })", b)
            settle(page)
            said = page.evaluate("rankone.values()")
            wanted = {name: float(solution.event_times(name, b=b)[0]) for name in ("dose", "wash")}
            order = sorted(wanted, key=wanted.get)
            assert [event["names"] for event in said["events"]] == [[name] for name in order]
            times = [event["time"] for event in said["events"]]
            np.testing.assert_allclose(times, sorted(wanted.values()), rtol=1e-12)
            assert said["values"]["x"] == pytest.approx(float(solution["x"](5.0, b=b)), rel=1e-12)
            at = np.array(said["times"])
            apart = np.abs(at[:, None] - times).min(axis=1) > 1e-9
            curve = np.array(said["curves"]["x"], dtype=float)[apart]
            assert_close(curve, solution["x"](at[apart], b=b))
            for time in times:  # both sides of a jump are drawn
                before = time - at[at < time].max()
                assert time in at
                assert rounding < before < 5.0 * rounding


def test_a_curve_has_a_gap_where_the_order_is_undecided(pages, chromium):
    solution = shown("washed")
    with chromium.open(pages["washed"]) as page:
        page.evaluate("rankone.set({ b: 2, t: 5 })")
        settle(page)
        said = page.evaluate("rankone.values()")
        assert page.locator("#legend .value").all_inner_texts() == ["–"]
        table = list(csv.DictReader(io.StringIO(page.evaluate("rankone.table()"))))
    times, curve = np.array(said["times"]), np.array(said["curves"]["x"], dtype=float)
    wanted = values(solution, {"t": times, "b": 2.0})[0]
    inside = np.abs(times - 2.0) > 1e-9
    assert_close(curve[inside], wanted[inside])
    assert np.isnan(curve[times > 2.01]).all()
    assert np.isfinite(curve[times < 1.99]).all()
    assert len(table) == np.isfinite(curve).sum()
    assert all(np.isfinite(float(row["x"])) for row in table)


def test_an_event_that_is_just_missed_has_no_time(pages, chromium):
    with chromium.open(pages["kicked"]) as page:
        texts = []
        for a in (0.9, 1.0001, 1.2):
            page.evaluate("(a) => rankone.set({ a, t: 1 })", a)
            settle(page)
            texts += page.locator("#events .when").all_inner_texts()
            said = page.evaluate("rankone.values()")
            assert np.isfinite(said["curves"]["x"][1])  # before the event it is known
    missed, unknown, met = texts
    assert (missed, unknown) == ("does not happen", "not known here")
    assert float(met) == pytest.approx(np.arcsin(1.0 / 1.2), abs=1e-3)
