"""Random separated forms and points of their boxes, for property tests."""

from __future__ import annotations

import sympy as sp
from hypothesis import strategies as st

from rankone.problem.forms import SeparatedForm
from tests.compiler.codegen.systems import Separated, separated, t

COEFFICIENTS = st.sampled_from([1.0, -1.0, 2.0, -0.5, 1 / 3, 1e-5])


@st.composite
def forms(
    draw: st.DrawFn, *, max_degree: int = 5, max_states: int = 4, max_terms: int = 6
) -> SeparatedForm:
    """Systems with up to three parameters, factors of all kinds and repeated terms."""
    states = [f"s{c}" for c in range(draw(st.integers(1, max_states)))]
    parameters = sp.symbols(f"p:{draw(st.integers(0, 3))}")

    def factor(symbol: sp.Symbol) -> st.SearchStrategy[sp.Expr]:
        expressions = [symbol, symbol**2, sp.exp(-symbol), 1 / (1 + symbol), sp.sin(symbol) ** 2]
        return st.sampled_from(expressions)

    def term() -> Separated:
        dependent = [s for s in (t, *parameters) if draw(st.integers(0, 3)) == 0]
        monomial = draw(st.lists(st.sampled_from(states), max_size=max_degree))
        return draw(COEFFICIENTS), {s: draw(factor(s)) for s in dependent}, monomial

    return separated(
        {state: [term() for _ in range(draw(st.integers(0, max_terms)))] for state in states},
        dict.fromkeys(parameters, (0.5, 2.0)),
    )
