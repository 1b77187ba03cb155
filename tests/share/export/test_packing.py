"""Models that are smaller and within a tolerance of the solution."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import numpy as np
import pytest

import rankone as ro
from rankone.share.export.model_c import c_model
from rankone.share.export.packing import pack
from rankone.support.errors import OptionError
from tests.problems import EXAMPLES
from tests.share.export.solutions import points, solved, synthetic_with_breaks


def imported(path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def entries(model):
    """Coefficients that are not zero, those of shared cores once."""
    cores = {core.tensor.tobytes(): core.tensor for slab in model.single.slabs for core in slab}
    return sum(int(np.count_nonzero(tensor)) for tensor in cores.values())


@pytest.mark.parametrize(
    ("name", "rtol"), [*((name, 1e-4) for name in EXAMPLES), ("kirchhoff", 1e-7)]
)
def test_within_the_tolerance(name, rtol, tmp_path):
    """At other points than those at which it was measured, many of them on the border."""
    solution = solved(name)
    model = imported(solution.export(tmp_path / "model.py", rtol=rtol))
    where = points(solution, 2000, seed=5)
    rng = np.random.default_rng(6)
    for key, (lower, upper) in solution.parameters.items():
        where[key][1000:] = rng.choice([lower, upper, 0.5 * (lower + upper)], 1000)
    wanted = solution(where)
    size = np.abs(wanted).max(axis=1, keepdims=True)
    assert np.all(np.abs(model.value(where) - wanted) <= rtol * size)


@pytest.mark.parametrize(
    ("name", "share"), [("lotka_volterra", 0.5), ("kirchhoff", 0.65), ("decay", 0.7)]
)
def test_smaller(name, share):
    solution = solved(name)
    full, small = pack(solution), pack(solution, rtol=1e-4)
    assert entries(small) <= share * entries(full)
    path = Path("model.c")
    sizes = [len(c_model(model, path)[path]) for model in (full, small)]
    assert sizes[1] <= share * sizes[0] + 30_000  # half of what stands besides the numbers


def test_cores_stay_shared():
    model = pack(solved("lotka_volterra"), rtol=1e-5)
    assert len({slab[1].tensor.tobytes() for slab in model.single.slabs}) == 1
    assert {core.tensor.shape[1] for slab in model.single.slabs for core in slab[:1]} == {2}


def test_only_what_is_evaluated_counts():
    """A state that is not exported may be large; the others keep their accuracy."""
    solution = synthetic_with_breaks()
    slabs = []
    for slab in solution.outcome.slabs:
        first = slab.cores[0].copy()
        first[2] *= 1e6
        slabs.append(slab.with_first(first))
    outcome = type(solution.outcome)(tuple(slabs), solution.outcome.status, None, ())
    large = ro.Solution(outcome, solution.metadata)
    assert entries(pack(large, rtol=1e-3)) == entries(pack(solution, rtol=1e-3))


def test_the_model_says_it(tmp_path):
    solution = solved("decay")
    for name in ("model.py", "model.c", "model.js"):
        solution.export(tmp_path / name, rtol=1e-4)
        text = (tmp_path / name.replace(".c", ".h")).read_text().replace("\n *", "")
        found = re.search(
            r"within 0\.0001 of the solution.*?measured ([\d.e-]+) at 4200 random points and by "
            r"climbing from the worst of them\.",
            " ".join(text.split()),
        )
        assert 0.0 < float(found[1]) <= 1e-4
    packed = pack(solution, rtol=1e-4)
    assert packed.errors[0] == pytest.approx(solution.error + float(found[1]), rel=0.05)
    solution.export(tmp_path / "full.py")
    assert "Made smaller" not in (tmp_path / "full.py").read_text()


def test_rounding_alone_changes_nothing():
    """Where no smaller train is within the tolerance the model is the solution."""
    solution = synthetic_with_breaks()
    full, same = pack(solution), pack(solution, rtol=1e-12)
    where = points(solution, 100)
    assert entries(same) <= entries(full)
    assert same.errors == full.errors or max(same.errors) <= 1e-12 or np.isnan(same.errors).all()
    assert where


@pytest.mark.parametrize("rtol", [0.0, -1e-3, 0.2, "1e-3", True, float("nan")])
def test_bad_tolerances(rtol, tmp_path):
    with pytest.raises(OptionError, match="rtol="):
        solved("decay").export(tmp_path / "model.py", rtol=rtol)
    assert not list(tmp_path.iterdir())
