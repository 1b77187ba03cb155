"""The shared library of an FMU, compiled for the platform at hand."""

from __future__ import annotations

import os
import platform
import shlex
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir

from rankone.support.errors import ExportError

__all__ = ["CannotCompile", "Platform", "compiled_library", "this_platform"]

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
_LONGEST = 600
"""Seconds for a compiler."""


class CannotCompile(Exception):
    """Why there is no library."""


@dataclass(frozen=True)
class Platform:
    """Where a library runs.

    Attributes
    ----------
    folders : dict
        For each version of FMI the folder among ``binaries``.
    suffix : str
        Of the library.
    """

    folders: Mapping[str, str]
    suffix: str


def this_platform() -> Platform:
    """The platform at hand.

    Raises
    ------
    CannotCompile
        If FMI has no name for it.
    """
    machine = platform.machine().lower()
    if sys.platform not in _SYSTEMS or machine not in _PROCESSORS:
        raise CannotCompile(f"the platform {sys.platform} on {machine} is not known")
    system, suffix = _SYSTEMS[sys.platform]
    processor, bits = _PROCESSORS[machine]
    long = "windows" if system == "win" else system
    return Platform({"2.0": f"{system}{bits}", "3.0": f"{processor}-{long}"}, suffix)


def compiled_library(files: Mapping[str, str], sources: Sequence[str], name: str) -> bytes:
    """Compile C sources to a shared library.

    Parameters
    ----------
    files : mapping of str to str
        Text of all files by name.
    sources : sequence of str
        Which of them are compiled.
    name : str
        Of the library.

    Raises
    ------
    CannotCompile
        If there is no compiler, or it fails.
    ExportError
        If there is no room for the files.
    """
    command = [*_compiler(), *_FLAGS]
    if sys.platform != "win32":
        command.append("-fPIC")
    try:
        with TemporaryDirectory() as folder:
            return _compiled(command, files, sources, Path(folder) / name)
    except OSError as error:  # such as a full disk
        where = error.filename or gettempdir()
        raise ExportError(
            f"the FMU cannot be compiled: `{where}`: {error.strerror or error}",
            term=where,
            remedy="make room there, or let the variable TMPDIR name another folder",
        ) from error


def _compiled(
    command: Sequence[str], files: Mapping[str, str], sources: Sequence[str], library: Path
) -> bytes:
    """The library, compiled in its folder."""
    folder = library.parent
    for file, text in files.items():
        (folder / file).write_text(text, encoding="utf-8")
    try:
        run = subprocess.run(
            [*command, *sources, "-o", library.name],
            cwd=folder,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=_LONGEST,
            check=False,
        )
    except (OSError, subprocess.SubprocessError) as error:
        raise CannotCompile(f"the compiler {command[0]} fails: {error}") from error
    if run.returncode or not library.exists():
        said = next(iter(run.stderr.strip().splitlines()), "it says nothing")
        raise CannotCompile(f"the compiler {command[0]} fails: {said}")
    return library.read_bytes()


def _compiler() -> list[str]:
    """What the variable CC names, or else a compiler that is found."""
    asked = shlex.split(os.environ.get("CC", ""))
    for command in (asked, ["cc"], ["gcc"], ["clang"]):
        if command and shutil.which(command[0]):
            return command
        if command and command is asked:
            raise CannotCompile(f"the compiler {command[0]} that CC names is not found")
    raise CannotCompile("there is no C compiler: neither cc nor gcc nor clang is found")
