"""Other problems from one: constants with other numbers, parameters fixed, constants set free.

A problem keeps the arguments that it was made of; each function here returns those of another one.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import sympy as sp

from rankone.support.errors import EvaluationError, ProblemError
from rankone.support.wording import did_you_mean, listing, quote, shown
from rankone.tensors.bases.coordinates import name_of

Arguments = Mapping[str, Any]
"""The arguments of a problem by name."""
Changes = Iterable[tuple[Any, Any]]
"""Pairs of a constant or parameter, or its name, and what it becomes."""


def changes_of(mapping: object, named: Mapping[str, Any]) -> Changes:
    """Changes that were given as a mapping and by keyword."""
    if mapping is not None and not isinstance(mapping, Mapping):
        raise ProblemError(
            f"{shown(mapping)} is not a mapping",
            term=mapping,
            remedy="give {symbol: ...}, or names as keywords, for example m=2.5",
        )
    return [*(mapping or {}).items(), *named.items()]


def with_constants(written: Arguments, numbers: Changes, states: Iterable[str]) -> Arguments:
    """The arguments with these numbers of constants and parameters; ``states`` are for messages."""
    parameters, constants = dict(written["parameters"]), dict(written["constants"] or {})
    correlated = {*map(name_of, itertools.chain(*(written["correlation"] or {})))}
    for symbol, value in changed_symbols(written, numbers, states):
        if symbol in parameters and symbol.name in correlated:
            raise ProblemError(
                f"{quote(symbol)} is correlated with another parameter: fixed, it changes the "
                "distribution of that one",
                term=symbol,
                remedy="build a problem without the correlation",
            )
        parameters.pop(symbol, None)
        constants[symbol] = value
    return {**written, "parameters": parameters, "constants": constants}


def with_parameters(written: Arguments, intervals: Changes, states: Iterable[str]) -> Arguments:
    """The arguments with these intervals of constants and parameters."""
    parameters, constants = dict(written["parameters"]), dict(written["constants"] or {})
    for symbol, interval in changed_symbols(written, intervals, states):
        constants.pop(symbol, None)
        parameters[symbol] = interval
    return {**written, "parameters": parameters, "constants": constants}


def changed_symbols(
    written: Arguments, changes: Changes, states: Iterable[str]
) -> Iterator[tuple[sp.Symbol, Any]]:
    """The changes by symbol; an error if the problem lacks a name, or one comes twice."""
    symbols = (*written["parameters"], *(written["constants"] or {}))
    declared = {symbol.name: symbol for symbol in symbols}
    elsewhere = dict.fromkeys(_defined(written), ("definition", "change what it is made of"))
    elsewhere |= dict.fromkeys(states, ("state", "give another value in `initial`"))
    changed: set[str] = set()
    for key, change in changes:
        try:
            name = name_of(key)
        except EvaluationError as error:
            raise ProblemError(error.message, term=key, remedy=error.remedy) from None
        if name in elsewhere:
            noun, remedy = elsewhere[name]
            message = f"{quote(name)} is a {noun}, neither a constant nor a parameter"
            raise ProblemError(message, term=key, remedy=remedy)
        if name not in declared:
            raise ProblemError(
                f"there is no constant or parameter {quote(name)}{did_you_mean(name, declared)}",
                term=key,
                remedy=f"choose from {listing(declared)}" if declared else None,
            )
        if name in changed:
            raise ProblemError(f"{quote(name)} is given twice", term=key, remedy="give it once")
        changed.add(name)
        yield declared[name], change


def _defined(written: Arguments) -> Iterator[str]:
    return map(name_of, written["definitions"] or {})
