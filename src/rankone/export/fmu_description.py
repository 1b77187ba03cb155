"""The files that describe an FMU: ``modelDescription.xml`` and ``buildDescription.xml``."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from rankone.export.packed import PackedModel
from rankone.support import __version__

FMI = Literal["2.0", "3.0"]  # Versions of the Functional Mock-up Interface

_NOT_IN_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
_CATEGORIES = {
    "logStatusDiscard": "Values and steps beyond what was solved",
    "logStatusError": "Calls that are refused, and why",
}
# What the C sources are capable of, as attributes
_CAPABILITIES: dict[FMI, tuple[str, ...]] = {
    "2.0": (
        "canHandleVariableCommunicationStepSize",
        "canNotUseMemoryManagementFunctions",
        "canGetAndSetFMUstate",
        "canSerializeFMUstate",
        "providesDirectionalDerivative",
    ),
    "3.0": (
        "canHandleVariableCommunicationStepSize",
        "canGetAndSetFMUState",
        "canSerializeFMUState",
        "providesDirectionalDerivatives",
    ),
}


@dataclass(frozen=True)
class Description:
    """A model as the two files describe it.

    ``identifier`` names the binary and begins the names of functions, ``sources`` are the files
    that are compiled, and the outputs of a ``timeless`` model are the same at all times.
    """

    model: PackedModel
    fmi: FMI
    name: str
    identifier: str
    sources: tuple[str, ...]
    timeless: bool = False

    @property
    def names(self) -> list[str]:
        """Names of time, the parameters and the outputs, each in a form that FMI allows."""
        return _distinct((*self.model.coordinates, *self.model.unknowns))

    @property
    def ends(self) -> bool:
        """Whether an event may end the solution."""
        return self.model.terminal

    def unit(self, reference: int) -> str:
        """Unit of a variable, empty if there is none."""
        name = (*self.model.coordinates, *self.model.unknowns)[reference]
        return _line(dict(self.model.units).get(name, "")).strip()


def start_values(model: PackedModel) -> list[float]:
    """The centre of the box."""
    return [lower + 0.5 * (upper - lower) for lower, upper in model.intervals[1:]]


def model_description(about: Description, token: str) -> bytes:
    """``modelDescription.xml``: value reference 0 is time, then parameters, then outputs.

    ``token`` is the ``guid`` of FMI 2.0 and the ``instantiationToken`` of FMI 3.0.
    """
    root = Element(
        "fmiModelDescription",
        {
            "fmiVersion": about.fmi,
            "modelName": _text(about.name),
            "instantiationToken" if about.fmi == "3.0" else "guid": token,
            "description": _text("\n".join(about.model.summary)),
            "generationTool": f"rankone {__version__}",
            "variableNamingConvention": "flat",
        },
    )
    flags = dict.fromkeys(_CAPABILITIES[about.fmi], "true")
    if about.fmi == "3.0" and about.ends:
        flags["mightReturnEarlyFromDoStep"] = "true"
    interface = SubElement(root, "CoSimulation", {"modelIdentifier": about.identifier, **flags})
    if about.fmi == "2.0":
        files = SubElement(interface, "SourceFiles")
        for name in about.sources:
            SubElement(files, "File", name=name)
    names = dict.fromkeys(filter(None, map(about.unit, range(len(about.names)))))
    units = SubElement(root, "UnitDefinitions") if names else root
    for unit in names:
        SubElement(units, "Unit", name=unit)
    categories = SubElement(root, "LogCategories")
    for name, description in _CATEGORIES.items():
        SubElement(categories, "Category", name=name, description=description)
    if not about.timeless:
        start, stop = about.model.intervals[0]
        SubElement(root, "DefaultExperiment", startTime=repr(start), stopTime=repr(stop))
    variables = SubElement(root, "ModelVariables")
    for reference in range(len(about.names)):
        _add_variable(variables, about, reference)
    _add_structure(root, about)
    return _xml(root)


def build_description(about: Description) -> bytes:
    """``sources/buildDescription.xml`` of FMI 3.0."""
    root = Element("fmiBuildDescription", fmiVersion=about.fmi)
    build = SubElement(root, "BuildConfiguration", modelIdentifier=about.identifier)
    files = SubElement(build, "SourceFileSet", language="C99")
    for name in about.sources:
        SubElement(files, "SourceFile", name=name)
    return _xml(root)


def _add_variable(parent: Element, about: Description, reference: int) -> None:
    """Time, a parameter or an output, by its value reference."""
    parameters = len(about.model.intervals) - 1
    variable = {"name": about.names[reference], "valueReference": str(reference)}
    real = {"unit": about.unit(reference)} if about.unit(reference) else {}
    if reference == 0:
        variable |= {"causality": "independent", "variability": "continuous"}
    elif reference <= parameters:
        lower, upper = about.model.intervals[reference]
        start = start_values(about.model)[reference - 1]
        variable |= {"causality": "parameter", "variability": "tunable", "initial": "exact"}
        real |= {"min": repr(lower), "max": repr(upper), "start": repr(start)}
    else:
        variability = "discrete" if about.timeless else "continuous"
        variable |= {"causality": "output", "variability": variability, "initial": "calculated"}
    if about.fmi == "3.0":
        SubElement(parent, "Float64", variable | real)
    else:
        SubElement(SubElement(parent, "ScalarVariable", variable), "Real", real)


def _add_structure(root: Element, about: Description) -> None:
    """Outputs and their initial values; each depends on all inputs."""
    structure = SubElement(root, "ModelStructure")
    references = range(len(about.model.intervals), len(about.names))
    if about.fmi == "3.0":
        for tag in ("Output", "InitialUnknown"):
            for reference in references:
                SubElement(structure, tag, valueReference=str(reference))
        return
    for tag in ("Outputs", "InitialUnknowns"):
        unknowns = SubElement(structure, tag)
        for reference in references:
            SubElement(unknowns, "Unknown", index=str(reference + 1))


def _text(text: str) -> str:
    """Text without characters that XML forbids."""
    return _NOT_IN_XML.sub("_", text)


def _line(text: str) -> str:
    """Text on one line, as names have to be."""
    return re.sub(r"[\t\n\r]", "_", _text(text))


def _distinct(names: Sequence[str]) -> list[str]:
    """Names that FMI allows, made distinct by underscores; valid names stay."""
    words = [_line(name) or "_" for name in names]
    kept = set(names).intersection(words)
    distinct: list[str] = []
    for name, word in zip(names, words, strict=True):
        while word in distinct or (word != name and word in kept):
            word += "_"
        distinct.append(word)
    return distinct


def _xml(root: Element) -> bytes:
    ElementTree.indent(root)
    text: bytes = ElementTree.tostring(root, encoding="UTF-8", xml_declaration=True)
    return text + b"\n"
