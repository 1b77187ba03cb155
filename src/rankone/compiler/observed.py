"""Outputs of a solve: quantities that are evaluated along its trajectories."""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping, Set

import sympy as sp

from rankone.compiler.agreement.agreement import ComparedPoints
from rankone.compiler.codegen.output_expressions import OutputFormulas, output_formulas
from rankone.compiler.codegen.quantities import Quantities, WrittenFunction
from rankone.problem.functions import known_applied
from rankone.solvers.observation import Observation
from rankone.solvers.outcome import SolutionMetadata
from rankone.solvers.request import Domain, counted_states
from rankone.support.arrays import Array
from rankone.support.errors import EvaluationError, OptionError
from rankone.support.wording import listing, quote
from rankone.tensors.bases.coordinates import name_of
from rankone.trajectories.system.system import System

_POINTS = 20  # Points at which generated functions are compared with their expressions
_ASK_SOLUTION = "name the unknowns in it in unknowns=, and ask that solution: .output(...)"
_Key = tuple[tuple[tuple[str, object], ...], tuple[float, float]]
"""Outputs by name, and the horizon."""
_EXAMPLE = 'give for example outputs={"energy": x**2 / 2}, or the name of a definition'


class SolveOutputs:
    """The outputs of solves of a compiled problem.

    They are translated once: solves on other boxes take the same functions. ``seconds`` is what
    the translation of the last ones took.
    """

    def __init__(self, system: System, metadata: SolutionMetadata) -> None:
        self.system, self.metadata, self.seconds = system, metadata, 0.0
        self._last: tuple[_Key | None, OutputFormulas] | None = None

    def over(self, domain: Domain, outputs: object, unknowns: object) -> Observation:
        """What trajectories on a domain are reduced to: unknowns, then outputs.

        An OptionError where outputs are no functions of the states at a time, or not smooth over
        time or the parameters.
        """
        system = self.system
        if system.events or system.at_rest is not None or system.jumps.times:
            what = (
                "events" if system.events else "jumps" if system.jumps.times else "a steady start"
            )
            raise OptionError(
                f"outputs along trajectories do not take {what}",
                remedy="solve for the unknowns, and ask the solution: solve(...).output(...)",
            )
        kept: dict[str, object] = {}
        if unknowns is not None:
            rows = counted_states(system, unknowns) or ()
            kept = {system.states[row]: system.states[row] for row in rows}
        asked = _named(outputs, kept)
        formulas = self._formulas(asked, {**kept, **asked}, domain)
        quantities = formulas.over(domain.box, domain.horizon)
        if not_smooth := _not_smooth(quantities, formulas):
            which = "the output" if len(quantities.names) == 1 else "one of the outputs"
            raise OptionError(
                f"{which} {listing(quantities.names)} {not_smooth}",
                term=quantities.names,
                remedy=_ASK_SOLUTION,
            )

        def values(times: Array, states: Array, points: Array) -> list[Array]:
            return [*quantities.values(times, states, points, [])]

        rows = tuple(source.row for source in quantities.sources)
        names, texts = quantities.names, quantities.texts
        surfaces = quantities.state_surfaces if quantities.n_state_surfaces else None
        text = quantities.values
        written = text.function if isinstance(text, WrittenFunction) else None
        written = None if quantities.sums else written
        return Observation(names, texts, rows, values, surfaces=surfaces, written=written)

    def _formulas(
        self, asked: Mapping[str, object], named: Mapping[str, object], domain: Domain
    ) -> OutputFormulas:
        """The functions of unknowns and outputs; those of the last solve if they are the same."""
        key = _key(named, domain)
        if self._last is not None and key is not None and self._last[0] == key:
            return self._last[1]
        began, unknowns = time.perf_counter(), self.system.unknowns
        for name, output in asked.items():
            _check_name(name, {*unknowns, *dict(self.metadata.definitions)})
            whose = _owner(name, unknowns)
            if whose and not _is_name(output, name):
                raise OptionError(
                    f"the output {quote(name)} has the name of {whose}, and is {quote(output)}",
                    term=name,
                    remedy="give the output another name",
                )
        compared = ComparedPoints.of(self.system, _POINTS)
        samples = compared.time, compared.parameters, compared.states
        formulas = output_formulas(named, self.metadata, domain.horizon, samples)
        _check_states_alone(formulas.quantities)
        self.seconds = time.perf_counter() - began
        self._last = key, formulas
        return formulas


def _key(named: Mapping[str, object], domain: Domain) -> _Key | None:
    """What tells outputs apart; None where that is not known.

    Functions of the user are equal for SymPy if their names are.
    """
    terms = [term for term in named.values() if isinstance(term, str | sp.Basic)]
    symbolic = [term for term in terms if isinstance(term, sp.Basic)]
    if len(terms) < len(named) or known_applied(symbolic):
        return None
    return (*named.items(),), domain.horizon


def _owner(name: str, unknowns: Collection[str]) -> str:
    """Whose name it is in a problem, such as ``x_tt`` of a derivative; empty if it is free."""
    if name in unknowns:
        return "an unknown"
    of, _, order = str(name).rpartition("_")
    return "the derivative of an unknown" if of in unknowns and set(order) == {"t"} else ""


def _is_name(output: object, name: str) -> bool:
    """Whether an output is the unknown of a name."""
    try:
        return name_of(output) == name
    except EvaluationError:
        return False


def _check_name(name: object, held: Set[str]) -> None:
    """Raise an OptionError for a name that is neither an identifier nor in the problem."""
    if isinstance(name, str) and name.strip() and not name.isidentifier() and name not in held:
        raise OptionError(
            f"the name {quote(name)} of an output is not an identifier",
            term=name,
            remedy="use letters, digits and underscores, with no digit first",
        )


def _named(outputs: object, kept: Mapping[str, object]) -> dict[str, object]:
    """Outputs by name, as a mapping or as names of definitions; none has the name of a kept one."""
    if isinstance(outputs, str):
        outputs = {outputs: outputs}
    elif isinstance(outputs, list | tuple) and all(isinstance(name, str) for name in outputs):
        outputs = {name: name for name in outputs}
    if not isinstance(outputs, Mapping):
        raise OptionError(
            f"outputs={outputs!r} is not a mapping from names to expressions",
            term=outputs,
            remedy=_EXAMPLE,
        )
    if not outputs:
        raise OptionError("outputs is empty", remedy=_EXAMPLE)
    for name in outputs:
        if name in kept:
            raise OptionError(
                f"{quote(name)} is both an output and among unknowns",
                term=name,
                remedy="give the output another name",
            )
    return dict(outputs)


def _not_smooth(quantities: Quantities, formulas: OutputFormulas) -> str | None:
    """What outputs do that trajectories cannot be sampled for; None if they are smooth."""
    for name, places in zip(formulas.metadata.coordinates, quantities.cuts, strict=True):
        if places:
            return f"jumps, kinks or is narrow at {name} = {places[0]:.6g}"
    if formulas.narrow:
        return "kinks or is narrow over several parameters at once"
    if quantities.gap_texts:
        return f"has no value somewhere: {quantities.gap_texts[0]}"
    return None


def _check_states_alone(quantities: Quantities) -> None:
    """Raise an OptionError for what is no function of states, parameters and time."""
    if quantities.reductions:
        raise OptionError(
            f"{quote(quantities.reductions[0].text)} is over the whole of time",
            term=quantities.reductions[0].text,
            remedy="solve for what is inside as an output, and ask that solution: .output(...)",
        )
    derivatives = [source for source in quantities.sources if source.order]
    if derivatives:
        raise OptionError(
            "an output has a derivative that is no state",
            remedy="write what the equation says it is",
        )
