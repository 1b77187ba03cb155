"""The variables of pointwise functions: time, parameters and states as names of Python."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import sympy as sp

from rankone.codegen.names import Names
from rankone.codegen.pointwise import mask
from rankone.codegen.printer import common_subexpressions
from rankone.codegen.text import assignment, docstring, unpacking
from rankone.ir.forms import Coordinate, State

__all__ = ["Variables"]


class Variables:
    """Writes expressions of states ``x(t)``, time and parameters over real symbols.

    Parameters
    ----------
    states : sequence of State
    coordinates : sequence of Coordinate
    reserved : collection of str
        Names that the function has for itself, beside its arguments.
    """

    def __init__(
        self,
        states: Sequence[State],
        coordinates: Sequence[Coordinate],
        reserved: Collection[str] = (),
    ) -> None:
        clock, *parameters = coordinates
        self.functions = [sp.Function(state.name)(clock.symbol) for state in states]
        self.time = sp.Symbol(clock.name, real=True)
        self.states = [sp.Symbol(state.name, real=True) for state in states]
        self.parameters = [sp.Symbol(c.name, real=True) for c in parameters]
        self._real = dict(zip(self.functions, self.states, strict=True))
        own = zip(coordinates, [self.time, *self.parameters], strict=True)
        self._real |= {c.symbol: symbol for c, symbol in own}
        fixed = ["np", "special", "CubicSpline", "t", "u", "p", "shape", "out", *reserved]
        self._names = Names(fixed)
        self._parameter_names = [self._names(c.name) for c in parameters]
        self._names.taken -= {"u"}  # states are unpacked last and may replace the argument
        self._state_names = [self._names(state.name) for state in states]
        self._written = {self.time: "t"}
        self._written |= dict(zip(self.parameters, self._parameter_names, strict=True))
        self._written |= dict(zip(self.states, self._state_names, strict=True))
        self._used: set[sp.Basic] = set()

    def texts(self, expressions: Sequence[sp.Expr]) -> tuple[list[tuple[str, str]], list[str]]:
        """Python text of expressions, after what they share by name."""
        real = [expression.xreplace(self._real) for expression in expressions]
        self._used |= set().union(*(expression.free_symbols for expression in real))
        return common_subexpressions(real, self._written, self._names.numbered("c"))

    def function(
        self,
        head: str,
        about: str,
        shape: str,
        expressions: Sequence[sp.Expr],
        meanings: Sequence[str] = (),
    ) -> list[str]:
        """A function whose value has the expressions as entries, (expressions, ...).

        ``head`` are its name and arguments, ``shape`` the statement for the common shape of
        those, ``meanings`` are comments.
        """
        shared, texts = self.texts(expressions)
        lines = [f"def {head}:", *docstring([about]), shape]
        lines += ["    t = np.asarray(t, dtype=float)"] if self.time in self._used else []
        lines += self.unpacked()
        for name, text in shared:
            lines += assignment(name, [text])
        lines.append(f"    out = np.empty(({len(texts)}, *shape))")
        for i, text in enumerate(texts):
            lines += assignment(f"out[{i}]", [text], meanings[i] if meanings else "")
        return [*lines, "    return out"]

    def unpacked(self) -> list[str]:
        """Statements that give the variables of what was written so far their names."""
        lines: list[str] = []
        for names, symbols, source in (
            (self._parameter_names, self.parameters, "p"),
            (self._state_names, self.states, "u"),
        ):
            used = [i for i, symbol in enumerate(symbols) if symbol in self._used]
            lines += unpacking(mask(names, used), source)
        return lines
