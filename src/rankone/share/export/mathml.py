"""Equations as people write them, typeset as MathML.

The equations of a solution are texts in Python's arithmetic, which :mod:`ast` reads. Nothing is
evaluated, and terms keep their order. Text that is not such a formula is shown as it is.
"""

from __future__ import annotations

import ast
import html
import keyword
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from enum import IntEnum, auto

from rankone.solvers.outcome import Role, SolutionMetadata

_LETTERS = (
    "alpha beta gamma delta epsilon zeta eta theta iota kappa lambda mu nu xi omicron pi rho sigma "
    "tau upsilon phi chi psi omega"
)
_GREEK = dict(zip(_LETTERS.split(), "αβγδεζηθικλμνξοπρστυφχψω", strict=True))
_GREEK |= {name.capitalize(): letter.upper() for name, letter in _GREEK.items()}
_SUBSCRIPTS = str.maketrans("0123456789aehijklmnoprstuvx", "₀₁₂₃₄₅₆₇₈₉ₐₑₕᵢⱼₖₗₘₙₒₚᵣₛₜᵤᵥₓ")
_NAME = re.compile(r"([^\W\d_]+)(?:_?(\d+)|_(\w*[^\W_]))?")
_WORD = re.compile(r"[^\W\d]\w*")
_KEYWORD_SUFFIX = "_as_a_name_"
_PRIME = "′"
_TIMES = "<mo>&#x2062;</mo><mspace width='0.15em'></mspace>"
_DOT = "<mo>·</mo>"
_OPEN = "<mo stretchy='false'>(</mo>"
_CLOSE = "<mo stretchy='false'>)</mo>"
_SPACE = "<mspace width='0.35em'></mspace>"
_COMPARED: dict[type[ast.cmpop], str] = {ast.Lt: "&lt;", ast.LtE: "≤", ast.Gt: "&gt;", ast.GtE: "≥"}
_LOGIC: dict[type[ast.operator], str] = {ast.BitAnd: "and", ast.BitOr: "or"}


class _Binding(IntEnum):
    """How tightly a formula binds, from the loosest to the tightest."""

    CASES = auto()
    SUM = auto()
    PRODUCT = auto()
    SIGN = auto()
    POWER = auto()
    ATOM = auto()


class _NoFormulaError(Exception):
    """Text that is not a formula."""


class Notation:
    """Names and equations of a problem, for people.

    ``theta0`` is θ with a subscript, ``C_D`` is C with one, a derivative that is a state
    (``theta_t``) is θ′. Names that would look the same (``theta0``, ``theta_0``) stay as they are.
    """

    def __init__(self, metadata: SolutionMetadata) -> None:
        self._primes = _derivatives(metadata)
        self._equations = metadata.equations
        self._fixed = metadata.statements[len(metadata.equations) :]
        names = {*metadata.states, metadata.time, *metadata.parameters}
        names -= self._primes.keys()
        shapes = Counter(_letter_and_index(name) for name in names)
        self._alike = {name for name in names if shapes[_letter_and_index(name)] > 1}

    @property
    def derivatives(self) -> frozenset[str]:
        return frozenset(self._primes)

    def _letter_and_index(self, name: str) -> tuple[str, str]:
        """Letters and subscript of a name; the name as it is if another one would look the same."""
        return (name, "") if name in self._alike else _letter_and_index(name)

    def text(self, name: str) -> str:
        """A name in plain text: ``θ₀``, ``Tᵢ``, ``C_D``, ``θ′``."""
        base, order = self._primes.get(name, (name, 0))
        letter, index = self._letter_and_index(base)
        if index:
            small = all(ord(character) in _SUBSCRIPTS for character in index)
            index = index.translate(_SUBSCRIPTS) if small else f"_{index}"
        return f"{letter}{index}{_PRIME * order}"

    def name(self, name: str, further: int = 0) -> str:
        """A name in MathML, without the element around; ``further`` times derived."""
        base, order = self._primes.get(name, (name, 0))
        letter, index = (
            f"<mi>{html.escape(text)}</mi>" if text else "" for text in self._letter_and_index(base)
        )
        if index:
            index = re.sub(r"<mi>(\d+)</mi>", r"<mn>\1</mn>", index)
            letter = f"<msub>{letter}{index}</msub>"
        if not order + further:
            return letter
        # no superscript: in most fonts the prime is raised already
        primes = f"<mo lspace='0' rspace='0'>{_PRIME * (order + further)}</mo>"
        return f"<mrow>{letter}{primes}</mrow>"

    def symbol(self, name: str) -> str:
        return f"<math>{self.name(name)}</math>"

    def equations(self) -> list[list[str]]:
        """Groups of equations, initial values and fixed values, as elements of a page.

        Lines that say only what a derivative is called are left out.
        """
        groups: dict[bool, list[str]] = {}
        for text in self._equations:
            if not self._says_a_name(text):
                is_initial = re.match(r"[^=]+\([^()=]+\) = ", text) is not None
                groups.setdefault(is_initial, []).append(self._line(text))
        fixed = [self._line(text) for text in self._fixed]
        return [*groups.values(), *([fixed] if fixed else [])]

    def _says_a_name(self, text: str) -> bool:
        """Whether a line is ``theta' = theta_t``."""
        left, _, right = text.partition(" = ")
        base, order = self._primes.get(left.removesuffix("'"), (left.removesuffix("'"), 0))
        return left.endswith("'") and self._primes.get(right) == (base, order + 1)

    def _line(self, text: str) -> str:
        try:
            rows = self._jump(text) if text.startswith("at ") else self._equation(text)
        except (_NoFormulaError, SyntaxError, ValueError, RecursionError, MemoryError):
            return f"<code>{html.escape(text)}</code>"
        return f"<math display='block'>{rows}</math>"

    def _equation(self, text: str) -> str:
        left, equals, right = text.partition(" = ")
        if not equals:
            raise _NoFormulaError
        start = re.fullmatch(r"(.+)\(([^()]+)\)", left)
        if left.endswith("'"):
            head = self.name(left.removesuffix("'"), 1)
        elif start:
            head = f"{self.name(start[1])}{_OPEN}{self.formula(start[2])}{_CLOSE}"
        else:
            head = self.name(left)
        return f"<mrow>{head}<mo>=</mo>{self.formula(right)}</mrow>"

    def _jump(self, text: str) -> str:
        """``at t = 12, 24: c -> c + 1, p -> 0``."""
        where, _, changes = text.removeprefix("at ").partition(": ")
        clock, _, times = where.partition(" = ")
        resets = []
        for change in re.split(r", (?=[^\s,]+ -> )", changes):
            name, arrow, after = change.partition(" -> ")
            if not arrow:
                raise _NoFormulaError
            resets.append(f"{self.name(name)}<mo>→</mo>{self.formula(after)}")
        at = "<mo>,</mo>".join(f"<mn>{html.escape(time)}</mn>" for time in times.split(", "))
        return (
            f"<mrow><mtext>at</mtext>{_SPACE}{self.name(clock)}<mo>=</mo>{at}<mo>:</mo>"
            f"<mspace width='0.6em'></mspace>{'<mo>,</mo>'.join(resets)}</mrow>"
        )

    def formula(self, text: str) -> str:
        """A formula in MathML, without the element around."""
        tree = ast.parse(_WORD.sub(_protected, text.strip()), mode="eval")
        return self._written(tree.body)[0]

    def _written(self, node: ast.expr) -> tuple[str, _Binding]:
        """A node in MathML, and how strongly it binds."""
        match node:
            case ast.Constant(value=int() | float() as x) if not isinstance(x, bool):
                return _number(x)
            case ast.Name(id=name):
                name = name.removesuffix(_KEYWORD_SUFFIX)
                return self.name(name), _Binding.POWER if name in self._primes else _Binding.ATOM
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                return f"<mo form='prefix'>−</mo>{self._term(operand)}", _Binding.SIGN
            case ast.BinOp(left=left, op=ast.Add() | ast.Sub() as op, right=right):
                sign = "+" if isinstance(op, ast.Add) else "−"
                first, last = self._held(left, _Binding.SUM), self._term(right)
                return f"{first}<mo>{sign}</mo>{last}", _Binding.SUM
            case ast.BinOp(left=left, op=ast.Mult(), right=right):
                first, last = self._held(left, _Binding.PRODUCT), self._held(right, _Binding.POWER)
                between = _DOT if _begins_with_number(right) else _TIMES
                return f"{first}{between}{last}", _Binding.PRODUCT
            case ast.BinOp(left=left, op=ast.Div(), right=right):
                if (positive := _without_sign(node)) is not None:
                    return self._written(ast.UnaryOp(op=ast.USub(), operand=positive))
                above, below = self._written(left)[0], self._written(right)[0]
                fraction = f"<mfrac><mrow>{above}</mrow><mrow>{below}</mrow></mfrac>"
                return fraction, _Binding.POWER
            case ast.BinOp(left=left, op=ast.Pow(), right=right):
                return self._power(left, right), _Binding.POWER
            case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]):
                holds = {"Piecewise": _Binding.CASES, "exp": _Binding.POWER}.get(
                    name, _Binding.ATOM
                )
                return self._call(name.removesuffix(_KEYWORD_SUFFIX), arguments), holds
        raise _NoFormulaError

    def _term(self, node: ast.expr) -> str:
        """A formula after a sign: in parentheses if it is a sum or begins with a sign."""
        return self._held(node, _Binding.PRODUCT if _without_sign(node) is None else _Binding.ATOM)

    def _held(self, node: ast.expr, least: _Binding) -> str:
        """A formula, in parentheses if it binds less tightly than its place needs."""
        text, strength = self._written(node)
        fits = strength >= least
        return f"<mrow>{text}</mrow>" if fits else f"<mrow><mo>(</mo>{text}<mo>)</mo></mrow>"

    def _power(self, base: ast.expr, exponent: ast.expr) -> str:
        above = f"<mrow>{self._written(exponent)[0]}</mrow>"
        plain = {"sqrt", "exp", "Abs", "abs", "Piecewise"}
        match base, exponent:
            case (
                ast.Call(func=ast.Name(id=name), args=arguments),
                ast.Constant(value=int()),
            ) if name not in plain:  # sin to the power of -1 would be read as the arcsine
                head = f"<msup><mi>{html.escape(name)}</mi>{above}</msup>"
                return f"{head}{self._arguments(arguments)}"
        return f"<msup>{self._held(base, _Binding.ATOM)}{above}</msup>"

    def _call(self, name: str, arguments: Sequence[ast.expr]) -> str:
        if name == "Piecewise":
            return self._piecewise(arguments)
        if len(arguments) == 1 and name in ("sqrt", "exp", "Abs", "abs"):
            inner = f"<mrow>{self._written(arguments[0])[0]}</mrow>"
            if name == "sqrt":
                return f"<msqrt>{inner}</msqrt>"
            if name == "exp":
                return f"<msup><mi>e</mi>{inner}</msup>"
            return f"<mrow><mo>|</mo>{inner}<mo>|</mo></mrow>"
        return f"<mi>{html.escape(name)}</mi>{self._arguments(arguments)}"

    def _arguments(self, arguments: Sequence[ast.expr]) -> str:
        inner = "<mo>,</mo>".join(self._written(argument)[0] for argument in arguments)
        return f"<mo>&#x2061;</mo><mrow><mo>(</mo>{inner}<mo>)</mo></mrow>"

    def _piecewise(self, branches: Sequence[ast.expr]) -> str:
        rows = ""
        for branch in branches:
            if not isinstance(branch, ast.Tuple) or len(branch.elts) != 2:
                raise _NoFormulaError
            formula, condition = branch.elts
            cells = self._written(formula)[0], self._condition(condition)
            rows += f"<mtr><mtd>{cells[0]}</mtd><mtd>{cells[1]}</mtd></mtr>"
        return f"<mrow><mo>{{</mo><mtable columnalign='left'>{rows}</mtable></mrow>"

    def _condition(self, node: ast.expr) -> str:
        match node:
            case ast.Constant(value=True):
                return "<mtext>otherwise</mtext>"
            case ast.BinOp(left=left, op=ast.BitAnd() | ast.BitOr() as op, right=right):
                word = f"{_SPACE}<mtext>{_LOGIC[type(op)]}</mtext>{_SPACE}"
                return f"{self._condition(left)}{word}{self._condition(right)}"
            case ast.UnaryOp(op=ast.Invert(), operand=inner):
                return f"<mtext>not</mtext>{_SPACE}<mo>(</mo>{self._condition(inner)}<mo>)</mo>"
            case ast.Compare(left=left, ops=signs, comparators=sides):
                text = self._written(left)[0]
                for sign, side in zip(signs, sides, strict=True):
                    if type(sign) not in _COMPARED:
                        raise _NoFormulaError
                    text += f"<mo>{_COMPARED[type(sign)]}</mo>{self._written(side)[0]}"
                return text
        raise _NoFormulaError


_EXPONENT = re.compile(r"(?:\^|\*\*)(?:\((-?\d+)\)|(-?\d+))")
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def with_exponents(unit: str) -> str:
    """A unit with raised exponents, and dots between factors: ``kg·m²/s``.

    >>> with_exponents("kg*m^2/s^-1")
    'kg·m²/s⁻¹'
    """
    raised = _EXPONENT.sub(lambda match: (match[1] or match[2]).translate(_RAISED), unit)
    return raised.replace("*", "·")


def _begins_with_number(node: ast.expr) -> bool:
    """Whether a formula begins with digits, which would run into digits before it."""
    match node:
        case ast.Constant():
            return True
        case ast.BinOp(left=left, op=ast.Mult() | ast.Div() | ast.Pow()):
            return _begins_with_number(left)
    return False


def _without_sign(node: ast.expr) -> ast.expr | None:
    """The negative of a term that begins with a minus sign; None for others."""
    match node:
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            return operand
        case ast.BinOp(left=left, op=ast.Mult() | ast.Div() as op, right=right):
            positive = _without_sign(left)
            return None if positive is None else ast.BinOp(left=positive, op=op, right=right)
    return None


def _derivatives(metadata: SolutionMetadata) -> Mapping[str, tuple[str, int]]:
    """The unknown and the order of each derivative that is a state."""
    derivatives = {}
    for name, role in zip(metadata.states, metadata.roles, strict=True):
        base, _, suffix = name.rpartition("_")
        order = len(suffix) // max(len(metadata.time), 1)
        if role == Role.DERIVATIVE and base and suffix == metadata.time * order:
            derivatives[name] = base, order
    return derivatives


def _letter_and_index(name: str) -> tuple[str, str]:
    match = _NAME.fullmatch(name)
    if match is None:
        return name, ""
    index = match[2] or match[3] or ""
    return _GREEK.get(match[1], match[1]), _GREEK.get(index, index)


def _number(x: float) -> tuple[str, _Binding]:
    digits, _, power = repr(x).partition("e")
    if not power:
        return f"<mn>{digits}</mn>", _Binding.ATOM
    ten = f"<msup><mn>10</mn><mn>{int(power)}</mn></msup>".replace("<mn>-", "<mn>−")
    return f"<mn>{digits.removesuffix('.0')}</mn><mo>·</mo>{ten}", _Binding.PRODUCT


def _protected(match: re.Match[str]) -> str:
    """``lambda`` and its like as ordinary names."""
    word = match.group()
    allowed = word in ("True", "False", "None") or not keyword.iskeyword(word)
    return word if allowed else word + _KEYWORD_SUFFIX
