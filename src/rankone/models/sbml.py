"""SBML and Antimony files as models."""

from __future__ import annotations

from collections.abc import Collection
from os import PathLike

from rankone.models.assembly import Assembly
from rankone.models.document import open_document
from rankone.models.elements import elements_of, with_free_starts
from rankone.models.model import Model
from rankone.models.units import units_of
from rankone.support.errors import bounded_depth


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
