"""Engines share one protocol."""

from __future__ import annotations

import dataclasses
import typing

import pytest

import rankone as ro
from rankone.solvers.engines.greedy_engine import GreedySlabRecord
from rankone.solvers.outcome import SlabRecord
from rankone.solvers.request import Domain, SolveArguments, SolveRequest
from rankone.solvers.selection import ENGINES, engines_for
from rankone.support.budget import ProgressEvent
from rankone.support.errors import OptionError
from rankone.support.options import Options
from tests.problems import REFERENCE


def test_engines_are_found_by_name() -> None:
    assert list(ENGINES) == ["train", "cross", "greedy"]
    assert all(engines_for(name) == (ENGINES[name],) for name in ENGINES)


def test_auto_takes_the_engines_that_fit() -> None:
    def names(
        *options: str, parameters: int = 3, separated: bool = True, states: int = 2
    ) -> list[str]:
        engines = engines_for("auto", options, parameters, separated=separated, states=states)
        return [engine.name for engine in engines]

    assert names() == ["cross", "train"]
    assert names(parameters=1) == ["train", "cross"]
    assert names(parameters=1, states=63) == ["train", "cross"]
    assert names(parameters=1, states=64) == ["cross", "train"]
    assert names(separated=False) == ["cross"]
    assert names("max_rank", "executor") == ["cross", "train"]


@pytest.mark.parametrize("separated", [True, False])
@pytest.mark.parametrize(
    ("option", "engine"),
    [("max_modes", "greedy"), ("max_sweeps", "train"), ("max_trajectories", "cross")],
)
def test_an_option_of_one_engine_needs_its_name(option: str, engine: str, separated: bool) -> None:
    belongs = rf"'{option}' belongs to method='{engine}', not to method='auto'.*give method="
    with pytest.raises(OptionError, match=belongs):
        engines_for("auto", [option, "max_attempts"], 3, separated=separated)
    assert [each.name for each in engines_for(engine, [option], 3, separated=separated)] == [engine]


@pytest.mark.parametrize("name", ["gredy", "", None, 3, ["train"]])
def test_other_names_are_refused(name: typing.Any) -> None:
    with pytest.raises(OptionError, match=r"is unknown.*choose from auto, train, cross, greedy"):
        engines_for(name)


@pytest.mark.parametrize("name", ENGINES)
def test_an_engine_solves_on_the_domain_it_is_given(name: str) -> None:
    engine = ENGINES[name]
    assert issubclass(engine.options, Options)
    events: list[ProgressEvent] = []
    domain = Domain((0.0, 1.0), ((2.0, 3.0),))
    system = ro.compile(REFERENCE["decay"]()).system
    outcome = engine.run(system, 1e-4, domain=domain, report=events.append)
    assert outcome.status is ro.Status.CONVERGED
    assert (outcome.slabs[0].start, outcome.slabs[-1].end) == domain.horizon
    assert {(basis.lower, basis.upper) for slab in outcome.slabs for basis in slab.bases} == {
        (2.0, 3.0)
    }
    assert events[-1].fraction == pytest.approx(1.0)
    assert all(type(record) is engine.record for record in outcome.history)


@pytest.mark.parametrize("name", ENGINES)
def test_requests_are_checked(name: str) -> None:
    system, groups = ro.compile(REFERENCE["decay"]()).system, [ENGINES[name].options]
    request = SolveRequest.of(system, groups, {}, SolveArguments())
    assert request.check.points == 96
    assert isinstance(request.options_of(groups[0]), groups[0])
    assert SolveRequest.of(system, groups, {}, SolveArguments(check=0)).check.points == 0
    for rtol, check, options in [(0.5, 96, {}), (1e-3, -1, {}), (1e-3, 96, {"max_slab": 1})]:
        with pytest.raises(OptionError):
            SolveRequest.of(system, groups, options, SolveArguments(rtol=rtol, check=check))


def test_a_request_for_a_part_of_the_box() -> None:
    system = ro.compile(REFERENCE["decay"]()).system
    request = SolveRequest.of(system, [], {}, SolveArguments(max_seconds=8.0))
    part = request.on_box({0: (1.0, 1.5)}, 0.25)
    assert part.domain.box[0] == (1.0, 1.5)
    assert part.domain.horizon == request.domain.horizon
    assert part.limits.operations == 0.25 * request.limits.operations
    assert part.limits.seconds == 2.0


@pytest.mark.parametrize("record", [SlabRecord, GreedySlabRecord])
def test_records_are_plain_data_with_annotated_fields(record: type[SlabRecord]) -> None:
    hints = typing.get_type_hints(record)
    for field in dataclasses.fields(record):
        kind = hints[field.name]
        items = typing.get_args(kind)
        assert items[1:] == (...,) if items else kind in (int, float, bool, str), field.name


@pytest.mark.parametrize(
    ("given", "meant"),
    [("max_trajectory", "max_trajectories"), ("executer", "executor"), ("max_degre", "max_degree")],
)
def test_auto_knows_the_options_of_all_that_it_tries(given, meant):
    problem = ro.Problem.from_strings({"x": "-k*x"}, {"x": 1}, {"k": (1, 2)}, (0, 1))
    with pytest.raises(ro.OptionError, match=f"did you mean `{meant}`"):
        ro.solve(problem, **{given: 5})
