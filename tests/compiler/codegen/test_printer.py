"""Expressions as NumPy text, and names as identifiers."""

from __future__ import annotations

import numpy as np
import pytest
import sympy as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from rankone.compiler.codegen.layout import Names
from rankone.compiler.codegen.printer import common_subexpressions, numpy_text
from rankone.support.errors import SeparationError

k = sp.Symbol("k", real=True)


@pytest.mark.parametrize(
    ("expression", "text"),
    [
        (k, "k"),
        (k**2, "k**2"),
        (1 / k, "1 / k"),
        (1 / k**2, "1 / k**2"),
        (-1 / k, "-1 / k"),
        (-(k**2), "-k**2"),
        ((-k) ** sp.Rational(1, 3), "(-k) ** (1 / 3)"),
        (1 / (1 + k), "1 / (k + 1)"),
        (2 * k / (3 * (1 - k)), "2 * k / (3 - 3 * k)"),
        (sp.Rational(1, 3), "1 / 3"),
        (sp.Rational(-1, 3), "-1 / 3"),
        (k / 3, "k / 3"),
        (k ** sp.Rational(1, 3), "k ** (1 / 3)"),
        (sp.sqrt(k), "np.sqrt(k)"),
        (1 / sp.sqrt(k), "1 / np.sqrt(k)"),
        (2**k, "2**k"),
        (k**-k, "k ** (-k)"),
        ((k + 1) ** 2, "(k + 1) ** 2"),
        (sp.exp(-k), "np.exp(-k)"),
        (sp.pi * k, "np.pi * k"),
        (sp.E * k, "np.e * k"),
        (sp.Float("0.1") * k, "0.1 * k"),
        (k - 1, "k - 1"),
        (1 - k, "1 - k"),
        (k - sp.exp(k), "k - np.exp(k)"),
        (sp.Abs(k), "np.abs(k)"),
        (sp.asin(k), "np.arcsin(k)"),
        (sp.Min(k, 2), "np.minimum(2, k)"),
        (sp.Heaviside(k), "np.heaviside(k, 0.5)"),
        (sp.sec(k), "1 / np.cos(k)"),
        (2 * sp.sec(k), "2 / np.cos(k)"),
        (sp.Piecewise((k, k < 1), (1, True)), "np.where(k < 1, k, 1)"),
        (2 * sp.Piecewise((k, k < 1), (1, True)), "2 * np.where(k < 1, k, 1)"),
    ],
)
def test_text(expression: sp.Expr, text: str) -> None:
    assert numpy_text(expression, {k: "k"}) == text


def expressions() -> st.SearchStrategy[sp.Expr]:
    leaves = st.sampled_from(
        [k, sp.Integer(-2), sp.Integer(3), sp.Rational(-2, 3), sp.Rational(1, 2), sp.pi]
    )
    return st.recursive(
        leaves,
        lambda inner: st.one_of(
            st.tuples(inner, inner).map(lambda ab: ab[0] + ab[1]),
            st.tuples(inner, inner).map(lambda ab: ab[0] - ab[1]),
            st.tuples(inner, inner).map(lambda ab: ab[0] * ab[1]),
            st.tuples(inner, st.sampled_from([-2, -1, 2, 3])).map(
                lambda ab: ab[0] ** ab[1] if ab[0] != 0 else ab[0]
            ),
            inner.map(lambda a: sp.sqrt(1 + a**2)),
            inner.map(lambda a: 1 / sp.cosh(a)),
            inner.map(sp.tanh),
            inner.map(sp.sin),
            inner.map(sp.Abs),
            inner.map(lambda a: sp.Piecewise((a, k < 1), (-a, True))),
            inner.map(lambda a: sp.Max(a, k, evaluate=True)),
        ),
        max_leaves=8,
    )


@pytest.mark.slow
@given(expression=expressions(), at=st.floats(0.3, 2.0))
@settings(max_examples=100)
def test_text_means_what_sympy_means(expression: sp.Expr, at: float) -> None:
    value = expression.subs(k, sp.Float(at, 30)).evalf(30)
    if not value.is_number or not value.is_finite or abs(value) > 1e12:
        return
    with np.errstate(all="ignore"):
        printed = eval(numpy_text(expression, {k: "k"}), {"np": np, "k": np.float64(at)})
    scale = 1e-6 if abs(value) < 1e6 else 1e-3  # cancellation in the printed double arithmetic
    assert printed == pytest.approx(float(value), rel=scale, abs=1e-8)


@pytest.mark.parametrize("function", [sp.lowergamma, sp.Function("g")])
def test_functions_without_numpy_counterpart_are_named(function: sp.Function) -> None:
    with pytest.raises(SeparationError, match=f"function `{function.__name__}`.*remedy"):
        numpy_text(1 + function(k, k), {k: "k"})


def test_common_subexpressions_are_named_once() -> None:
    shared, texts = common_subexpressions(
        [sp.sin(k), sp.sin(k) ** 2, k * sp.sin(k)], {k: "k"}, Names().numbered("c")
    )
    assert shared == [("c0", "np.sin(k)")]
    assert texts == ["c0", "c0**2", "c0 * k"]


@pytest.mark.parametrize(
    ("name", "identifier"),
    [
        ("k", "k"),
        ("lambda", "lambda_"),
        ("x_{0}", "x_0"),
        (r"\alpha", "alpha"),
        ("k'", "k_prime"),
        ("2a", "_2a"),
        ("μ", "μ"),
        ("ε₀", "ε0"),
        ("a b", "a_b"),
        ("{}", "symbol"),
        ("np", "np_"),
        ("l", "l_"),
    ],
)
def test_identifiers(name: str, identifier: str) -> None:
    assert Names(["np"])(name) == identifier
    assert identifier.isidentifier()


LETTERS = st.sampled_from("abλμ_019₀²{}\\^' .,-é中ſ🙂\n\x00")
"""Letters, digits and what no identifier has; some that Python takes for one another."""


@given(st.lists(st.text(LETTERS, min_size=1, max_size=5), max_size=10))
@settings(max_examples=100)
def test_identifiers_are_distinct_and_valid(labels: list[str]) -> None:
    names = Names()
    found = [names(label) for label in labels]
    assert len(set(found)) == len(found)
    assert all(name.isidentifier() for name in found)
