"""SBML and Antimony files as models, and the units they declare."""

from __future__ import annotations

from collections.abc import Collection
from os import PathLike
from typing import TYPE_CHECKING

from rankone.problem.models.assembly import Assembly
from rankone.problem.models.document import open_document, sbml_library
from rankone.problem.models.elements import elements_of, with_free_starts
from rankone.problem.models.model import Model
from rankone.problem.models.sbml_formulas import members
from rankone.support.errors import bounded_depth

if TYPE_CHECKING:
    import libsbml

_SYMBOLS = {
    "mole": "mol",
    "litre": "L",
    "liter": "L",
    "second": "s",
    "metre": "m",
    "meter": "m",
    "gram": "g",
    "kilogram": "kg",
    "kelvin": "K",
    "item": "item",
    "dimensionless": "1",
    "ampere": "A",
    "volt": "V",
    "joule": "J",
    "newton": "N",
    "pascal": "Pa",
    "hertz": "Hz",
    "watt": "W",
    "coulomb": "C",
}
_PREFIXES = {
    -15: "f",
    -12: "p",
    -9: "n",
    -6: "µ",
    -3: "m",
    -2: "c",
    -1: "d",
    0: "",
    3: "k",
    6: "M",
    9: "G",
}


def units_of(model: libsbml.Model, time: str) -> dict[str, str]:
    """Units of quantities by id, and of time by its name, as far as the model gives them."""
    quantities = [
        *members(model.getListOfSpecies()),
        *members(model.getListOfParameters()),
        *members(model.getListOfCompartments()),
    ]
    pairs = [(each.getId(), unit_text(each.getDerivedUnitDefinition())) for each in quantities]
    pairs.append((time, _named(model, model.getTimeUnits())))
    return {name: text for name, text in pairs if text}


def _named(model: libsbml.Model, name: str) -> str:
    """The unit of a name: one of the model's definitions, or a unit itself."""
    definition = model.getUnitDefinition(name) if name else None
    return unit_text(definition) if definition is not None else _SYMBOLS.get(name, name)


def unit_text(definition: libsbml.UnitDefinition) -> str:
    """A unit such as ``µmol/L``; empty if there is none, or it is a plain number."""
    if definition is None:
        return ""
    above: list[str] = []
    below: list[str] = []
    for unit in members(definition.getListOfUnits()):
        exponent = unit.getExponentAsDouble()
        symbol = _unit_symbol(unit)
        if symbol == "1" or exponent == 0.0:
            continue
        power = f"^{abs(exponent):g}" if abs(exponent) != 1.0 else ""
        (above if exponent > 0.0 else below).append(symbol + power)
    if not above and not below:
        return ""
    text = "*".join(above) or "1"
    return "/".join([text, *below])


def _unit_symbol(unit: libsbml.Unit) -> str:
    """The symbol of a unit with its prefix: ``µmol``, or ``(60 s)`` where none fits."""
    name: str = sbml_library().UnitKind_toString(unit.getKind())
    symbol = _SYMBOLS.get(name, name)
    factor, scale = unit.getMultiplier(), unit.getScale()
    if symbol == "1":
        return "1"
    if factor == 1.0 and scale in _PREFIXES:
        return _PREFIXES[scale] + symbol
    return f"({factor * 10.0**scale:g} {symbol})"


# -----------------------------------------------------------------------------
# SBML and Antimony files as models.


def read_sbml(path: str | PathLike[str]) -> Model:
    """Read a model from an SBML file, or from Antimony text.

    Compartments, species, parameters, reactions, rules, initial assignments, function definitions
    and events of Levels 1 to 3 are read, and submodels are put into one model. What is not
    supported, such as delay equations and fast reactions, is an error that names the element.

    Parameters
    ----------
    path : path
        A file that ends in ``.xml`` or ``.sbml``; or in ``.ant`` or ``.antimony``, which needs the
        package ``antimony``.

    Returns
    -------
    Model
        Its ``.problem(...)`` is a :class:`Problem`.

    Raises
    ------
    ProblemError
        If the file cannot be read, or an element is not supported.
    """
    return read_with_starts(path, ())[0]


def read_with_starts(
    path: str | PathLike[str], ids: Collection[str]
) -> tuple[Model, dict[str, str]]:
    """Read a model in which some ids start at numbers of their own, without initial assignments.

    Such a number means what the id means in formulas. Returns the model and the parameter of each
    of the ids; there is none for an id that a rule determines, or that the model does not have.
    """
    document, model = open_document(path)
    with bounded_depth():
        assembly = Assembly(with_free_starts(elements_of(model), ids))
        read = Model(
            name=model.getName() or model.getId() or None,
            time=assembly.time,
            rates=assembly.rates,
            constraints=assembly.constraints,
            initial=assembly.initial,
            definitions=assembly.definitions,
            numbers=assembly.numbers,
            happenings=assembly.happenings(),
            units=units_of(model, assembly.time.name),
            start=assembly.start,
        )
    del document  # the model lives as long as its document
    starts = assembly.start_numbers
    return read, {name: starts[name].name for name in ids if name in starts}
