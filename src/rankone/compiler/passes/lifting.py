"""Lifting: functions of the unknowns become unknowns themselves, with equations of their own.

``sin(theta)`` in a right-hand side becomes ``s`` with ``s' = c*theta'``, ``c' = -s*theta'``: the
system is polynomial then, and exactly the same. Coefficients that couple coordinates, such as
``cos(w*t)`` and ``1/(k1 + k2)``, are lifted in the same way. Compare the quadratisation of QBee
(Bychkov & Pogudin, "Optimal monomial quadratization for ODE systems", 2021) and polynomialisation
in BioCham (Hemery, Fages & Soliman, 2020).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import sympy as sp
from sympy.core.relational import Relational

from rankone.compiler.passes.first_order import FirstOrderSystem
from rankone.compiler.passes.splitting import Indivisible, Splitter
from rankone.problem.expressions.notation import exact, text_of
from rankone.problem.forms import Jump, State
from rankone.solvers.outcome import Role
from rankone.support.arrays import MANY_STATES
from rankone.support.budget import check_time
from rankone.support.errors import count

# Roots up to this are lifted as powers of one, z = b**(-1/q) with z' = -z**(q + 1) b'/q: the degree
# of z' grows with q
_MOST_ROOT = 3


class NotLiftable(Exception):
    """An expression has no lifted form."""

    def __init__(self, expression: sp.Expr) -> None:
        super().__init__(expression)
        self.expression = expression


@dataclass(frozen=True)
class Lifting:
    """A system with further unknowns, after the original ones, and what they stand for.

    Meanings are expressions of the original states. Invariants are expressions of all states that
    vanish along every trajectory.
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

    NotLiftable names a function that has no lifted form: an absolute value, a table, a function of
    the user.
    """
    return _Lifter(system).lift()


class _Lifter:
    """The working state: what was lifted so far, and the rates of all states."""

    def __init__(self, system: FirstOrderSystem) -> None:
        self.system = system
        self.time = system.coordinates[0].symbol
        self.names = {s.name for s in system.states} | {c.name for c in system.coordinates}
        self.original = [sp.Symbol(state.name, real=True) for state in system.states]
        self.plain = dict(zip(system.functions, self.original, strict=True))
        self.states = set(self.original)  # lifted ones, too
        self.splitter = Splitter(system.coordinates, self.original)
        self.lifted: dict[sp.Expr, sp.Symbol] = {}  # meanings and the states that stand for them
        self.rates: list[sp.Expr] = []  # polynomials: of the original states, then the lifted
        self.invariants: list[sp.Expr] = []
        self.reciprocals: list[tuple[sp.Symbol, sp.Expr]] = []
        self.waiting: list[Callable[[], sp.Expr]] = []

    def _starts(self, start: Mapping[sp.Expr, sp.Expr]) -> Iterator[sp.Expr]:
        """Initial values of lifted states; where the start is at rest they come with it."""
        at_rest = self.system.rest is not None
        for meaning in self.lifted:
            yield sp.S.One if at_rest else meaning.subs(start, simultaneous=True)

    def lift(self) -> Lifting:
        """Lift until every rate is polynomial."""
        system = self.system
        functions = {symbol: u for u, symbol in self.plain.items()}
        try:
            rates = [f.xreplace(self.plain) for f in system.rhs]
            self._check(rates)
            polynomials = [self.polynomial(rate) for rate in rates]
            self.rates = [self.reduced(rate) for rate in polynomials]
            while self.waiting:
                self.rates.append(self.reduced(self.waiting.pop(0)()))
        except NotLiftable as error:
            raise NotLiftable(error.expression.xreplace(functions)) from None
        functions |= {s: sp.Function(s.name)(self.time) for s in self.lifted.values()}
        start = dict(zip(self.original, system.initial, strict=True))
        start[self.time] = exact(sp.Float(system.coordinates[0].lower))
        lifted = [functions[symbol] for symbol in self.lifted.values()]
        states = [State(u.func.__name__, u, Role.LIFTED) for u in lifted]
        return Lifting(
            replace(
                system,
                states=(*system.states, *states),
                functions=(*system.functions, *lifted),
                rhs=tuple(rate.xreplace(functions) for rate in self.rates),
                initial=(*system.initial, *self._starts(start)),
                origins=(*system.origins, *(None for _ in lifted)),
                jumps=tuple(self._jumped(jump, functions) for jump in system.jumps),
            ),
            tuple(meaning.xreplace(functions) for meaning in self.lifted),
            tuple(invariant.xreplace(functions) for invariant in self.invariants),
        )

    def _jumped(self, jump: Jump, functions: Mapping[sp.Symbol, sp.Expr]) -> Jump:
        """The same jump; after it lifted states are again what they stand for."""
        values_after = (v.xreplace(self.plain) for v in jump.values)
        after = {s: v for s, v in zip(self.original, values_after, strict=True) if s != v}
        at: dict[sp.Symbol, sp.Expr] = {**after, self.time: exact(sp.Float(jump.time))}
        lifted = [
            meaning.subs(at, simultaneous=True) if meaning.free_symbols & set(after) else state
            for meaning, state in self.lifted.items()
        ]
        return Jump(jump.time, (*jump.values, *(v.xreplace(functions) for v in lifted)))

    def _check(self, rates: Sequence[sp.Expr]) -> None:
        """Raise NotLiftable for a function without a rule, the innermost one."""
        liftable = {*_RULES, *_RATIOS, "Pow"}
        for rate in rates:
            for node in sp.postorder_traversal(rate):
                function = isinstance(node, sp.Function | sp.Piecewise | Relational)
                if function and type(node).__name__ not in liftable and not self._separates(node):
                    raise NotLiftable(node)

    def polynomial(self, expression: sp.Expr) -> sp.Expr:
        """The expression as a polynomial of states, lifted ones included."""
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
        """The rate as a polynomial of lower degree, by ``r*base = 1`` of the reciprocals r.

        The leading monomial of r*base is replaced: x/(c + x) = 1 - c*r.
        """
        states = [*self.original, *self.lifted.values()]
        gens = [state for state in states if state in rate.free_symbols]
        if not self.reciprocals or not gens:
            return rate
        terms = _terms(rate, gens)
        rules = [rule for r, base in self.reciprocals if (rule := _rule_of(r, base, gens))]
        done: dict[tuple[int, ...], sp.Expr] = {}
        waiting = list(terms.items())
        while waiting:
            check_time()
            monomial, coefficient = waiting.pop()
            for leading, replacement in rules:
                if all(m >= power for m, power in zip(monomial, leading, strict=True)):
                    quotient = [m - power for m, power in zip(monomial, leading, strict=True)]
                    waiting += [
                        (tuple(a + b for a, b in zip(quotient, m, strict=True)), coefficient * c)
                        for m, c in replacement.items()
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

    def _varies(self, expression: sp.Expr) -> bool:
        """Whether there are states in an expression."""
        return not self.states.isdisjoint(expression.free_symbols)

    def derivative(self, expression: sp.Expr) -> sp.Expr:
        """The derivative over time along trajectories, a polynomial of states."""
        terms = [self.polynomial(expression.diff(self.time))]
        for state, rate in zip(self.original, self.rates, strict=False):
            slope = expression.diff(state)
            if slope != 0:
                terms.append(self.polynomial(slope) * rate)
        return sp.Add(*terms)

    def unknown(self, meaning: sp.Expr, prefix: str, rate: Callable[[sp.Expr], sp.Expr]) -> sp.Expr:
        """The state that stands for an expression; ``rate`` gives its rate from the state."""
        if meaning not in self.lifted:
            if len(self.lifted) == MANY_STATES:
                raise NotLiftable(meaning)
            name, suffix = prefix, 1
            while name in self.names:
                suffix += 1
                name = f"{prefix}{suffix}"
            self.names.add(name)
            state = sp.Symbol(name, real=True)
            self.lifted[meaning] = state
            self.states.add(state)
            self.waiting.append(lambda: rate(state))
        return self.lifted[meaning]

    def _power(self, base: sp.Expr, exponent: sp.Expr) -> sp.Expr:
        if self._varies(exponent) or self.time in exponent.free_symbols:
            return self.polynomial(sp.exp(exponent * sp.log(base)))
        if base.is_number:
            return self.exponential(exponent * sp.log(base))
        if exponent.is_Rational and exponent.q <= _MOST_ROOT:
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
        """A product; a reciprocal in it may saturate with another factor."""
        for factor in product.args:
            base, exponent = factor.as_base_exp()
            if exponent == -1:
                saturating = self._saturating(product / factor, base)
                if saturating is not None:
                    return saturating
        powers = [factor for factor in product.args if self._is_general_power(factor)]
        if len(powers) < 2:
            return sp.Mul(*map(self.polynomial, product.args))
        bases = [power.as_base_exp() for power in powers]
        state = self.unknown(
            sp.Mul(*powers),
            "p",
            lambda y: y * sp.Add(*(e * self._root(b, 1) * self.derivative(b) for b, e in bases)),
        )
        return state * self.polynomial(product / sp.Mul(*powers))

    def _is_general_power(self, factor: sp.Expr) -> bool:
        """Whether a power becomes an unknown of its own: no integer power, and no small root."""
        base, exponent = factor.as_base_exp()
        fixed = not self._varies(exponent) and self.time not in exponent.free_symbols
        rooted = exponent.is_Rational and exponent.q <= _MOST_ROOT
        return bool(factor.is_Pow and self._varies(base) and fixed and not rooted)

    def _saturating(self, factor: sp.Expr, base: sp.Expr) -> sp.Expr | None:
        """``factor/(a + m)``, a fixed, m an exponential or a power: a logistic or Hill function.

        With r = a/(a + m), m/(a + m) is 1 - r, and r' = -r*(1 - r)*(log m)', without m itself.
        """
        terms = [p for p in sp.Add.make_args(base) if self._varies(p) or p.has(self.time)]
        fixed = base - sp.Add(*terms)
        if len(terms) != 1 or fixed == 0:
            return None
        (m,) = terms
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
        """The derivative of ``exponent*log(base)``; the base or the exponent is fixed."""
        if base is sp.E:
            return self.derivative(exponent)
        return exponent * self._root(base, 1) * self.derivative(base)

    def exponential(self, argument: sp.Expr) -> sp.Expr:
        """``exp(argument)``; terms of one coordinate are a factor of their own."""
        mixed_terms: list[sp.Expr] = []
        single_terms: list[sp.Expr] = []
        for term in sp.Add.make_args(sp.expand_mul(argument)):
            single = len(term.free_symbols) < 2 and not self._varies(term)
            (single_terms if single else mixed_terms).append(term)
        mixed = sp.Add(*mixed_terms)
        lifted = self.unknown(sp.exp(mixed), "e", lambda y: y * self.derivative(mixed))
        return sp.exp(sp.Add(*single_terms)) * lifted

    def circular(self, argument: sp.Expr, function: type, sign: int) -> sp.Expr:
        """Sine or cosine, or a hyperbolic one; they are lifted in pairs."""
        sine, cosine = (sp.sin, sp.cos) if sign < 0 else (sp.sinh, sp.cosh)
        is_first = sine(argument) not in self.lifted
        c = self.unknown(cosine(argument), "c", lambda _: sign * s * self.derivative(argument))
        s = self.unknown(sine(argument), "s", lambda _: c * self.derivative(argument))
        if is_first:
            self.invariants.append(c**2 - sign * s**2 - 1)
        return s if function is sine else c


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
    """The leading monomial of r*base, and what replaces it by r*base = 1; None if no gain."""
    if r not in gens or not base.is_polynomial(*gens):
        return None
    terms = {m: c for m, c in _terms(r * base, gens).items() if c != 0}
    leading = max(terms, key=lambda monomial: (sum(monomial), monomial))
    coefficient = terms.pop(leading)
    if not coefficient.is_number or sum(leading) < 2:
        return None
    constant = (0,) * len(gens)
    replacement = {monomial: -c / coefficient for monomial, c in terms.items()}
    replacement[constant] = replacement.get(constant, sp.S.Zero) + 1 / coefficient
    return leading, replacement


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
# How functions are lifted, by name
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
