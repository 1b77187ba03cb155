"""FMUs of solutions with events: steps over them, the end at a terminal one, unknown orders."""

from __future__ import annotations

import re
import zipfile
from xml.etree import ElementTree

import numpy as np
import pytest

from tests.share.conformance.cases import solution_of
from tests.share.export.test_fmu import both, compile_strictly, fmpy, runs

if fmpy is not None:
    from fmpy.fmi1 import FMICallException
    from fmpy.model_description import CoSimulation

    from tests.share.export.fmu_slaves import slave

BALL = {"h": 1.0, "c": 0.05, "e": 0.8}
ROCKET = {"f": 3000.0, "d": 105.0}  # is back before the horizon ends
UNKNOWN = "it is not known which order of events holds"


def _knows_early_returns():
    """Whether FMPy takes a step of FMI 3 that returned early for one: it does since 0.3.28."""
    return hasattr(CoSimulation(), "mightReturnEarlyFromDoStep")


@runs
@pytest.mark.parametrize("fmi", ["2.0", pytest.param("3.0", marks=pytest.mark.slow)])
def test_steps_over_events(fmi, models):
    folder = models.fmu("ball", fmi)
    path = folder.parent / "model.fmu"
    solution = solution_of("ball")
    found = fmpy.simulate_fmu(str(path), start_values=BALL, output_interval=0.05)
    np.testing.assert_allclose(found["time"][-1], 1.6)
    for name in ("y", "v"):
        wanted = solution[name](found["time"], BALL)
        np.testing.assert_allclose(found[name], wanted, atol=1e-9)
    first = solution.event_times("bounce", BALL)[0]
    with slave(folder, **BALL) as one:
        for at, wanted in ((first - 1e-3, -1), (first + 1e-3, 1)):
            one.step(one.get("t")[0], at - one.get("t")[0])
            assert np.sign(one.get("v")) == wanted


@runs
@both
def test_the_end_at_a_terminal_event(fmi, models):
    """Steps beyond it stop there: FMI 2.0 discards them, FMI 3.0 takes them as they are."""
    folder = models.fmu("rocket", fmi)
    path = folder.parent / "model.fmu"
    solution = solution_of("rocket")
    (end,) = solution.event_times("ground", ROCKET)
    landed = solution(end - 1e-9, ROCKET)
    with slave(folder, **ROCKET) as one:
        one.step(0.0, end - 0.5)
        assert one.ends() == (False, end - 0.5)
        for _ in range(2):  # and again, from there
            now = one.get("t")[0]
            if fmi == "2.0":
                with pytest.raises(FMICallException) as caught:
                    one.step(now, 1.0)
                assert caught.value.status == 2
                assert one.ends() == (True, pytest.approx(end, rel=1e-12))
                said = re.search(r"the solution ends at (\S+)", one.messages[-1])
                assert said is not None
                assert float(said[1].rstrip(".,;")) == pytest.approx(end, rel=1e-12)
            else:
                one.step(now, 1.0)
                assert one.ends() == (True, pytest.approx(end, rel=1e-12))
                assert not one.messages
            assert one.get("t")[0] == pytest.approx(end, rel=1e-12)
            np.testing.assert_allclose(one.get("h", "v", "m"), landed[:3], rtol=1e-6, atol=1e-6)
        one.set(f=3400.0, d=100.0)  # which is still up there
        now = one.get("t")[0]
        np.testing.assert_allclose(one.get("h"), solution["h"](now, f=3400.0, d=100.0), rtol=1e-9)
    said = []  # also keeps FMPy from calling a logger that is gone
    found = fmpy.simulate_fmu(
        str(path),
        start_values=ROCKET,
        output_interval=0.5,
        logger=lambda *text: said.append(text[-1]),
    )
    assert [b"the solution ends at" in text for text in said] == [True] * (fmi == "2.0")
    first = end - 1e-9 if fmi == "2.0" or _knows_early_returns() else end - 0.5
    assert first <= found["time"][-1] < end + 0.5
    assert not np.isnan(found["h"]).any()


def _may_return_early(path):
    """What an FMU of FMI 3 says of its steps."""
    with zipfile.ZipFile(path) as files, files.open("modelDescription.xml") as file:
        (kind,) = ElementTree.parse(file).iter("CoSimulation")
    return kind.get("mightReturnEarlyFromDoStep") == "true"


@runs
def test_early_return_at_the_end(models):
    """Allowed or not, a step beyond the end stops there, and the next may begin at either time."""
    folder = models.fmu("rocket", "3.0")
    path = folder.parent / "model.fmu"
    assert _may_return_early(path)
    assert not _may_return_early(models.exported("washed", ".fmu", fmi="3.0"))
    (end,) = solution_of("rocket").event_times("ground", ROCKET)
    for early in (False, True):
        with slave(folder, early=early, **ROCKET) as one:
            one.step(0.0, end - 0.1)
            assert one.ends() == (False, end - 0.1)
            assert not one.returned_early
            one.step(end - 0.1, 0.3)
            assert one.ends() == (True, pytest.approx(end, rel=1e-12))
            assert one.returned_early == early
            state = one.fmu.getFMUState()
            for begin in (end, end + 0.2):
                one.fmu.setFMUState(state)
                one.step(begin, 0.1)
                assert one.ends() == (True, pytest.approx(end, rel=1e-12))
            with pytest.raises(FMICallException):
                one.step(end + 1.0, 0.1)  # where no step has been
            assert "the step begins at" in one.messages[-1]
            one.fmu.freeFMUState(state)
    table = fmpy.simulate_fmu(
        str(path), start_values=ROCKET, output_interval=0.5, early_return_allowed=True
    )
    last = end if _knows_early_returns() else 0.5 * np.floor(end / 0.5)
    np.testing.assert_allclose(table["time"][-1], last, rtol=1e-12)


@runs
@pytest.mark.parametrize("fmi", [pytest.param("2.0", marks=pytest.mark.slow), "3.0"])
def test_steps_on_both_sides_of_a_change(fmi, models):
    path = models.fmu("washed", fmi).parent / "model.fmu"
    solution = solution_of("washed")
    for b in (1.7, 2.43):
        at = {"a": 2.02, "b": b, "k": 0.4}
        found = fmpy.simulate_fmu(str(path), start_values=at, output_interval=0.05)
        np.testing.assert_allclose(found["time"][-1], 6.0)
        apart = np.abs(found["time"][:, None] - [2.02, b]).min(axis=1) > 1e-9
        wanted = solution["x"](found["time"][apart], at)
        np.testing.assert_allclose(found["x"][apart], wanted, atol=1e-9)


@runs
@pytest.mark.parametrize("fmi", [pytest.param("2.0", marks=pytest.mark.slow), "3.0"])
def test_a_step_to_where_the_order_is_unknown_is_discarded(fmi, models):
    folder = models.fmu("washed", fmi)
    with slave(folder, a=2.0, b=2.0, k=0.4) as one:
        one.step(0.0, 1.5)
        before = one.get("x")
        np.testing.assert_allclose(before, np.exp(-0.6), rtol=1e-3)
        with pytest.raises(FMICallException) as caught:
            one.step(1.5, 1.0)
        assert caught.value.status == 2
        assert UNKNOWN in one.messages[-1]
        assert one.get("x", "t") == [*before, 1.5]
        one.step(1.5, 0.25)  # a shorter one is possible
        one.set(b=2.3)
        one.step(1.75, 1.0)
        wanted = solution_of("washed")["x"](2.75, a=2.0, b=2.3, k=0.4)
        np.testing.assert_allclose(one.get("x"), wanted, rtol=1e-9)
        one.set(b=2.0)
        with pytest.raises(FMICallException):
            one.get("x")
        assert UNKNOWN in one.messages[-1]


@runs
@both
@pytest.mark.parametrize(
    "name",
    ["rocket", *(pytest.param(n, marks=pytest.mark.slow) for n in ("washed", "kicked", "sliver"))],
)
def test_strict_c(name, fmi, models, tmp_path):
    folder = models.fmu(name, fmi)
    compile_strictly(folder / "sources", "-O1", "-o", str(tmp_path / "library"))
