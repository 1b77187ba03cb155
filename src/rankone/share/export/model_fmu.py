"""The solved model as an FMU for co-simulation, with the files that describe it."""

from __future__ import annotations

import hashlib
import io
import os
import platform
import re
import shlex
import shutil
import stat
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir
from typing import Literal, get_args
from uuid import UUID
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

from rankone.share.export.model_c import c_identifier, c_model, needs_math
from rankone.share.export.packing import PackedModel
from rankone.share.export.standalone import TERMS, filled
from rankone.support import __version__
from rankone.support.errors import ExportError, OptionError, shown, warn
from rankone.support.files import Content

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


# -----------------------------------------------------------------------------
# The solved model as an FMU for co-simulation: the model in C99 behind the functions of FMI.
#
# FMI is the Functional Mock-up Interface, https://fmi-standard.org. An FMU is a zip archive of a
# description, the sources and a shared library for each platform. Nothing is integrated inside: a
# step evaluates the solution at its end.


_FILE_MODE = stat.S_IFREG | 0o644  # Permissions of a file in the archive: everybody reads it
_LIBRARY_MODE = stat.S_IFREG | 0o755  # Permissions of the shared library: everybody runs it
_LONGEST_IDENTIFIER = 100  # Characters that begin names of files inside: file systems allow 255
_LONGEST_MESSAGE = 400  # Bytes of the longest message in the C sources, without a name
_SYSTEMS = {"linux": ("linux", ".so"), "darwin": ("darwin", ".dylib"), "win32": ("win", ".dll")}
_PROCESSORS = {
    "x86_64": ("x86_64", 64),
    "amd64": ("x86_64", 64),
    "aarch64": ("aarch64", 64),
    "arm64": ("aarch64", 64),
    "i386": ("x86", 32),
    "i686": ("x86", 32),
    "x86": ("x86", 32),
}
_FLAGS = ("-std=c99", "-O2", "-shared", "-fvisibility=hidden")
_COMPILER_SECONDS = 600  # Seconds for a compiler: large models take minutes


def checked_fmi(fmi: FMI | None, suffix: str) -> FMI:
    """The version of FMI, 2.0 by default, or an OptionError; 2 and 3 count as 2.0 and 3.0."""
    if fmi is None:
        return "2.0"
    if suffix != ".fmu":
        raise OptionError(
            f"fmi={shown(fmi)} does not apply to a `{suffix}` file",
            remedy="export to a file that ends in .fmu",
        )
    for version in get_args(FMI):
        if shown(fmi).strip("'") in (version, version.removesuffix(".0")):
            return version  # type: ignore[no-any-return]
    raise OptionError(f"fmi={shown(fmi)} is unknown", remedy="use fmi='2.0' or fmi='3.0'")


def fmu_model(
    model: PackedModel, path: Path, *, fmi: FMI = "2.0", name: str = "", timeless: bool = False
) -> dict[Path, Content]:
    """The archive of a model, by the path of the file.

    The model has the ``name`` of the problem, or else the stem of the file; the stem names what is
    inside. ``timeless`` says that the outputs are the same at all times. Without a compiler the FMU
    has the sources alone, with a RankoneWarning.
    """
    identifier = c_identifier(path.stem)[:_LONGEST_IDENTIFIER]
    files_in_c = c_model(model, Path(f"{identifier}_model.c"))
    evaluation = {file.name: text for file, text in files_in_c.items() if isinstance(text, str)}
    names = f"fmi{fmi[0]}.c", f"{identifier}_model.c"
    about = Description(model, fmi, name or path.stem, identifier, names, timeless)
    token = _fingerprint(model_description(about, ""), _wrapper(about, ""), evaluation)
    sources = _wrapper(about, token) | evaluation
    files = {"modelDescription.xml": model_description(about, token)}
    files |= {f"sources/{name}": text.encode() for name, text in sources.items()}
    if fmi == "3.0":
        files["sources/buildDescription.xml"] = build_description(about)
    return {path: _archive(files | _binary(about, sources))}


def _wrapper(about: Description, token: str) -> dict[str, str]:
    """The functions of FMI in C99: the text of each file by its name."""
    parameters = about.model.coordinates[1:]
    longest = max((len(name.encode()) for name in parameters), default=0)
    prefix = f"{about.identifier}_model"
    fields = {
        "model": prefix,
        "prefix": prefix,
        "PREFIX": prefix.upper(),
        "version": __version__,
        "terms": TERMS,
        "token": token,
        "room": str(max(len(parameters), 1)),
        "timeless": str(int(about.timeless)),
        "start": ", ".join(map(repr, start_values(about.model))) or "0.0",
        "text": str(_LONGEST_MESSAGE + longest),
        "ends": "1" if about.ends else "",
        "several": "" if about.model.choice is None else "yes",
    }
    name = f"fmi{about.fmi[0]}"
    templates = {
        f"{name}.c": f"{name}.c.in",
        f"{name}_interface.h": f"{name}.h.in",
        "fmu_core.h": "fmu_core.h.in",
    }
    if about.fmi == "3.0":
        templates["fmi3_absent.h"] = "fmi3_absent.h.in"
    return {file: filled(template, fields) for file, template in templates.items()}


def _fingerprint(description: bytes, *sources: dict[str, str]) -> str:
    """The token by which an importer sees that description and binary belong together."""
    digest = hashlib.sha256(description)
    for files in sources:
        for text in files.values():
            digest.update(text.encode())
    return f"{{{UUID(bytes=digest.digest()[:16])}}}"


def _binary(about: Description, sources: dict[str, str]) -> dict[str, bytes]:
    """The shared library by its place in the archive; nothing, with a warning, if there is none."""
    try:
        folders, suffix = this_platform()
        name = about.identifier + suffix
        library = compiled_library(sources, about.sources, name, needs_math(about.model))
    except CannotCompile as reason:
        warn(
            f"the FMU has no binary, its sources alone: {reason}; it runs in tools that compile "
            "sources themselves"
        )
        return {}
    return {f"binaries/{folders[about.fmi]}/{name}": library}


def _archive(files: dict[str, bytes]) -> bytes:
    """A zip archive; the same files give the same bytes."""
    stream = io.BytesIO()
    with ZipFile(stream, "w", ZIP_DEFLATED) as archive:
        for name, content in files.items():
            entry = ZipInfo(name)  # of a fixed date: bytes are reproducible
            entry.create_system = 3  # Unix, whose permissions follow
            mode = _LIBRARY_MODE if name.startswith("binaries/") else _FILE_MODE
            entry.external_attr = mode << 16
            archive.writestr(entry, content, ZIP_DEFLATED)
    return stream.getvalue()


class CannotCompile(Exception):
    """The reason why there is no library."""


def this_platform() -> tuple[dict[FMI, str], str]:
    """The folder among ``binaries`` by version of FMI, and the suffix; or CannotCompile."""
    machine = platform.machine().lower()
    if sys.platform not in _SYSTEMS or machine not in _PROCESSORS:
        raise CannotCompile(f"the platform {sys.platform} on {machine} is not known")
    system, suffix = _SYSTEMS[sys.platform]
    processor, bits = _PROCESSORS[machine]
    name = "windows" if system == "win" else system
    return {"2.0": f"{system}{bits}", "3.0": f"{processor}-{name}"}, suffix


def compiled_library(
    files: Mapping[str, str], sources: Sequence[str], name: str, needs_math: bool = False
) -> bytes:
    """Compile C sources to a shared library: ``files`` are texts by name, ``sources`` are compiled.

    With ``needs_math`` it is linked with the library of mathematical functions.
    CannotCompile says that there is no compiler, or that it fails; an ExportError, that there is no
    room for the files.
    """
    command = [*_compiler(), *_FLAGS]
    if sys.platform != "win32":
        command.append("-fPIC")
    try:
        with TemporaryDirectory() as folder:
            for file, text in files.items():
                (Path(folder) / file).write_text(text, encoding="utf-8")
            last = ["-lm"] if needs_math and sys.platform != "win32" else []
            return _run_compiler([*command, *sources, "-o", name, *last], Path(folder) / name)
    except OSError as error:  # such as a full disk
        where = error.filename or gettempdir()
        raise ExportError(
            f"the FMU cannot be compiled: `{where}`: {error.strerror or error}",
            term=where,
            remedy="make room there, or let the variable TMPDIR name another folder",
        ) from error


def _run_compiler(command: Sequence[str], library: Path) -> bytes:
    """The library that a command makes in its folder, or CannotCompile."""
    try:
        run = subprocess.run(
            command,
            cwd=library.parent,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=_COMPILER_SECONDS,
            check=False,
        )
    except (OSError, subprocess.SubprocessError) as error:
        raise CannotCompile(f"the compiler {command[0]} fails: {error}") from error
    if run.returncode or not library.exists():
        reason = next(iter(run.stderr.strip().splitlines()), "it says nothing")
        raise CannotCompile(f"the compiler {command[0]} fails: {reason}")
    return library.read_bytes()


def _compiler() -> list[str]:
    """The compiler that the variable CC names, or else the first one on the path."""
    asked = shlex.split(os.environ.get("CC", ""))
    for command in (asked, ["cc"], ["gcc"], ["clang"]):
        if command and shutil.which(command[0]):
            return command
        if command and command is asked:
            raise CannotCompile(f"the compiler {command[0]} that CC names is not found")
    raise CannotCompile("there is no C compiler: neither cc nor gcc nor clang is found")
