"""Experiments: what was measured under which conditions, checked against a solution."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rankone.inference.estimation import tables
from rankone.inference.estimation.fitted_models import Model, model_of
from rankone.inference.estimation.formulas import Dual, Operand, coordinate
from rankone.inference.estimation.free_parameters import ParameterValues
from rankone.inference.estimation.observations import (
    DataOptions,
    Measurements,
    Observations,
    Sigma,
    label,
    observed,
)
from rankone.solution.evaluation.core import SolutionCore
from rankone.support.arrays import Array
from rankone.support.errors import OptionError, did_you_mean, listing, quote, shown
from rankone.tensors.joint_distribution import by_name


@dataclass(frozen=True)
class Experiment:
    """Measurements under known conditions, for :func:`rankone.fit`.

    Parameters
    ----------
    data : table, mapping or array_like
        A table (a pandas DataFrame, or a mapping that has a column of time), or measurements as
        for :meth:`Solution.fit`, whose times are ``times``.
    times : array_like or mapping, optional
        Times of the measurements, where ``data`` is no table.
    fixed : mapping, optional
        Values of parameters in this experiment, by names or symbols: a dose, a temperature. For a
        table with a column ``condition`` or ``subject``, perhaps a mapping for some labels.
    observe : name, symbol, expression, list or mapping, optional
        What was measured; see :meth:`Solution.fit`.
    sigma : optional
        Standard deviations, numbers or expressions; see :meth:`Solution.fit`.
    noise : str or mapping, optional
        The kind of noise; see :meth:`Solution.fit`.
    weights : array_like, optional
        One over the variance up to a common factor.
    name : str, optional
        The name of the experiment in messages and plots.
    missing : {"error", "drop"}
        Whether NaN among the data is an error, or left out; tables leave out empty cells.
    doses : mapping, optional
        For a table with rows of doses, the parameter that is the amount and the column of amounts;
        see :meth:`Solution.fit`.
    """

    data: Any
    times: Measurements | None = None
    _: KW_ONLY
    fixed: Mapping[Any, Any] = field(default_factory=dict)
    observe: object = None
    sigma: Sigma = None
    noise: object = None
    weights: Measurements | None = None
    name: str = ""
    missing: str = "error"
    doses: Mapping[Any, str] | None = None

    def __repr__(self) -> str:
        fixed = ", ".join(f"{name}={value}" for name, value in self.fixed.items())
        return f"Experiment {self.name or 'without a name'}{f' with {fixed}' if fixed else ''}"


class Seeds(NamedTuple):
    """Which derivatives are wanted: for each name its column among ``width``."""

    columns: Mapping[str, int]
    width: int


class Predicted(NamedTuple):
    """What the model says of one observable: its values, and the standard deviation of the data."""

    value: Operand
    sigma: Operand


@dataclass(frozen=True)
class Trial:
    """One experiment with the solution that describes it.

    ``fixed`` are the parameters that this experiment fixes. The ``model`` has, for each observable
    in turn, each of its states ``rows`` at each of its times. With ``doses`` the states are sums of
    their curves; ``places`` (m,) are the rows of the table that the data stand in.
    """

    name: str
    solution: SolutionCore
    fixed: dict[str, float]
    observations: Observations
    model: Model
    doses: tables.Doses | None = None
    places: NDArray[np.intp] | None = None

    @property
    def rows(self) -> tuple[tuple[str, ...], ...]:
        """For each observable the states that it and its noise depend on."""
        return states_of(self.solution, self.observations)

    @property
    def size(self) -> int:
        """Number of states of the model."""
        pairs = zip(self.rows, self.observations.noises, strict=True)
        return sum(len(rows) * noise.spread.size for rows, noise in pairs)

    @property
    def parameters(self) -> tuple[str, ...]:
        """The parameters of the solution that this experiment does not fix."""
        return tuple(name for name in self.solution.parameters if name not in self.fixed)

    @property
    def extras(self) -> tuple[str, ...]:
        """Parameters that the observables and their noise have beside those of the solution."""
        own = {*self.solution.states, *self.solution.parameters, self.solution.metadata.time}
        own |= set(self.observations.names)
        formulas = [*self.observations.formulas]
        formulas += [noise.formula for noise in self.observations.noises if noise.formula]
        names = (name for formula in formulas for name in formula.names)
        return tuple(dict.fromkeys(name for name in names if name not in own))

    def points(self, at: Mapping[str, Array]) -> Array:
        """The parameters of the solution (d, K) for values (K,) by name."""
        size = len(next(iter(at.values())))
        every = self.solution.metadata.parameters
        rows = [np.full(size, self.fixed[p]) if p in self.fixed else at[p] for p in every]
        return np.array(rows).reshape(len(every), size)

    def states(self, at: Mapping[str, Array]) -> Array:
        """Values (K, M) of the states of the model."""
        return self.model.values(self.points(at))

    def linearised(self, at: Mapping[str, Array], seeds: Seeds) -> tuple[Array, Array]:
        """The states with their derivatives (K, M, w)."""
        every = self.solution.metadata.parameters
        moving = [name in seeds.columns and name not in self.fixed for name in every]
        free = np.flatnonzero(moving).tolist()
        points = self.points(at)
        if not free:
            states = self.model.values(points)
            return states, np.zeros((*states.shape, seeds.width))
        states, moved = self.model.linearised(points, free)
        slopes = np.zeros((*states.shape, seeds.width))
        slopes[..., [seeds.columns[every[j]] for j in free]] = moved
        return states, slopes

    def predicted(
        self,
        at: Mapping[str, Array],
        states: Array,
        slopes: Array | None = None,
        seeds: Seeds | None = None,
    ) -> list[Predicted]:
        """What the model says of each observable, for states (K, M) and their derivatives.

        Without seeds there are no derivatives.
        """
        names = {name: x[:, None] for name, x in at.items()}
        names |= {name: np.array([[x]]) for name, x in self.fixed.items()}
        operands: dict[str, Operand] = dict(names)
        if seeds is not None:
            moving = {name for name in seeds.columns if name not in self.fixed}
            operands |= {
                name: coordinate(at[name], seeds.columns[name], seeds.width) for name in moving
            }
        predictions, begin = [], 0
        for i, (formula, rows) in enumerate(
            zip(self.observations.formulas, self.rows, strict=True)
        ):
            here = self.observations.of(i)
            size = here.stop - here.start
            operands[self.solution.metadata.time] = self.observations.times[here]
            for row in rows:
                block = slice(begin, begin + size)
                begin += size
                value = states[:, block]
                operands[row] = value if slopes is None else Dual(value, slopes[:, block])
            prediction = formula(operands)
            noise = self.observations.noises[i]
            own = {**operands, self.observations.names[i]: prediction}
            predictions.append(Predicted(prediction, noise.sigma(own)))
        return predictions


def failure_of(solution: SolutionCore) -> str:
    """What to say of a solution that is no success."""
    return f"the solution itself is not a success: {solution.message}"


def failures_of(trials: Iterable[Trial]) -> list[str]:
    """What to say of the solutions that are none, a sentence each."""
    solutions = {id(trial.solution): trial.solution for trial in trials}.values()
    return [failure_of(solution) for solution in solutions if not solution.success]


def states_of(solution: SolutionCore, observations: Observations) -> tuple[tuple[str, ...], ...]:
    """For each observable the states that it and its noise depend on."""
    rows = []
    triples = zip(observations.names, observations.formulas, observations.noises, strict=True)
    for name, formula, noise in triples:
        names = [*formula.names]
        if noise.formula is not None:
            names += [each for each in noise.formula.names if each != name]
        rows.append(tuple(dict.fromkeys(each for each in names if each in solution.states)))
    return tuple(rows)


def trial_of(
    name: str,
    solution: SolutionCore,
    fixed: dict[str, float],
    observations: Observations,
    doses: tables.Doses | None = None,
    places: NDArray[np.intp] | None = None,
) -> Trial:
    """The trial of checked observations; without ``places`` they come after doses at their time."""
    rows: list[NDArray[np.intp]] = []
    data: list[NDArray[np.intp]] = []
    for i, states in enumerate(states_of(solution, observations)):
        here = np.arange(observations.size)[observations.of(i)]
        for state in states:
            rows.append(np.full(here.size, solution.states.index(state), dtype=np.intp))
            data.append(here)
    each = np.concatenate(data)
    times, response = observations.times[each], None
    if doses is not None:
        after = tables.AFTER_ALL if places is None else places[each]
        response = tables.Response(*(own[0] for own in doses.response(times[None], after)))
    model = model_of(solution, np.concatenate(rows), times, response)
    return Trial(name, solution, fixed, observations, model, doses, places)


def trials_of(pairs: Sequence[tuple[SolutionCore, Experiment]]) -> tuple[Trial, ...]:
    """The trials of experiments; a table may hold several."""
    trials: list[Trial] = []
    for solution, experiment in pairs:
        solution._evaluator  # noqa: B018 - raises if nothing was solved
        trials += _trials(solution, experiment)
    names = [trial.name for trial in trials]
    if len(set(names)) < len(names):
        trials = [
            replace(t, name=f"{t.name or 'experiment'} {i + 1}") for i, t in enumerate(trials)
        ]
    return tuple(trials)


def _trials(solution: SolutionCore, experiment: Experiment) -> Iterable[Trial]:
    if not isinstance(experiment, Experiment):
        raise OptionError(
            f"{shown(experiment)} is not an Experiment",
            term=experiment,
            remedy="give (solution, rankone.Experiment(data, ...))",
        )
    mapping = experiment.times is None and isinstance(experiment.data, Mapping)
    if tables.is_table(experiment.data) or mapping:
        yield from _trials_of_table(solution, experiment)
        return
    if experiment.doses is not None:
        raise OptionError(
            "doses are rows of a table, and the data are none",
            remedy='give a table with a column of amounts, fit(table, doses={"dose": "amt"})',
        )
    observations = observed(
        solution,
        experiment.times,  # type: ignore[arg-type]
        experiment.data,
        experiment.observe,
        DataOptions(experiment.sigma, experiment.noise, experiment.weights, experiment.missing),
    )
    held = held_parameters(solution, experiment.fixed)
    yield trial_of(experiment.name, solution, held, observations)


def _trials_of_table(solution: SolutionCore, experiment: Experiment) -> Iterable[Trial]:
    """A trial for each block of a table."""
    table, fixed, by_subject = experiment.data, experiment.fixed, None
    if experiment.doses is not None:
        columns = tables.columns_of(table)
        by_subject, table = tables.doses_in(solution, columns, experiment.doses, experiment.observe)
        fixed = by_subject.with_reference(solution, fixed)
    blocks = tables.blocks_of(solution, table, experiment.observe)
    fixed_in_blocks = fixed_by_label(solution, fixed, blocks)
    doses = None
    if by_subject is not None:
        owners = [block.labels[-1] if block.labels else "" for block in blocks]
        doses = by_subject.of_records(solution, owners)
    for k, (block, held) in enumerate(zip(blocks, fixed_in_blocks, strict=True)):
        name = ", ".join(filter(None, (experiment.name, block.name)))
        row = observed_in(solution, experiment, block)
        if by_subject is None or doses is None:
            yield trial_of(name, solution, held, row)
            continue
        by_subject.check_observables(zip(row.names, row.formulas, row.noises, strict=True))
        places = np.concatenate([block.rows[each] for each in row.names])
        yield trial_of(name, solution, held, row, doses.selected(np.array([k])), places)


def observed_in(
    solution: SolutionCore, experiment: Experiment, block: tables.Block
) -> Observations:
    """What was measured in one block of a table."""
    if block.sigma is not None and experiment.sigma is not None:
        raise OptionError("sigma is given, and the table has a column of it", remedy="give one")
    if experiment.weights is not None:
        raise OptionError("a table has no weights", remedy="give it a column `sigma`")

    def of_block(given: object) -> Any:
        """What is given for the observables of this block."""
        if not isinstance(given, Mapping):
            return given
        named = {label(solution, key): entry for key, entry in given.items()}
        return {name: entry for name, entry in named.items() if name in block.data}

    observe = experiment.observe
    if observe is not None and not isinstance(observe, Mapping):
        keys = observe if isinstance(observe, list | tuple) else [observe]
        observe = {label(solution, key): key for key in keys}
    sigma = of_block(block.sigma if experiment.sigma is None else experiment.sigma)
    options = DataOptions(sigma, of_block(experiment.noise))
    return observed(solution, block.times, block.data, of_block(observe), options)


def held_parameters(solution: SolutionCore, fixed: ParameterValues) -> dict[str, float]:
    """Parameters that an experiment fixes, inside of the box."""
    held = {}
    for name, value in by_name("fixed", fixed, tuple(solution.parameters)).items():
        position = solution.metadata.parameters.index(name) + 1
        array = solution._coordinates.checked(position, value)
        if array.ndim:
            raise OptionError(f"{quote(name)} is {value!r}, not a number", term=value)
        held[name] = float(array)
    return held


def fixed_by_label(
    solution: SolutionCore, fixed: Mapping[Any, Any], blocks: Sequence[tables.Block]
) -> list[dict[str, float]]:
    """The parameters that each block of a table fixes."""
    nested = {str(key): entry for key, entry in fixed.items() if isinstance(entry, Mapping)}
    labels = list(dict.fromkeys(name for block in blocks for name in block.labels))
    for key in nested:
        if key not in labels:
            raise OptionError(
                f"fixed: the table has no condition or subject {quote(key)}"
                f"{did_you_mean(key, labels)}",
                term=key,
                remedy=f"it has {listing(labels)}" if labels else "give it a column `condition`",
            )
    every = {key: entry for key, entry in fixed.items() if not isinstance(entry, Mapping)}
    held = []
    for block in blocks:
        names = by_name("fixed", every, tuple(solution.parameters))
        for own in block.labels:
            names |= by_name("fixed", nested.get(own, {}), tuple(solution.parameters))
        for name in block.fixed:
            if name in names:
                raise OptionError(
                    f"{quote(name)} is fixed, and the table has a column of it", term=name
                )
        held.append(held_parameters(solution, {**names, **block.fixed}))
    return held
