"""Files of a PEtab problem, read and checked by the package ``petab``.

PEtab: Schmiester et al., PEtab - Interoperable specification of parameter estimation problems in
systems biology, PLOS Computational Biology 17 (2021) e1008646; version 1 of the format.
"""

from __future__ import annotations

import logging
import math
import warnings
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rankone.inference.calibration import records
from rankone.inference.estimation.formulas import Formula, formula_of
from rankone.problem.models.model import Model
from rankone.problem.models.sbml import read_with_starts
from rankone.support.errors import (
    LISTED,
    OptionError,
    ProblemError,
    count,
    did_you_mean,
    listing,
    optional_module,
    quote,
)
from rankone.support.files import as_path

if TYPE_CHECKING:
    import pandas as pd

_PRIORS = {
    "uniform": ("uniform", "lin"),
    "normal": ("normal", "lin"),
    "laplace": ("laplace", "lin"),
    "logNormal": ("normal", "log"),
    "logLaplace": ("laplace", "log"),
    "parameterScaleUniform": ("uniform", None),
    "parameterScaleNormal": ("normal", None),
    "parameterScaleLaplace": ("laplace", None),
}
"""For each type of prior its shape, and the coordinate; None is the scale of the parameter."""
_DISTRIBUTIONS = ("normal", "laplace")
_LOADERS = "petab"  # Logger of the package


def petab_library() -> Any:
    """Version 1 of the package ``petab``; a ProblemError says how to install it."""
    return optional_module(
        "petab.v1",
        "reading PEtab problems needs petab",
        'pip install petab, or pip install ".[petab]" in the folder of the source',
        ProblemError,
    )


def open_petab(path: str | PathLike[str]) -> Any:
    """The problem of ``petab`` that a YAML file names, checked by its linter."""
    file = as_path(path, ProblemError)
    if not file.is_file():
        raise ProblemError(f"there is no file `{file}`", term=file)
    petab = petab_library()
    _check_format(file)
    with _messages() as messages:
        try:
            problem = petab.Problem.from_yaml(str(file))
        except Exception as error:  # whatever the package or pandas raises on a broken file
            raise _broken(file, "readable", str(error)) from None
        problem.visualization_df = None
        try:
            faulty = petab.lint_problem(problem)
        except Exception as error:  # the linter stops at what it does not expect
            raise _broken(file, "valid", str(error)) from None
    if faulty:
        faults = [text for text in messages if text != "Not OK"][:LISTED]
        raise _broken(file, "valid", "; ".join(faults) or "the model is not valid SBML")
    for name in ("measurement_df", "condition_df", "observable_df", "parameter_df", "model"):
        if getattr(problem, name) is None:
            raise ProblemError(f"`{file}` names no {name.removesuffix('_df')} table", term=file)
    if problem.mapping_df is not None and len(problem.mapping_df):
        first = str(problem.mapping_df.index[0])
        raise ProblemError(
            f"the mapping table of `{file}`, which has {quote(first)}, is not supported",
            term=first,
            remedy="use the names of the model in all tables, and leave the mapping table out",
        )
    return problem


def _content(file: Path) -> Any:
    """What a YAML file has."""
    yaml = optional_module("yaml", "reading PEtab problems needs PyYAML", "pip install pyyaml")
    try:
        return yaml.safe_load(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise _broken(file, "readable", str(error)) from None


def _check_format(file: Path) -> None:
    """Raise unless a file is of version 1 and names one problem with one model."""
    content = _content(file)
    if not isinstance(content, dict) or "format_version" not in content:
        raise ProblemError(
            f"`{file}` has no `format_version`",
            term=file,
            remedy="give the YAML file of a PEtab problem",
        )
    version = str(content["format_version"])
    if version.partition(".")[0] != "1":
        raise ProblemError(
            f"`{file}` is of version {version} of PEtab, and version 1 is read",
            term=file,
            remedy="write it in version 1",
        )
    problems = content.get("problems") or []
    if len(problems) != 1 or len(problems[0].get("sbml_files") or []) != 1:
        raise ProblemError(
            f"`{file}` has several problems or models, or none",
            term=file,
            remedy="give one file for each, with one model in SBML",
        )


def _broken(file: Path, what: str, fault: str) -> ProblemError:
    return ProblemError(
        f"`{file}` is not a {what} PEtab problem: {' '.join(fault.split())}",
        term=file,
        remedy="`petablint` lists all faults",
    )


@contextmanager
def _messages() -> Iterator[list[str]]:
    """Errors that the package logs, which are not shown, nor its warnings."""
    messages: list[str] = []

    class Keeper(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            if record.levelno >= logging.ERROR:
                messages.append(record.getMessage())

    logger, keeper = logging.getLogger(_LOADERS), Keeper()
    before = logger.propagate, logger.handlers[:]
    inner = [
        logging.getLogger(n) for n in logging.root.manager.loggerDict if n.startswith(_LOADERS)
    ]
    kept = [(each, each.propagate, each.handlers[:]) for each in inner]
    for each in inner:
        each.propagate, each.handlers = each is not logger, []
    logger.propagate, logger.handlers = False, [keeper]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield messages
    finally:
        for each, propagate, handlers in kept:
            each.propagate, each.handlers = propagate, handlers
        logger.propagate, logger.handlers = before


def records_of(problem: Any, path: str | PathLike[str]) -> records.Records:
    """The records of a problem of ``petab``."""
    if not len(problem.measurement_df):
        raise ProblemError("the measurement table has no rows", remedy="there is nothing to fit")
    parameters = tuple(_parameters(problem.parameter_df))
    conditions = _conditions(problem.condition_df)
    ids = {*problem.parameter_df.index, *(i for c in conditions.values() for i in c.assigned)}
    model, starts = read_with_starts(_model_file(path), sorted(ids))
    _check_model(model, starts, [*problem.parameter_df.index], conditions.values())
    experiments = _experiments(problem.measurement_df, conditions)
    _check_sizes(problem.model.sbml_model, experiments.values())
    observables = {
        name: _observable(str(name), row, model) for name, row in problem.observable_df.iterrows()
    }
    series = tuple(_series(problem.measurement_df, observables, [*experiments]))
    _check_names(model, {parameter.name for parameter in parameters}, series)
    return records.Records(
        name=Path(path).stem,
        model=model,
        starts=starts,
        parameters=parameters,
        experiments=tuple(experiments.values()),
        series=series,
    )


def _check_model(
    model: Model,
    starts: Mapping[str, str],
    parameters: Sequence[str],
    conditions: Collection[records.Condition],
) -> None:
    """Raise a ProblemError if the model has events, or determines what tables set."""
    if model.happenings:
        names = listing([each.name for each in model.happenings])
        raise ProblemError(
            f"the model has {count(len(model.happenings), 'event')}, {names}, which calibration "
            "problems may not have yet",
            term=model.happenings[0].name,
            remedy="write what happens at times that are known as `piecewise` of the time",
        )
    for column in dict.fromkeys(i for c in conditions for i in c.assigned):
        if column not in starts:
            raise ProblemError(
                f"the condition table sets {quote(column)}, which is no parameter, species or "
                "compartment with a value of its own in the model",
                term=column,
                remedy="remove the column, or the rule that determines it",
            )
    definitions = {symbol.name for symbol in model.definitions}
    for name in parameters:
        if name not in starts and name in definitions:
            raise ProblemError(
                f"the parameter table has {quote(name)}, which a rule of the model determines",
                term=name,
                remedy="remove one of them",
            )


def _check_names(
    model: Model, parameters: Collection[str], series: Iterable[records.Series]
) -> None:
    """Raise a ProblemError for names in formulas or placeholders that have no value."""
    names = {*(symbol.name for symbol in model.rates), *parameters, *model.parameters, "time"}
    for each in series:
        own = each.observable
        for column, formula in (("observable", own.formula), ("noise", own.noise)):
            for name in formula.names:
                if name not in names and name not in each.placeholders:
                    raise ProblemError(
                        f"the observable table, row {quote(own.name)}, {column} formula: "
                        f"{quote(name)} has no value{did_you_mean(name, names)}",
                        term=name,
                        remedy="give it in the measurement or the parameter table",
                    )
        for name, assigned in each.placeholders.items():
            for row, entry in zip(each.rows, assigned, strict=True):
                if isinstance(entry, str) and entry not in parameters:
                    raise ProblemError(
                        f"the measurement table, row {row + 1}, gives {quote(name)} the value of "
                        f"{quote(entry)}, which is no parameter{did_you_mean(entry, parameters)}",
                        term=entry,
                    )


def _model_file(path: str | PathLike[str]) -> Path:
    """The one SBML file of a problem."""
    (name,) = _content(Path(path))["problems"][0]["sbml_files"]
    return Path(path).parent / str(name)


# -- parameters and conditions --------------------------------------------------------------------


def _is_empty(cell: object) -> bool:
    return cell is None or cell == "" or (isinstance(cell, float) and math.isnan(cell))


def _number(row: pd.Series, column: str) -> float:
    return math.nan if _is_empty(row.get(column)) else float(row[column])


def _parameters(table: pd.DataFrame) -> Iterator[records.Parameter]:
    for name, row in table.iterrows():
        scale = "lin" if _is_empty(row.get("parameterScale")) else str(row["parameterScale"])
        if scale not in records.SCALES:
            raise ProblemError(
                f"the parameter table gives {quote(name)} the scale {quote(scale)}", term=name
            )
        estimated = bool(int(row["estimate"]))
        bounds = _number(row, "lowerBound"), _number(row, "upperBound")
        nominal = _number(row, "nominalValue")
        prior = _prior(str(name), row, scale) if estimated else None
        yield records.Parameter(str(name), scale, *bounds, nominal, estimated, prior)


def _prior(name: str, row: pd.Series, scale: str) -> records.Prior | None:
    """What the objective adds for a parameter; nothing unless a prior of the objective is named."""
    kind = row.get("objectivePriorType")
    if _is_empty(kind):
        return None
    if kind not in _PRIORS:
        raise ProblemError(
            f"the parameter table gives {quote(name)} the prior {quote(kind)}",
            term=name,
            remedy=f"choose from {listing(_PRIORS)}",
        )
    numbers = row.get("objectivePriorParameters")
    if _is_empty(numbers) and kind == "parameterScaleUniform":
        return None
    shape, coordinate = _PRIORS[kind]
    first, second = _prior_numbers(name, shape, str(numbers))
    return records.Prior(shape, coordinate or scale, first, second, of_value=coordinate is not None)


def _prior_numbers(name: str, shape: str, text: str) -> tuple[float, float]:
    """Ends in order, or a location and a positive width."""
    try:
        first, second = map(float, text.split(";"))
    except ValueError:
        first = second = math.nan
    usable = first < second if shape == "uniform" else second > 0.0
    if not (usable and math.isfinite(first) and math.isfinite(second)):
        what = "a lower and a higher end" if shape == "uniform" else "a location and a width > 0"
        raise ProblemError(
            f"the parameter table gives the prior of {quote(name)} the parameters {quote(text)}",
            term=name,
            remedy=f"give {what}, as `1;2`",
        )
    return first, second


def _assigned(cell: float | str) -> records.Assigned:
    """A number, or the name of a parameter."""
    try:
        return float(cell)
    except ValueError:
        return str(cell).strip()


def _conditions(table: pd.DataFrame) -> dict[str, records.Condition]:
    columns = [column for column in table.columns if column != "conditionName"]
    return {
        str(name): records.Condition(
            str(name), {c: None if _is_empty(row[c]) else _assigned(row[c]) for c in columns}
        )
        for name, row in table.iterrows()
    }


def _experiment_keys(table: pd.DataFrame) -> list[tuple[str, str]]:
    """The conditions of each measurement, before and during it; the first may be empty."""
    before = ["" if _is_empty(row.get("preequilibrationConditionId")) else
              str(row["preequilibrationConditionId"]) for _, row in table.iterrows()]  # fmt: skip
    return [*zip(before, map(str, table["simulationConditionId"]), strict=True)]


def _experiments(
    table: pd.DataFrame, conditions: dict[str, records.Condition]
) -> dict[tuple[str, str], records.SimulatedExperiment]:
    return {
        key: records.SimulatedExperiment(conditions[key[1]], conditions[key[0]] if key[0] else None)
        for key in dict.fromkeys(_experiment_keys(table))
    }


def _check_sizes(model: Any, experiments: Iterable[records.SimulatedExperiment]) -> None:
    """Raise where a compartment changes after a steady state: what becomes of its contents?"""
    for compartment in model.getListOfCompartments():
        name = compartment.getId()
        for each in experiments:
            if each.before is not None and each.before.assigned.get(
                name
            ) != each.condition.assigned.get(name):
                raise ProblemError(
                    f"the condition table gives compartment {quote(name)} other sizes in "
                    f"{quote(each.before.name)} and {quote(each.condition.name)}, which follows it",
                    term=name,
                    remedy="give it one size",
                )


# -- observables and measurements -----------------------------------------------------------------


def _observable(name: str, row: pd.Series, model: Model) -> records.Observable:
    distribution = "normal" if _is_empty(row.get("noiseDistribution")) else row["noiseDistribution"]
    cell = row.get("observableTransformation")
    transformation = "lin" if _is_empty(cell) else str(cell)
    if distribution not in _DISTRIBUTIONS or transformation not in records.SCALES:
        raise ProblemError(
            f"the observable table, row {quote(name)}: noise {quote(distribution)} on the scale "
            f"{quote(transformation)} is not supported",
            term=name,
            remedy=f"noise is {listing(_DISTRIBUTIONS)}, scales are {listing(records.SCALES)}",
        )
    formula, noise = (_formula(name, row[f"{c}Formula"], c, model) for c in ("observable", "noise"))
    return records.Observable(name, formula, noise, transformation, str(distribution))


def _formula(name: str, text: object, column: str, model: Model) -> Formula:
    """A formula in states, numbers of the model, parameters and time."""
    sympify = optional_module("petab.v1.math", "formulas of PEtab need petab", "").sympify_petab
    expression = model.in_states(sympify(text))
    try:
        return formula_of(expression)
    except OptionError as error:
        raise ProblemError(
            f"the observable table, row {quote(name)}, {column} formula: {error.message}",
            term=name,
            remedy=error.remedy,
        ) from None


def _series(
    table: pd.DataFrame,
    observables: dict[str, records.Observable],
    experiments: Sequence[tuple[str, str]],
) -> Iterator[records.Series]:
    """The measurements of each observable that has some."""
    keys = _experiment_keys(table)
    for name, observable in observables.items():
        rows = [k for k, other in enumerate(table["observableId"]) if other == name]
        if not rows:
            continue
        some = table.iloc[rows]
        _check_measurements(rows, some)
        yield records.Series(
            observable,
            rows,
            np.array([experiments.index(keys[k]) for k in rows]),
            np.array(some["time"], dtype=float),
            np.array(some["measurement"], dtype=float),
            _placeholders(name, some),
        )


def _check_measurements(rows: Sequence[int], some: pd.DataFrame) -> None:
    """Raise a ProblemError if a time or a measurement is not a number that may be."""
    for row, at, measured in zip(rows, some["time"], some["measurement"], strict=True):
        if not float(at) >= 0.0:
            raise ProblemError(
                f"the measurement table, row {row + 1}: the time {at} is not from 0 on", term=at
            )
        if not math.isfinite(float(measured)):
            raise ProblemError(
                f"the measurement table, row {row + 1}: the measurement is {measured}",
                term=measured,
                remedy="leave the row out",
            )


def _placeholders(name: str, some: pd.DataFrame) -> dict[str, list[records.Assigned]]:
    """What rows put in the place of ``observableParameter1_name`` and the like, a value each."""
    placeholders: dict[str, list[records.Assigned]] = {}
    for word in ("observable", "noise"):
        for _, row in some.iterrows():
            cell = row.get(f"{word}Parameters")
            texts = [] if _is_empty(cell) else str(cell).split(";")
            for i, text in enumerate(texts, 1):
                column = placeholders.setdefault(f"{word}Parameter{i}_{name}", [])
                column.append(_assigned(text))
    for placeholder, column in placeholders.items():
        if len(column) != len(some):
            raise ProblemError(
                f"the measurement table gives {quote(placeholder)} in {len(column)} of "
                f"{len(some)} rows",
                term=placeholder,
            )
    return placeholders
