"""Splitting an expression into products of functions of one coordinate.

Sums and products are multiplied out only as far as coordinates and states are mixed. A function of
a single coordinate stays as the user wrote it, but for a number in front: multiplied out,
``exp(-(t - 5)**2)`` would overflow and ``(t - 5)**20`` would lose all digits. Only sums of
monomials are distributed, so that like terms meet. Nothing is ever simplified, and the time is
polynomial in the number of terms.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from typing import Literal, NamedTuple

import sympy as sp
from sympy.polys.rings import sring

from rankone.problem.expressions.admissible import largest, sign
from rankone.problem.expressions.notation import exact
from rankone.problem.forms import Coordinate
from rankone.support.budget import check_time

Powers = tuple[tuple[int, int], ...]
"""(state, exponent), ascending; negative exponents may occur on the way."""


class Monomial(NamedTuple):
    """A product of one function for each coordinate and a monomial in the states."""

    factors: tuple[sp.Expr, ...]
    """For each dimension a function of its coordinate; 1 if the product has none."""
    powers: Powers


class MonomialSum(dict[Monomial, sp.Expr]):
    """Monomials with their coefficients: exact numbers, none of them zero.

    Like monomials merge; their order is that in which they came first.
    """

    @classmethod
    def of(cls, terms: Iterable[tuple[Monomial, sp.Expr]]) -> MonomialSum:
        """Add up coefficients times monomials."""
        coefficients: dict[Monomial, sp.Expr] = {}
        for monomial, c in terms:
            coefficients[monomial] = coefficients[monomial] + c if monomial in coefficients else c
        return cls((monomial, c) for monomial, c in coefficients.items() if c != 0)

    @classmethod
    def total(cls, sums: Iterable[MonomialSum]) -> MonomialSum:
        """Add sums."""
        return cls.of(term for terms in sums for term in terms.items())

    def times(
        self, factor: MonomialSum, product: Callable[[sp.Expr, sp.Expr], tuple[sp.Expr, sp.Expr]]
    ) -> MonomialSum:
        """Multiply out; ``product`` multiplies two functions and returns (number, function)."""
        terms = []
        for a, a_coefficient in self.items():
            for b, b_coefficient in factor.items():
                coefficient = a_coefficient * b_coefficient
                functions = []
                for f, g in zip(a.factors, b.factors, strict=True):
                    scale, fg = product(f, g)
                    coefficient *= scale
                    functions.append(fg)
                powers = _times(a.powers, b.powers)
                terms.append((Monomial(tuple(functions), powers), coefficient))
        return MonomialSum.of(terms)


def _times(a: Powers, b: Powers) -> Powers:
    """Multiply two monomials in the states."""
    if not a or not b:
        return a or b
    powers = dict(a)
    for state, exponent in b:
        powers[state] = powers.get(state, 0) + exponent
    return tuple(sorted((state, exponent) for state, exponent in powers.items() if exponent))


# Addition theorems f(a + b) = sum of sign g(a) h(b), as (g, h, sign)
_ADDITION = {
    sp.sin: ((sp.sin, sp.cos, 1), (sp.cos, sp.sin, 1)),
    sp.cos: ((sp.cos, sp.cos, 1), (sp.sin, sp.sin, -1)),
    sp.sinh: ((sp.sinh, sp.cosh, 1), (sp.cosh, sp.sinh, 1)),
    sp.cosh: ((sp.cosh, sp.cosh, 1), (sp.sinh, sp.sinh, 1)),
}
_LARGE_EXPONENT = 30  # Larger ones are counted from their largest value: no factor overflows
_MOST_FACTORED_POWER = 20  # SymPy factors sums of such powers in no time, of higher ones in minutes
# Numbers up to this, and down to its reciprocal, are pulled out of factors
_ORDINARY_RATIO = sp.Integer(10) ** 30
AS_IT_IS = "method='cross' takes it as it is; for the other methods"
"""What to do about a term that does not separate; what the other methods need follows."""
FURTHER_UNKNOWN = (
    "make the function a further unknown with an equation of its own, "
    "such as s = sin(x) with s' = cos(x) x'"
)
"""What they need where a term is not polynomial."""
_MOST_TERMS = 1500  # Products from two multiplied sums: each takes some milliseconds to compile
_MOST_MULTIPLIED_POWER = 64  # Highest power of a mixed expression that is multiplied out

Reason = Literal["couples", "not polynomial", "not real", "out of range", "too many terms"]


class Indivisible(Exception):
    """An expression cannot be split: the smallest one that cannot, and why."""

    def __init__(self, expression: sp.Expr, reason: Reason) -> None:
        super().__init__(expression, reason)
        self.expression = expression
        self.reason: Reason = reason


class _TooManyTerms(Exception):
    """A product has too many terms when it is multiplied out."""


class Splitter:
    """Splits expressions over coordinates and states, for which plain symbols stand.

    Intervals decide the signs under roots: sqrt(k*m) is sqrt(k)*sqrt(m) for positive k and m.
    """

    def __init__(self, coordinates: Sequence[Coordinate], states: Sequence[sp.Symbol]) -> None:
        self._coordinates = tuple(coordinates)
        self._dimension = {c.symbol: i for i, c in enumerate(coordinates)}
        self._state = {symbol: i for i, symbol in enumerate(states)}
        self._one = Monomial((sp.S.One,) * len(self._coordinates), ())
        self._normal: dict[sp.Expr, tuple[sp.Expr, sp.Expr]] = {}
        self._times: dict[tuple[sp.Expr, sp.Expr], tuple[sp.Expr, sp.Expr]] = {}

    def split(self, expression: sp.Expr) -> MonomialSum:
        """Return an expression as a sum of separated products, or raise Indivisible."""
        try:
            return self._split(expression)
        except _TooManyTerms:
            raise Indivisible(expression, "too many terms") from None

    def _split(self, expression: sp.Expr) -> MonomialSum:
        """Tell the kinds of expressions apart."""
        check_time()
        if expression.is_Symbol:
            if expression in self._state:
                state = Monomial(self._one.factors, ((self._state[expression], 1),))
                return MonomialSum({state: sp.S.One})
            return self._function(expression, self._dimension[expression])
        if expression.is_Add:
            return MonomialSum.total(map(self.split, expression.args))
        if expression.is_Mul:
            return self._split_product(expression)
        symbols = expression.free_symbols
        if not symbols:
            return self._number(exact(expression))
        dimension = self._only_dimension(symbols)
        if dimension is not None:
            return self._function(expression, dimension)
        if isinstance(expression, sp.exp):
            return self._split_exponential(sp.S.Exp1, expression.exp, expression)
        if expression.is_Pow:
            return self._split_power(expression)
        return self._split_function(expression)

    def _split_product(self, expression: sp.Expr) -> MonomialSum:
        """Multiply out, after collecting what depends on the same coordinate alone."""
        constants: list[sp.Expr] = []
        functions: dict[int, list[sp.Expr]] = {}
        mixed: list[sp.Expr] = []
        for factor in expression.args:
            symbols = factor.free_symbols
            dimension = self._only_dimension(symbols)
            if not symbols:
                constants.append(factor)
            elif dimension is not None:
                functions.setdefault(dimension, []).append(factor)
            else:
                mixed.append(factor)
        sums = [self._number(exact(sp.Mul(*constants)))]
        for dimension, factors in functions.items():
            symbol = self._coordinates[dimension].symbol
            if all(_is_sum_of_monomials(factor, symbol) for factor in factors):
                sums += map(self.split, factors)
            else:
                sums.append(self._function(sp.Mul(*factors), dimension))
        return self._product(*sums, *map(self.split, mixed))

    def _product(self, *sums: MonomialSum) -> MonomialSum:
        product, *factors = sums
        for factor in factors:
            if len(product) * len(factor) > _MOST_TERMS:
                raise _TooManyTerms
            product = product.times(factor, self._product_of)
        return product

    def _number(self, number: sp.Expr) -> MonomialSum:
        return MonomialSum.of([(self._one, number)])

    def _product_of(self, f: sp.Expr, g: sp.Expr) -> tuple[sp.Expr, sp.Expr]:
        """Return the product of two factors as (number, normal factor)."""
        if f is sp.S.One:
            return sp.S.One, g
        if g is sp.S.One:
            return sp.S.One, f
        if (f, g) not in self._times:
            self._times[f, g] = self._normalise(f * g)
        return self._times[f, g]

    def _only_dimension(self, symbols: set[sp.Symbol]) -> int | None:
        """Return the dimension if there is exactly one coordinate and no state."""
        if len(symbols) != 1:
            return None
        return self._dimension.get(next(iter(symbols)))

    def _function(self, expression: sp.Expr, dimension: int) -> MonomialSum:
        """Return a function of one coordinate as a sum with one product."""
        coefficient, factor = self._normalise(expression)
        factors = list(self._one.factors)
        factors[dimension] = factor
        return MonomialSum.of([(Monomial(tuple(factors), ()), coefficient)])

    def _normalise(self, expression: sp.Expr) -> tuple[sp.Expr, sp.Expr]:
        """Pull out numbers, so that equal factors look equal: 1/(2*k + 2) is 1/(k + 1) / 2.

        The number of (k/310.15)**125 stays: together they are a power of a number near one.
        """
        if expression not in self._normal:
            coefficient, cofactor = expression.as_coeff_Mul()
            coefficient = exact(coefficient)
            factors = []
            for factor in sp.Mul.make_args(cofactor):
                if not factor.free_symbols:
                    coefficient *= exact(factor)
                    continue
                base, exponent = factor.as_base_exp()
                if base.is_Add and exponent.is_Integer:
                    leading, base = _monic(base)
                    coefficient *= leading**exponent
                    factor = base**exponent
                factors.append(factor)
            is_ordinary = 1 / _ORDINARY_RATIO <= abs(coefficient) <= _ORDINARY_RATIO
            self._normal[expression] = (
                (coefficient, sp.Mul(*factors)) if is_ordinary else (sp.S.One, expression)
            )
        return self._normal[expression]

    def _split_power(self, expression: sp.Expr) -> MonomialSum:
        base, exponent = expression.as_base_exp()
        exponent = exact(exponent)
        if exponent.free_symbols:
            if base.free_symbols:
                raise self._indivisible(expression)
            return self._split_exponential(base, exponent, expression)
        if exponent.is_Integer and exponent > _MOST_MULTIPLIED_POWER:
            raise _TooManyTerms
        if exponent.is_Integer and exponent > 0:
            return self._product(*[self.split(base)] * int(exponent))
        coefficient, product = self._single(base, expression)
        if not exponent.is_Integer:
            coefficient, product = self._positive(coefficient, product, expression)
        factors = []
        coefficient **= exponent
        for factor in product.factors:
            scale, normal = self._normalise(factor**exponent)
            coefficient *= scale
            factors.append(normal)
        powers = tuple((state, power * exponent) for state, power in product.powers)
        if not all(power.is_Integer for _, power in powers):
            raise Indivisible(expression, "not polynomial")
        integer = tuple((state, int(power)) for state, power in powers)
        return MonomialSum.of([(Monomial(tuple(factors), integer), coefficient)])

    def _split_exponential(self, base: sp.Expr, exponent: sp.Expr, whole: sp.Expr) -> MonomialSum:
        """base**(a(t) + b(k) + c) = base**c base**a(t) base**b(k).

        Large exponents are counted from their largest value, so that no factor overflows.
        """
        constant, exponents = self._by_coordinate(exponent, whole)
        functions = []
        for dimension, summand in exponents.items():
            top = largest(summand, self._coordinates[dimension])
            offset = sp.Integer(round(top)) if abs(top) > _LARGE_EXPONENT else sp.S.Zero
            functions.append(self._function(base ** (summand - offset), dimension))
            constant += offset
        return self._product(self._number(base**constant), *functions)

    def _single(self, expression: sp.Expr, whole: sp.Expr) -> tuple[sp.Expr, Monomial]:
        """Return an expression as one (number, product), factoring it if need be."""
        terms = self.split(expression)
        if len(terms) > 1:
            powers = (p.exp for p in expression.atoms(sp.Pow) if p.exp.is_Integer)
            if max(map(abs, powers), default=0) > _MOST_FACTORED_POWER:
                raise self._indivisible(whole)
            written = exact(expression)
            if _degree(written) > _MOST_FACTORED_POWER:
                raise self._indivisible(whole)
            factored = sp.factor(written)
            if factored.is_Add:
                raise self._indivisible(whole)
            sums = []
            for factor in sp.Mul.make_args(factored):
                base, _ = factor.as_base_exp()
                dimension = self._only_dimension(base.free_symbols)
                if dimension is not None:
                    sums.append(self._function(factor, dimension))
                elif base.is_Add:
                    raise self._indivisible(whole)
                else:
                    sums.append(self.split(factor))
            terms = self._product(*sums)
        if len(terms) != 1:
            raise self._indivisible(whole)
        ((product, coefficient),) = terms.items()
        return coefficient, product

    def _positive(
        self, coefficient: sp.Expr, product: Monomial, whole: sp.Expr
    ) -> tuple[sp.Expr, Monomial]:
        """Flip signs so that every factor is nonnegative on its interval."""
        if product.powers:
            raise Indivisible(whole, "not polynomial")
        factors = []
        for factor, coordinate in zip(product.factors, self._coordinates, strict=True):
            direction = sign(factor, coordinate)
            coefficient *= direction
            factors.append(factor if direction > 0 else -factor)
        if not coefficient > 0:
            raise Indivisible(whole, "not real")
        return coefficient, Monomial(tuple(factors), ())

    def _split_function(self, expression: sp.Expr) -> MonomialSum:
        if not expression.free_symbols.isdisjoint(self._state) and not expression.is_Piecewise:
            raise Indivisible(expression, "not polynomial")
        if isinstance(expression, sp.Piecewise):
            return self._split_piecewise(expression)
        if expression.func in _ADDITION:
            constant, summands = self._by_coordinate(expression.args[0], expression)
            return self._expand_addition(expression.func, constant, list(summands.items()))
        if isinstance(expression, sp.log):
            coefficient, product = self._single(expression.args[0], expression)
            coefficient, product = self._positive(coefficient, product, expression)
            return MonomialSum.total(
                [self._number(sp.log(coefficient)), *self._each(sp.log, product)]
            )
        if isinstance(expression, sp.Abs):
            coefficient, product = self._single(expression.args[0], expression)
            return self._product(self._number(abs(coefficient)), *self._each(sp.Abs, product))
        raise self._indivisible(expression)

    def _each(self, function: Callable[[sp.Expr], sp.Expr], product: Monomial) -> list[MonomialSum]:
        """A function of each factor of a product that is not one."""
        factors = enumerate(product.factors)
        return [self._function(function(f), j) for j, f in factors if f is not sp.S.One]

    def _expand_addition(
        self,
        function: Callable[[sp.Expr], sp.Expr],
        constant: sp.Expr,
        summands: list[tuple[int, sp.Expr]],
    ) -> MonomialSum:
        """Apply the addition theorem of a function to a sum of one term for each coordinate."""
        (dimension, first), *remaining = summands
        if not remaining:
            return self._function(function(first + constant), dimension)
        terms = []
        for g, h, direction in _ADDITION[function]:
            g_first = self._function(direction * g(first), dimension)
            terms.append(self._product(g_first, self._expand_addition(h, constant, remaining)))
        return MonomialSum.total(terms)

    def _split_piecewise(self, expression: sp.Piecewise) -> MonomialSum:
        """Write a switch in one coordinate as a sum of branches times indicators."""
        symbols = sp.Tuple(*[condition for _, condition in expression.args]).free_symbols
        if not symbols.isdisjoint(self._state):
            raise Indivisible(expression, "not polynomial")
        dimension = self._only_dimension(symbols)
        if dimension is None:
            raise Indivisible(expression, "couples")
        terms = []
        zeros = [(0, condition) for _, condition in expression.args]
        total = zeros[-1][1] == sp.true
        for k, (branch, condition) in enumerate(expression.args):
            after = [(0, True)] if total else zeros[k + 1 :]  # in a gap there is no value
            indicator = sp.Piecewise(*zeros[:k], (1, condition), *after)
            terms.append(self._product(self._function(indicator, dimension), self.split(branch)))
        return MonomialSum.total(terms)

    def _by_coordinate(
        self, expression: sp.Expr, whole: sp.Expr
    ) -> tuple[sp.Expr, dict[int, sp.Expr]]:
        """Write a + b(t) + c(k) as the number a and one function for each dimension."""
        constant = sp.S.Zero
        functions: dict[int, sp.Expr] = {}
        for product, coefficient in self.split(expression).items():
            present = [i for i, factor in enumerate(product.factors) if factor is not sp.S.One]
            if product.powers:
                raise Indivisible(whole, "not polynomial")
            if len(present) > 1:
                raise Indivisible(whole, "couples")
            if present:
                function = coefficient * product.factors[present[0]]
                functions[present[0]] = functions.get(present[0], sp.S.Zero) + function
            else:
                constant += coefficient
        return constant, dict(sorted(functions.items()))

    def _indivisible(self, expression: sp.Expr) -> Indivisible:
        mixed = not expression.free_symbols.isdisjoint(self._state)
        return Indivisible(expression, "not polynomial" if mixed else "couples")


def _is_sum_of_monomials(expression: sp.Expr, symbol: sp.Symbol) -> bool:
    """Say whether an expression is a sum of numbers times powers of a symbol."""
    for term in sp.Add.make_args(expression):
        base, exponent = term.as_coeff_Mul()[1].as_base_exp()
        if base.free_symbols and not (base == symbol and exponent.is_Integer and exponent > 0):
            return False
    return True


def _monic(base: sp.Expr) -> tuple[sp.Expr, sp.Expr]:
    """Divide a sum by the coefficient of its leading term."""
    terms = sorted(
        (term for term in base.args if term.free_symbols), key=lambda term: term.sort_key()
    )
    leading = exact(terms[-1].as_coeff_Mul()[0])
    if leading == 1 or not leading.is_Rational:
        return sp.S.One, base
    return leading, sp.Add(*[exact(term) / leading for term in base.args])


def _degree(expression: sp.Expr) -> int:
    """The largest power by which SymPy factors an expression: ``exp(100*k/3)`` is one of 100."""
    above, below = sp.fraction(sp.together(expression))
    try:
        powers = [sring(each)[1].degrees() for each in (above, below) if each.free_symbols]
    except sp.PolynomialError:
        return 0
    return max(map(int, itertools.chain(*powers)))
