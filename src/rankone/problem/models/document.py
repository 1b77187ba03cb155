"""Open an SBML or Antimony file: one flat model of Level 3, or an error that says why not."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from rankone.support.errors import ProblemError, optional_module
from rankone.support.files import as_path
from rankone.support.wording import listing, quote

if TYPE_CHECKING:
    import libsbml

SBML_SUFFIXES = (".xml", ".sbml")
ANTIMONY_SUFFIXES = (".ant", ".antimony")
_LEVEL, _VERSION = 3, 1  # Earlier levels are raised to this one
_HARMLESS = ("comp", "l3v2extendedmath", "layout", "render", "groups", "fbc", "distrib")
"""Packages that are understood, or that leave the meaning of equations as it is."""
_PARTS_READ = 3  # Errors of a file that a message quotes


def sbml_library() -> ModuleType:
    """The module ``libsbml``; a ProblemError says how to install it."""
    return optional_module(
        "libsbml",
        "reading SBML needs python-libsbml",
        'pip install python-libsbml, or pip install ".[sbml]" in the folder of the source',
        ProblemError,
    )


def is_model_file(path: Path) -> bool:
    """Whether the suffix says that a file is a model: SBML or Antimony."""
    return path.suffix in (*SBML_SUFFIXES, *ANTIMONY_SUFFIXES)


def open_document(path: object) -> tuple[libsbml.SBMLDocument, libsbml.Model]:
    """The libsbml document of a file and its model, which lives as long as the document does.

    Submodels are flattened, and Levels 1 and 2 are raised to Level 3. A ProblemError if the file
    cannot be read, or needs a package that changes the meaning of its equations.
    """
    file = as_path(path, ProblemError)
    if not is_model_file(file):
        raise ProblemError(
            f"`{file}` is neither an SBML nor an Antimony file",
            term=file,
            remedy=f"give a file that ends in {listing((*SBML_SUFFIXES, *ANTIMONY_SUFFIXES))}",
        )
    if not file.is_file():
        raise ProblemError(f"there is no file `{file}`", term=file)
    libsbml = sbml_library()
    if file.suffix in ANTIMONY_SUFFIXES:
        document = libsbml.readSBMLFromString(_sbml_of_antimony(file))
    else:
        document = libsbml.readSBMLFromFile(str(file.resolve()))  # external models
    _check_errors(document, libsbml, file)
    _check_packages(document, file)
    _flatten(document, libsbml, file)
    if document.getLevel() < _LEVEL and not document.setLevelAndVersion(_LEVEL, _VERSION, False):
        _check_errors(document, libsbml, file)
    model = document.getModel()
    if model is None:
        raise ProblemError(f"`{file}` has no model", term=file)
    return document, model


def _sbml_of_antimony(file: Path) -> str:
    """The SBML that the package ``antimony`` makes of a text."""
    antimony = optional_module(
        "antimony", "reading Antimony needs antimony", "pip install antimony", ProblemError
    )
    antimony.clearPreviousLoads()
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ProblemError(f"`{file}` cannot be read: {error}", term=file) from None
    if antimony.loadAntimonyString(text) < 0:
        message = " ".join(antimony.getLastError().split())
        raise ProblemError(f"`{file}` is not readable Antimony: {message}", term=file)
    return str(antimony.getSBMLString(antimony.getMainModuleName()))


def _check_errors(document: libsbml.SBMLDocument, libsbml: ModuleType, file: Path) -> None:
    """Raise the errors that libsbml found while it read a file."""
    errors = [document.getError(k) for k in range(document.getNumErrors())]
    grave = [error for error in errors if error.getSeverity() >= libsbml.LIBSBML_SEV_ERROR]
    if grave:
        texts = [
            f"line {error.getLine()}: {' '.join(error.getMessage().split())}"
            for error in grave[:_PARTS_READ]
        ]
        raise ProblemError(
            f"`{file}` is not readable SBML: {'; '.join(texts)}",
            term=file,
            remedy="let an SBML validator check it",
        )


def _check_packages(document: libsbml.SBMLDocument, file: Path) -> None:
    """Raise for a required package that is not understood."""
    packages = [document.getPlugin(k).getPackageName() for k in range(document.getNumPlugins())]
    for name in packages:
        if name not in _HARMLESS and document.getPackageRequired(name):
            raise ProblemError(
                f"`{file}` requires the SBML package {quote(name)}, which is not supported",
                term=name,
                remedy="export the model without it",
            )
    for k in range(document.getNumUnknownPackages()):
        if document.getUnknownPackagePrefix(k):
            name = document.getUnknownPackagePrefix(k)
            raise ProblemError(
                f"`{file}` uses the unknown SBML package {quote(name)}",
                term=name,
                remedy="export the model without it",
            )


def _flatten(document: libsbml.SBMLDocument, libsbml: ModuleType, file: Path) -> None:
    """Put submodels into the model itself."""
    if document.getPlugin("comp") is None:
        return
    properties = libsbml.ConversionProperties()
    properties.addOption("flatten comp", True)
    properties.addOption("performValidation", False)
    if document.convert(properties) != libsbml.LIBSBML_OPERATION_SUCCESS:
        _check_errors(document, libsbml, file)
        raise ProblemError(
            f"the submodels of `{file}` cannot be put into one model",
            term=file,
            remedy="keep the models that it refers to beside it, or export a flat model",
        )
