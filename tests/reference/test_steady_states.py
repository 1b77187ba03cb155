"""The stated bifurcations against the Jacobian, and the branches that lead to them."""

import mpmath
import numpy as np
import pytest
import scipy.integrate

from tests.reference.steady_states import KINDS, STEADY

BIFURCATIONS = [case for case in STEADY if case.kind in KINDS]
SMOOTH = [case for case in STEADY if case.exact is not None]


def names(case):
    return case.name


def functions(case):
    """Rates and Jacobian in numbers of mpmath, of the states and all parameters by name."""
    states, symbols = list(case.system.rates), list(case.system.parameters)
    sources = [compile(rate, case.name, "eval") for rate in case.system.rates.values()]
    known = {name: getattr(mpmath, name) for name in ("exp", "sin", "sqrt")}

    def rates(u, p):
        scope = {**known, **dict(zip(states, u, strict=True)), **dict(zip(symbols, p, strict=True))}
        return [eval(source, {"__builtins__": {}}, scope) for source in sources]

    return rates


def jacobian(rates, u, p):
    """Central differences with 50 digits."""
    step, columns = mpmath.mpf("1e-20"), []
    for j in range(len(u)):
        ahead, behind = list(u), list(u)
        ahead[j] += step
        behind[j] -= step
        pairs = zip(rates(ahead, p), rates(behind, p), strict=True)
        columns.append([(a - b) / (2 * step) for a, b in pairs])
    return np.array([[float(x) for x in column] for column in columns]).T


@pytest.fixture(autouse=True)
def digits():
    with mpmath.workdps(50):
        yield


def others(case):
    """Points of the parameters that are not varied."""
    rest = {n: box for n, box in case.system.parameters.items() if n != case.parameter}
    shares = (0.0, 0.37, 1.0) if rest else (0.0,)
    return [{n: low + s * (high - low) for n, (low, high) in rest.items()} for s in shares]


def test_there_are_thirty():
    assert len({case.name for case in STEADY}) == 30
    assert {case.kind for case in STEADY} == {*KINDS, "none"}


@pytest.mark.parametrize("case", BIFURCATIONS, ids=names)
def test_the_jacobian_has_the_kind(case):
    rates = functions(case)
    for rest in others(case):
        at = {case.parameter: case.value(**rest), **rest}
        p = [mpmath.mpf(at[name]) for name in case.system.parameters]
        which = list(case.system.parameters).index(case.parameter)
        low, high = case.system.parameters[case.parameter]
        assert low < p[which] < high
        u = [mpmath.mpf(x) for x in case.critical(**at)]
        assert max(abs(x) for x in rates(u, p)) < 1e-14 * (1 + max(abs(x) for x in u))
        matrix = jacobian(rates, u, p)
        eigenvalues, right = np.linalg.eig(matrix)
        critical = np.argmin(np.abs(eigenvalues.real))
        assert abs(eigenvalues[critical].real) < 1e-7
        assert np.sum(np.abs(eigenvalues.real) < 1e-3) == (2 if case.kind == "Hopf" else 1)
        if case.kind == "Hopf":
            assert abs(eigenvalues[critical].imag) > 1e-3
            continue
        assert abs(eigenvalues[critical]) < 1e-7
        v = right[:, critical].real
        values, left = np.linalg.eig(matrix.T)
        w = left[:, np.argmin(np.abs(values))].real
        step = mpmath.mpf("1e-15")
        ahead, behind = list(p), list(p)
        ahead[which] += step
        behind[which] -= step
        pairs = zip(rates(u, ahead), rates(u, behind), strict=True)
        along = w @ np.array([float((a - b) / (2 * step)) for a, b in pairs])
        step = mpmath.mpf("1e-12")
        moved = [[x + sign * step * y for x, y in zip(u, v, strict=True)] for sign in (1, 0, -1)]
        triples = zip(*(rates(x, p) for x in moved), strict=True)
        curved = w @ np.array([float((a - 2 * b + c) / step**2) for a, b, c in triples])
        assert (abs(along) > 1e-3) == (case.kind == "fold")
        assert (abs(curved) > 1e-3) == (case.kind != "pitchfork")


def newton(rates, u, p):
    """The steady state near u, and the largest growth rate there."""
    for _ in range(30):
        step = np.linalg.solve(
            jacobian(rates, [mpmath.mpf(x) for x in u], p),
            [float(x) for x in rates([mpmath.mpf(x) for x in u], p)],
        )
        u = u - step
        if np.abs(step).max() < 1e-12:
            break
    return u, np.linalg.eigvals(jacobian(rates, [mpmath.mpf(x) for x in u], p)).real.max()


@pytest.mark.slow
@pytest.mark.parametrize("case", BIFURCATIONS, ids=names)
def test_the_branch_of_the_centre_is_stable_up_to_there_alone(case):
    """From where trajectories at the centre come to rest, to the bifurcation and the other end."""
    rates, rhs = functions(case), case.system.functions[0]
    for rest in others(case):
        low, high = case.system.parameters[case.parameter]
        value, centre = case.value(**rest), 0.5 * (low + high)
        far = low if value > centre else high

        def point(x, rest=rest):
            at = {case.parameter: x, **rest}
            return [at[name] for name in case.system.parameters]

        def rate(t, u):
            return rhs(t, u, point(centre))  # noqa: B023

        start = case.system.functions[1](point(centre))
        settled = case.settle or 1000.0
        run = scipy.integrate.solve_ivp(rate, (0, settled), start, "LSODA", rtol=1e-8, atol=1e-10)
        u, growth = newton(rates, run.y[:, -1], point(centre))
        assert np.abs(u - run.y[:, -1]).max() < 1e-4 * (1.0 + np.abs(u).max())
        assert growth < 0
        state = u
        for x in np.linspace(centre, far, 12):
            state, growth = newton(rates, state, point(x))
            assert growth < 0
        state, shares = u, 1.0 - np.geomspace(1.0, 1e-4, 60)
        for x in centre + shares * (value - centre):
            state, growth = newton(rates, state, point(x))
            assert growth < 0
        at = dict(zip(case.system.parameters, point(value), strict=True))
        assert np.abs(state - case.critical(**at)).max() < 0.05 * (1.0 + np.abs(state).max())


@pytest.mark.parametrize("case", SMOOTH, ids=names)
def test_stated_steady_states_are_at_rest(case):
    rng = np.random.default_rng(3)
    for p in rng.uniform(
        *np.array(list(case.system.parameters.values())).T, (4, len(case.system.parameters))
    ):
        u = case.exact(**dict(zip(case.system.parameters, p, strict=True)))
        rates = case.system.functions[0](0.0, u, p)
        assert np.abs(rates).max() < 1e-12
