"""Lifting: functions of the unknowns become unknowns themselves, with equations of their own.

``sin(theta)`` in a right-hand side becomes ``s`` with ``s' = c*theta'``, ``c' = -s*theta'``: the
system is polynomial then, and exactly the same. Coefficients that couple coordinates, such as
``cos(w*t)`` and ``1/(k1 + k2)``, are lifted in the same way. Compare the quadratisation of QBee
(Bychkov & Pogudin, "Optimal monomial quadratization for ODE systems", 2021) and polynomialisation
in BioCham (Hemery, Fages & Soliman, 2020).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import sympy as sp
from sympy.core.relational import Relational

from rankone.expressions.notation import text_of
from rankone.expressions.numbers import exact
from rankone.ir.forms import Jump, Role, State
from rankone.support.budget import check_time
from rankone.support.wording import count
from rankone.symbolic.first_order import FirstOrderSystem
from rankone.symbolic.splitting import Indivisible, Splitter

__all__ = ["Lifting", "NotLiftable", "lift"]

_MOST = 60
"""Most unknowns that are added."""
_ROOTS = 3
"""Roots up to this are lifted as powers of one, z = b**(-1/q) with z' = -z**(q + 1) b'/q."""


class NotLiftable(Exception):
    """An expression has no lifted form."""

    def __init__(self, expression: sp.Expr) -> None:
        super().__init__(expression)
        self.expression = expression


@dataclass(frozen=True)
class Lifting:
    """A system with further unknowns, and what they stand for.

    Attributes
    ----------
    system : FirstOrderSystem
        The states of before, then the lifted ones.
    meanings : tuple of Expr
        What each lifted state is, in the states of before.
    invariants : tuple of Expr
        Expressions of all states that vanish along every trajectory.
    """

    system: FirstOrderSystem
    meanings: tuple[sp.Expr, ...]
    invariants: tuple[sp.Expr, ...]

    @property
    def count(self) -> int:
        """How many unknowns were added."""
        return len(self.meanings)

    def __str__(self) -> str:
        system, n = self.system, len(self.system.states) - self.count
        t = system.coordinates[0].symbol
        lines = [f"Lifted: {count(self.count, 'further unknown')}"]
        for u, rate, start, meaning in zip(
            system.functions[n:], system.rhs[n:], system.initial[n:], self.meanings, strict=True
        ):
            equation = text_of(sp.Eq(sp.Derivative(u, t), rate, evaluate=False))
            lines.append(f"  {u.func.__name__} = {text_of(meaning)}: {equation}, from {start}")
        lines += [f"  0 = {text_of(invariant)}" for invariant in self.invariants]
        return "\n".join(lines)

    __repr__ = __str__


def lift(system: FirstOrderSystem) -> Lifting:
    """Lift all functions of a system that are not polynomial in its states or couple coordinates.

    Raises
    ------
    NotLiftable
        If a function has no lifted form: an absolute value, a table, a function of the user.
    """
    return _Lifter(system).lifted()


class _Lifter:
    """The working state: what was lifted, and the rates of all states so far."""

    def __init__(self, system: FirstOrderSystem) -> None:
        self.system = system
        self.time = system.coordinates[0].symbol
        self.taken = {s.name for s in system.states} | {c.name for c in system.coordinates}
        self.before = [sp.Symbol(state.name, real=True) for state in system.states]
        self.states = set(self.before)  # lifted ones, too
        self.splitter = Splitter(system.coordinates, self.before)
        self.new: dict[sp.Expr, sp.Symbol] = {}  # meanings and the states that stand for them
        self.rates: list[sp.Expr] = []  # polynomials: of the states of before, then the lifted
        self.invariants: list[sp.Expr] = []
        self.reciprocals: list[tuple[sp.Symbol, sp.Expr]] = []
        self.waiting: list[Callable[[], sp.Expr]] = []

    def lifted(self) -> Lifting:
        """Lift until every rate is polynomial."""
        system = self.system
        plain = dict(zip(system.functions, self.before, strict=True))
        functions = {symbol: u for u, symbol in plain.items()}
        try:
            rates = [f.xreplace(plain) for f in system.rhs]
            self._check(rates)
            found = [self.polynomial(rate) for rate in rates]
            self.rates = [self.reduced(rate) for rate in found]
            while self.waiting:
                self.rates.append(self.reduced(self.waiting.pop(0)()))
        except NotLiftable as part:
            raise NotLiftable(part.expression.xreplace(functions)) from None
        functions |= {s: sp.Function(s.name)(self.time) for s in self.new.values()}
        start = dict(zip(self.before, system.initial, strict=True))
        start[self.time] = exact(sp.Float(system.coordinates[0].lower))
        lifted = [functions[symbol] for symbol in self.new.values()]
        made = [State(u.func.__name__, u, Role.LIFTED) for u in lifted]
        jumps = tuple(self._jumped(jump, plain, functions) for jump in system.jumps)
        return Lifting(
            replace(
                system,
                states=(*system.states, *made),
                functions=(*system.functions, *lifted),
                rhs=tuple(rate.xreplace(functions) for rate in self.rates),
                initial=(*system.initial, *(m.subs(start, simultaneous=True) for m in self.new)),
                origins=(*system.origins, *(None for _ in lifted)),
                jumps=jumps,
            ),
            tuple(meaning.xreplace(functions) for meaning in self.new),
            tuple(invariant.xreplace(functions) for invariant in self.invariants),
        )

    def _jumped(
        self,
        jump: Jump,
        plain: Mapping[sp.Expr, sp.Symbol],
        functions: Mapping[sp.Symbol, sp.Expr],
    ) -> Jump:
        """The same jump, after which lifted states are again what they stand for."""
        after = {s: v.xreplace(plain) for s, v in zip(self.before, jump.values, strict=True)}
        after = {state: value for state, value in after.items() if state != value}
        at: dict[sp.Symbol, sp.Expr] = {**after, self.time: exact(sp.Float(jump.time))}
        lifted = [
            meaning.subs(at, simultaneous=True) if meaning.free_symbols & set(after) else state
            for meaning, state in self.new.items()
        ]
        return Jump(jump.time, (*jump.values, *(value.xreplace(functions) for value in lifted)))

    def _check(self, rates: Sequence[sp.Expr]) -> None:
        """Raise NotLiftable for a function without a rule, the innermost one."""
        known = {*_RULES, *_RATIOS, "Pow"}
        for rate in rates:
            for part in sp.postorder_traversal(rate):
                function = isinstance(part, sp.Function | sp.Piecewise | Relational)
                if function and type(part).__name__ not in known and not self._separates(part):
                    raise NotLiftable(part)

    # -- polynomials of states ---------------------------------------------------------------

    def polynomial(self, expression: sp.Expr) -> sp.Expr:
        """The same as a polynomial of states, lifted ones included."""
        check_time()
        if expression.is_Symbol or expression.is_number:
            return expression
        if expression.is_Mul:
            return self._product(expression)
        if expression.is_Add:
            return sp.Add(*map(self.polynomial, expression.args))
        if expression.is_Pow and expression.exp.is_Integer and expression.exp.is_positive:
            return self.polynomial(expression.base) ** expression.exp
        if self._separates(expression):
            return expression
        if expression.is_Pow:
            return self._power(expression.base, expression.exp)
        name = type(expression).__name__
        if name in _RATIOS:
            return self.polynomial(_RATIOS[name](*expression.args))
        if name in _RULES:
            return _RULES[name](self, expression.args[0])
        raise NotLiftable(expression)

    def _separates(self, expression: sp.Expr) -> bool:
        """Whether a function of coordinates alone is a sum of separated products."""
        if self._varies(expression):
            return False
        if len(expression.free_symbols) < 2:
            return True
        try:
            self.splitter.split(expression)
        except Indivisible:
            return False
        return True

    def reduced(self, rate: sp.Expr) -> sp.Expr:
        """The same polynomial, of lower degree by ``r*base = 1`` of the reciprocals r.

        The leading monomial of r*base is replaced: x/(c + x) = 1 - c*r.
        """
        gens = [state for state in self._ordered() if state in rate.free_symbols]
        if not self.reciprocals or not gens:
            return rate
        terms = _terms(rate, gens)
        rules = [rule for r, base in self.reciprocals if (rule := _rule_of(r, base, gens))]
        done: dict[tuple[int, ...], sp.Expr] = {}
        waiting = list(terms.items())
        while waiting:
            check_time()
            monomial, coefficient = waiting.pop()
            for leading, rest in rules:
                if all(m >= power for m, power in zip(monomial, leading, strict=True)):
                    left = [m - power for m, power in zip(monomial, leading, strict=True)]
                    waiting += [
                        (tuple(a + b for a, b in zip(left, other, strict=True)), coefficient * c)
                        for other, c in rest.items()
                    ]
                    break
            else:
                done[monomial] = done.get(monomial, sp.S.Zero) + coefficient
        return sp.Add(
            *(
                sp.expand_mul(c) * sp.Mul(*(g**m for g, m in zip(gens, monomial, strict=True)))
                for monomial, c in sorted(done.items())
            )
        )

    def _ordered(self) -> list[sp.Symbol]:
        return [*self.before, *self.new.values()]

    def _varies(self, expression: sp.Expr) -> bool:
        """Whether there are states in an expression."""
        return not self.states.isdisjoint(expression.free_symbols)

    def derivative(self, expression: sp.Expr) -> sp.Expr:
        """The derivative over time along trajectories, a polynomial of states."""
        parts = [self.polynomial(expression.diff(self.time))]
        for state, rate in zip(self.before, self.rates, strict=False):
            slope = expression.diff(state)
            if slope != 0:
                parts.append(self.polynomial(slope) * rate)
        return sp.Add(*parts)

    def unknown(self, meaning: sp.Expr, prefix: str, rate: Callable[[sp.Expr], sp.Expr]) -> sp.Expr:
        """The state that stands for an expression; ``rate`` gives its rate from the state."""
        if meaning not in self.new:
            if len(self.new) == _MOST:
                raise NotLiftable(meaning)
            name, number = prefix, 1
            while name in self.taken:
                number += 1
                name = f"{prefix}{number}"
            self.taken.add(name)
            state = sp.Symbol(name, real=True)
            self.new[meaning] = state
            self.states.add(state)
            self.waiting.append(lambda: rate(state))
        return self.new[meaning]

    # -- what is lifted, and how -------------------------------------------------------------

    def _power(self, base: sp.Expr, exponent: sp.Expr) -> sp.Expr:
        if self._varies(exponent) or self.time in exponent.free_symbols:
            return self.polynomial(sp.exp(exponent * sp.log(base)))
        if base.is_number:
            return self.exponential(exponent * sp.log(base))
        if exponent.is_Rational and exponent.q <= _ROOTS:
            if exponent == -1:
                saturating = self._saturating(sp.S.One, base)
                if saturating is not None:
                    return saturating
            p, q = int(exponent.p), int(exponent.q)
            whole = max(-(-p // q), 0)
            root = self._root(base, q) ** (q * whole - p)
            return self.polynomial(base) ** whole * root if whole else root
        return self.unknown(
            base**exponent,
            "p",
            lambda y: exponent * y * self._root(base, 1) * self.derivative(base),
        )

    def _root(self, base: sp.Expr, q: int) -> sp.Expr:
        """``base**(-1/q)``."""
        z = self.unknown(
            base ** sp.Rational(-1, q),
            "r",
            lambda z: -(z ** (q + 1)) * self.derivative(base) / q,
        )
        if q == 1 and all(z != r for r, _ in self.reciprocals):
            self.reciprocals.append((z, base))
        return z

    def _product(self, product: sp.Mul) -> sp.Expr:
        """A product, of which a factor may be a reciprocal that saturates with another one."""
        for factor in product.args:
            base, exponent = factor.as_base_exp()
            if exponent == -1:
                saturating = self._saturating(product / factor, base)
                if saturating is not None:
                    return saturating
        powers = [factor for factor in product.args if self._is_general_power(factor)]
        if len(powers) < 2:
            return sp.Mul(*map(self.polynomial, product.args))
        together = [power.as_base_exp() for power in powers]
        state = self.unknown(
            sp.Mul(*powers),
            "p",
            lambda y: y * sp.Add(*(e * self._root(b, 1) * self.derivative(b) for b, e in together)),
        )
        return state * self.polynomial(product / sp.Mul(*powers))

    def _is_general_power(self, factor: sp.Expr) -> bool:
        """Whether a factor is a power that is an unknown of its own, as those of roots are not."""
        base, exponent = factor.as_base_exp()
        fixed = not self._varies(exponent) and self.time not in exponent.free_symbols
        rooted = exponent.is_Rational and exponent.q <= _ROOTS
        return bool(factor.is_Pow and self._varies(base) and fixed and not rooted)

    def _saturating(self, factor: sp.Expr, base: sp.Expr) -> sp.Expr | None:
        """``factor/(a + m)`` with a fixed a and m an exponential or a power: a logistic, or Hill's.

        With r = a/(a + m), m/(a + m) is 1 - r, and r' = -r*(1 - r)*(log m)', without m itself.
        """
        parts = [p for p in sp.Add.make_args(base) if self._varies(p) or p.has(self.time)]
        fixed = base - sp.Add(*parts)
        if len(parts) != 1 or fixed == 0:
            return None
        (m,) = parts
        _, varying = m.as_independent(*self.states, self.time, as_Add=False)
        inner, power = varying.as_base_exp()
        if self._varies(power) or power.has(self.time):  # exp(A), as SymPy writes powers of e
            if inner is not sp.E:
                return None
        elif power.is_Integer:
            return None
        r = self.unknown(fixed / base, "r", lambda r: -r * (1 - r) * self._of_log(inner, power))
        ratio = factor / m
        if not self._varies(ratio) and not ratio.has(self.time):
            return self.polynomial(ratio) * (1 - r)
        return self.polynomial(factor / fixed) * r

    def _of_log(self, base: sp.Expr, exponent: sp.Expr) -> sp.Expr:
        """The derivative of ``exponent*log(base)`` with a fixed base or a fixed exponent."""
        if base is sp.E:
            return self.derivative(exponent)
        return exponent * self._root(base, 1) * self.derivative(base)

    def exponential(self, argument: sp.Expr) -> sp.Expr:
        """``exp(argument)``; what of a sum separates stays outside."""
        inside: list[sp.Expr] = []
        outside: list[sp.Expr] = []
        for part in sp.Add.make_args(sp.expand_mul(argument)):
            alone = len(part.free_symbols) < 2 and not self._varies(part)
            (outside if alone else inside).append(part)
        rest = sp.Add(*inside)
        known = sp.exp(sp.Add(*outside))
        return known * self.unknown(sp.exp(rest), "e", lambda y: y * self.derivative(rest))

    def circular(self, argument: sp.Expr, wanted: type, sign: int) -> sp.Expr:
        """Sine and cosine, or the hyperbolic ones, in pairs."""
        sine, cosine = (sp.sin, sp.cos) if sign < 0 else (sp.sinh, sp.cosh)
        both = sine(argument), cosine(argument)
        known = both[0] in self.new
        c = self.unknown(both[1], "c", lambda _: sign * s * self.derivative(argument))
        s = self.unknown(both[0], "s", lambda _: c * self.derivative(argument))
        if not known:
            self.invariants.append(c**2 - sign * s**2 - 1)
        return s if wanted is sine else c


_Terms = dict[tuple[int, ...], sp.Expr]
"""The coefficient of each monomial, by its powers."""


def _terms(polynomial: sp.Expr, gens: Sequence[sp.Symbol]) -> _Terms:
    """The terms of a polynomial; coefficients are left as they are."""
    terms: _Terms = {}
    for term in sp.Add.make_args(sp.expand(polynomial)):
        powers = dict.fromkeys(gens, 0)
        coefficient = sp.S.One
        for factor in sp.Mul.make_args(term):
            base, power = factor.as_base_exp()
            if base in powers and power.is_Integer:
                powers[base] += int(power)
            else:
                coefficient *= factor
        monomial = tuple(powers.values())
        terms[monomial] = terms.get(monomial, sp.S.Zero) + coefficient
    return terms


def _rule_of(
    r: sp.Symbol, base: sp.Expr, gens: Sequence[sp.Symbol]
) -> tuple[tuple[int, ...], _Terms] | None:
    """The leading monomial of r*base, and what it is by r*base = 1; None if that is of no use."""
    if r not in gens or not base.is_polynomial(*gens):
        return None
    terms = {m: c for m, c in _terms(r * base, gens).items() if c != 0}
    leading = max(terms, key=lambda monomial: (sum(monomial), monomial))
    coefficient = terms.pop(leading)
    if not coefficient.is_number or sum(leading) < 2:
        return None
    constant = (0,) * len(gens)
    rest = {monomial: -c / coefficient for monomial, c in terms.items()}
    rest[constant] = rest.get(constant, sp.S.Zero) + 1 / coefficient
    return leading, rest


def _rule(
    function: Callable[[sp.Expr], sp.Expr],
    prefix: str,
    slope: Callable[[_Lifter, sp.Expr, sp.Expr], sp.Expr],
) -> Callable[[_Lifter, sp.Expr], sp.Expr]:
    """A function whose slope is known from its value y and its argument a."""

    def lifted(lifter: _Lifter, argument: sp.Expr) -> sp.Expr:
        return lifter.unknown(
            function(argument),
            prefix,
            lambda y: slope(lifter, y, argument) * lifter.derivative(argument),
        )

    return lifted


_RATIOS: dict[str, Callable[..., sp.Expr]] = {
    "sec": lambda a: 1 / sp.cos(a),
    "csc": lambda a: 1 / sp.sin(a),
    "cot": lambda a: sp.cos(a) / sp.sin(a),
    "sech": lambda a: 1 / sp.cosh(a),
    "csch": lambda a: 1 / sp.sinh(a),
    "coth": lambda a: sp.cosh(a) / sp.sinh(a),
    "erfc": lambda a: 1 - sp.erf(a),
}
_RULES: dict[str, Callable[[_Lifter, sp.Expr], sp.Expr]] = {
    "exp": lambda lifter, a: lifter.exponential(a),
    "sin": lambda lifter, a: lifter.circular(a, sp.sin, -1),
    "cos": lambda lifter, a: lifter.circular(a, sp.cos, -1),
    "sinh": lambda lifter, a: lifter.circular(a, sp.sinh, 1),
    "cosh": lambda lifter, a: lifter.circular(a, sp.cosh, 1),
    "tan": _rule(sp.tan, "t", lambda lifter, y, a: 1 + y**2),
    "tanh": _rule(sp.tanh, "t", lambda lifter, y, a: 1 - y**2),
    "log": _rule(sp.log, "l", lambda lifter, y, a: lifter._root(a, 1)),
    "atan": _rule(sp.atan, "a", lambda lifter, y, a: lifter._root(1 + a**2, 1)),
    "asinh": _rule(sp.asinh, "a", lambda lifter, y, a: lifter._root(1 + a**2, 2)),
    "asin": _rule(sp.asin, "a", lambda lifter, y, a: lifter._root(1 - a**2, 2)),
    "acos": _rule(sp.acos, "a", lambda lifter, y, a: -lifter._root(1 - a**2, 2)),
    "erf": _rule(
        sp.erf, "g", lambda lifter, y, a: 2 / sp.sqrt(sp.pi) * lifter.polynomial(sp.exp(-(a**2)))
    ),
}
"""How functions are lifted, by name."""
