"""The solved model as an FMU for co-simulation: the model in C99 behind the functions of FMI.

FMI is the Functional Mock-up Interface, https://fmi-standard.org. An FMU is a zip archive of a
description, the sources and a shared library for each platform. Nothing is integrated inside: a
step evaluates the solution at its end.
"""

from __future__ import annotations

import hashlib
import io
import os
import platform
import shlex
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir
from typing import get_args
from uuid import UUID
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

from rankone.export.c_names import c_identifier
from rankone.export.fmu_description import (
    FMI,
    Description,
    build_description,
    model_description,
    start_values,
)
from rankone.export.model_c import c_model
from rankone.export.model_c_events import needs_math
from rankone.export.packed import PackedModel
from rankone.export.templates import TERMS, filled
from rankone.support import __version__
from rankone.support.errors import ExportError, OptionError, warn
from rankone.support.files import Content
from rankone.support.wording import shown

_FILE_DATE = (1980, 1, 1, 0, 0, 0)  # Of all files, the first of zip: bytes are reproducible
_FILE_MODE = 0o100644  # Permissions of a file in the archive: everybody reads it
_LIBRARY_MODE = 0o100755  # Permissions of the shared library: everybody runs it
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
            entry = ZipInfo(name, _FILE_DATE)
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
