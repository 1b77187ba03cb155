"""Networks of reactions from a stoichiometric matrix and rate laws."""

import numpy as np
import pytest
import scipy.sparse
import sympy as sp

import rankone as ro

T, K, L = sp.symbols("t k l")
BOX = {K: (1, 2), L: (0.5, 1)}


def network(n=70, reactions=140, **changed):
    """Random reactions A + B -> C and A -> B of mass action, as in a table, and their rates."""
    rng = np.random.default_rng(3)
    stoichiometry = np.zeros((n, reactions))
    for j in range(reactions):
        a, b, c = rng.choice(n, 3, replace=False)
        stoichiometry[[a, c], j] = -1, 1
        if j % 2:
            stoichiometry[b, j] = -2
    numbers = rng.uniform(0.5, 1, reactions)
    laws = [c * (K if j % 3 else L * sp.exp(-T)) for j, c in enumerate(numbers)]
    arguments = {
        "stoichiometry": scipy.sparse.csc_matrix(stoichiometry),
        "laws": laws,
        "orders": "reactants",
        "time": (T, 0, 1),
        "parameters": BOX,
        "initial": rng.uniform(0.5, 1.5, n),
    }

    def rates(t, u, k1, k2):
        constants = numbers * np.where(np.arange(reactions) % 3, k1, k2 * np.exp(-t))
        products = np.prod(u[:, None] ** np.maximum(-stoichiometry, 0), axis=0)
        return stoichiometry @ (constants * products)

    return ro.Problem.from_reactions(**(arguments | changed)), rates


def test_rates_of_mass_action_are_those_of_the_matrix():
    problem, rates = network()
    assert problem.table is not None
    system = ro.compile(problem).system
    u = np.random.default_rng(4).random(70)
    computed = system.rhs(0.3, u[:, None], np.array([[1.3], [0.7]]))[:, 0]
    np.testing.assert_allclose(computed, rates(0.3, u, 1.3, 0.7), rtol=1e-12)


def test_few_species_and_many_have_the_same_equations():
    problem, _ = network(5, 8)
    assert problem.table is None
    matrix = network(5, 8, orders=None)[0]
    assert matrix != problem
    x = [sp.Function(f"x{i}")(T) for i in range(3)]
    stoichiometry, orders = [[-1, 0], [1, -2], [0, 1]], [[1, 0], [0, 2], [0, 1]]
    arguments = {"time": (T, 0, 1), "parameters": BOX, "initial": {"x0": K}}
    by_orders = ro.Problem.from_reactions(stoichiometry, [K, L], orders=orders, **arguments)
    laws = [K * x[0], L * x[1] ** 2 * x[2]]
    assert by_orders == ro.Problem.from_reactions(stoichiometry, laws, **arguments)
    assert by_orders.initial == {x[0]: K, x[1]: 0, x[2]: 0}


def test_laws_and_powers_of_any_form():
    x = [sp.Function(name)(T) for name in "ab"]
    problem = ro.Problem.from_reactions(
        sp.Matrix([[-1, -1], [1, 0]]),
        [K * x[0] / (1 + x[0]), L],
        orders=np.array([[0, 0.5], [0, 0]]),
        time=(T, 0, 1),
        parameters=BOX,
        initial=[1, 0],
        names=["a", "b"],
    )
    expected = -K * x[0] / (1 + x[0]) - L * sp.sqrt(x[0])
    assert sp.simplify(problem.equations[0].rhs - expected) == 0
    assert ro.solve(problem, rtol=1e-3).success


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"laws": [K]}, "1 law for 140 reactions"),
        ({"laws": "k"}, "the laws are"),
        ({"laws": [[K]] * 140}, "is no number or expression"),
        ({"orders": "educts"}, "orders are"),
        ({"orders": np.ones((2, 2))}, "the matrix of orders is 2 x 2, not 70 x 140"),
        ({"stoichiometry": np.ones(3)}, "has the shape"),
        ({"stoichiometry": sp.Matrix([[K]])}, "entries that are no numbers"),
        ({"stoichiometry": np.full((70, 140), np.inf)}, "not finite"),
        ({"initial": [1, 2]}, "initial is"),
        ({"laws": [sp.Symbol("z")] * 140}, "unknown symbol `z`"),
        ({"names": ["x"]}, "names are"),
    ],
)
def test_what_does_not_fit_is_refused(changed, message):
    with pytest.raises(ro.ProblemError, match=message):
        network(**changed)
