"""FMUs of solutions in which the order of events changes with the parameters."""

from __future__ import annotations

import numpy as np
import pytest

from tests.share.export.test_branch_models import solved
from tests.share.export.test_event_fmus import archives
from tests.share.export.test_fmu import both, compile_strictly, fmpy, runs, without_binary

if fmpy is not None:
    from fmpy.fmi1 import FMICallException
    from fmpy.validation import validate_fmu

    from tests.share.export.fmu_slaves import slave

UNKNOWN = "it is not known which order of events holds"


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    return archives(solved, tmp_path_factory)


@runs
@both
def test_steps_on_both_sides_of_a_change(fmi, archive):
    path, _ = archive("washed", fmi)
    assert validate_fmu(str(path)) == []
    solution = solved("washed")
    for b in (1.7, 2.43):
        at = {"a": 2.02, "b": b, "k": 0.4}
        found = fmpy.simulate_fmu(str(path), start_values=at, output_interval=0.05)
        np.testing.assert_allclose(found["time"][-1], 6.0)
        apart = np.abs(found["time"][:, None] - [2.02, b]).min(axis=1) > 1e-9
        wanted = solution["x"](found["time"][apart], at)
        np.testing.assert_allclose(found["x"][apart], wanted, atol=1e-9)


@runs
@both
def test_a_step_to_where_the_order_is_unknown_is_discarded(fmi, archive):
    _, folder = archive("washed", fmi)
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
        wanted = solved("washed")["x"](2.75, a=2.0, b=2.3, k=0.4)
        np.testing.assert_allclose(one.get("x"), wanted, rtol=1e-9)
        one.set(b=2.0)
        with pytest.raises(FMICallException):
            one.get("x")
        assert UNKNOWN in one.messages[-1]


@runs
@both
@pytest.mark.parametrize("name", ["washed", "kicked", "sliver"])
def test_strict_c(name, fmi, tmp_path):
    _, folder = without_binary(solved(name), tmp_path, fmi)
    compile_strictly(folder / "sources", "-O2", "-o", str(tmp_path / "library"))
