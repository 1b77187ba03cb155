"""Fields that were solved for, against trajectories of all entries."""

import numpy as np
import pytest
import scipy.sparse as ss
import sympy as sp
from scipy.integrate import solve_ivp

import rankone as ro

N = 50
H = 1.0 / (N + 1)
X = np.linspace(H, 1.0 - H, N)
LAPLACE = ss.csr_array(ss.diags_array([1.0, -2.0, 1.0], offsets=[-1, 0, 1], shape=(N, N)) / H**2)
SOURCE = np.exp(-50.0 * (X - 0.3) ** 2)
MEAN = np.full((1, N), 1.0 / N)
u = ro.field("u", N)
TIMES = np.linspace(0.0, 0.2, 9)


@pytest.fixture(scope="module")
def solution():
    t, D, q = sp.symbols("t D q")
    rate = D * ro.apply(LAPLACE, u) + q * ro.apply(SOURCE, 1)
    box = {D: (0.5, 2.0), q: (0.5, 2.0)}
    problem = ro.Problem([sp.Eq(u.diff(t), rate)], (t, 0, 0.2), box, {u: np.sin(np.pi * X)})
    return ro.solve(problem, method="reduced", rtol=1e-4)


@pytest.fixture(scope="module")
def outputs(solution):
    quantities = {"tip": solution[u][25], "mean": ro.apply(MEAN, u)}
    return solution.output(quantities), solution.output({"energy": ro.apply(MEAN, u**2)})


@pytest.mark.slow
@pytest.mark.parametrize("point", [{"D": 0.61, "q": 1.9}, {"D": 1.7, "q": 0.55}])
def test_fields_and_outputs_are_within_their_errors(solution, outputs, point):
    def rate(_, states):
        return point["D"] * (LAPLACE @ states) + point["q"] * SOURCE

    start, options = np.sin(np.pi * X), {"rtol": 1e-9, "atol": 1e-12}
    exact = solve_ivp(rate, (0.0, 0.2), start, method="BDF", t_eval=TIMES, **options).y
    assert solution.success
    difference = np.abs(solution[u](t=TIMES, **point) - exact).max()
    assert difference <= solution.error * solution.modes.scales[0]
    linear, quadratic = outputs
    wanted = {"tip": exact[25], "mean": exact.mean(axis=0), "energy": (exact**2).mean(axis=0)}
    for output in (linear, quadratic):
        assert output.success, output.message
        for name in output.unknowns:
            wrong = np.abs(output[name](t=TIMES, **point) - wanted[name]).max()
            assert wrong <= output.errors[name] * np.abs(wanted[name]).max()


@pytest.mark.slow
def test_solved_fields_and_their_outputs_are_saved(solution, outputs, tmp_path):
    at = {"t": 0.1, "D": 1.0, "q": 1.0}
    again = ro.load(solution.save(tmp_path / "u.npz"))
    assert (again(**at) == solution(**at)).all()
    assert again.success
    assert again.history == solution.history
    for k, output in enumerate(outputs):
        again = ro.load(output.save(tmp_path / f"output_{k}.npz"))
        assert (again(**at) == output(**at)).all()
        assert again.errors == output.errors
