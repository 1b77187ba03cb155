"""Units of an SBML model as texts."""

from __future__ import annotations

from typing import Any

from rankone.models.document import sbml_library
from rankone.models.mathml import members

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


def units_of(model: Any, time: str) -> dict[str, str]:
    """Units of quantities by id, and of time by its name, as far as the model gives them."""
    quantities = [
        *members(model.getListOfSpecies()),
        *members(model.getListOfParameters()),
        *members(model.getListOfCompartments()),
    ]
    pairs = [(each.getId(), unit_text(each.getDerivedUnitDefinition())) for each in quantities]
    pairs.append((time, _named(model, model.getTimeUnits())))
    return {name: text for name, text in pairs if text}


def _named(model: Any, name: str) -> str:
    """The unit of a name: one of the model's definitions, or a unit itself."""
    definition = model.getUnitDefinition(name) if name else None
    return unit_text(definition) if definition is not None else _SYMBOLS.get(name, name)


def unit_text(definition: Any) -> str:
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


def _unit_symbol(unit: Any) -> str:
    """The symbol of a unit with its prefix: ``µmol``, or ``(60 s)`` where none fits."""
    name: str = sbml_library().UnitKind_toString(unit.getKind())
    symbol = _SYMBOLS.get(name, name)
    factor, scale = unit.getMultiplier(), unit.getScale()
    if symbol == "1":
        return "1"
    if factor == 1.0 and scale in _PREFIXES:
        return _PREFIXES[scale] + symbol
    return f"({factor * 10.0**scale:g} {symbol})"
