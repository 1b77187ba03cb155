"""Newton's method for constraints: convergence, branches, points without a solution, distances."""

import numpy as np

from rankone.trajectories.system.features import Constraints


def circle(guessed=(1,)):
    """x**2 + y**2 = p."""
    return Constraints(
        names=("equation 1",),
        guessed=guessed,
        residuals=lambda t, u, p: (u[0] ** 2 + u[1] ** 2 - p[0])[None],
        slopes=lambda t, u, p: np.array([[2 * u[0], 2 * u[1]]]),
    )


def test_guessed_states_are_found_from_far_away():
    states = np.array([[0.6, 0.6, 0.6], [1e-4, 3e3, -0.5]])
    found = circle().consistent(0.0, states, np.ones((1, 3)))
    np.testing.assert_allclose(found, [[0.6] * 3, [0.8, 0.8, -0.8]], rtol=1e-14)


def test_rounding_ends_the_iteration():
    """Terms of size one leave few digits of the last state, which is near 1e-5."""
    matrix = np.array([[4.0, 0.7, -0.3], [0.9, 4.0, 0.5], [-0.6, 0.8, 4.0]])
    solution = np.array([0.3, -0.7, 1e-5])

    def residuals(t, u, p):
        return np.einsum("ij,j...->i...", matrix, u) + 0.9 * np.cos(u[::-1]) - p

    def slopes(t, u, p):
        curved = np.zeros((3, 3, u.shape[1]))
        curved[[0, 1, 2], [2, 1, 0]] = -0.9 * np.sin(u[::-1])
        return matrix[:, :, None] + curved

    scale = 1.0 + np.linspace(0.0, 1.0, 400)
    exact = solution[:, None] * scale
    p = residuals(0.0, exact, 0.0)
    constraints = Constraints(("",) * 3, (0, 1, 2), residuals, slopes)
    found = constraints.consistent(0.0, 0.0 * exact, p)
    np.testing.assert_allclose(found, exact, rtol=1e-9)


def test_points_without_a_solution_are_not_numbers():
    found = circle().consistent(0.0, np.array([[2.0, 0.6], [1.0, 1.0]]), np.ones((1, 2)))
    assert np.isnan(found[1, 0])
    np.testing.assert_allclose(found[:, 1], [0.6, 0.8], rtol=1e-14)


def test_states_that_are_not_guessed_have_to_satisfy_the_constraints():
    """y is guessed; x**2 = 1 is left to x, which has another value."""
    both = Constraints(
        names=("equation 1", "equation 2"),
        guessed=(1,),
        residuals=lambda t, u, p: np.array([u[0] ** 2 - 1, u[1] - u[0]]),
        slopes=lambda t, u, p: np.array([[2 * u[0], 0 * u[0]], [-1 + 0 * u[0], 1 + 0 * u[0]]]),
    )
    found = both.consistent(0.0, np.array([[1.0, 2.0], [0.0, 0.0]]), np.ones((1, 2)))
    np.testing.assert_array_equal(found[1], [1.0, np.nan])


def test_distances_are_those_to_the_nearest_states():
    """From (r, 0) the nearest point of the unit circle is (1, 0), whatever the sizes are."""
    states = np.array([[1.001, 0.0], [0.0, 0.998]])
    for sizes in (np.ones(2), np.array([10.0, 0.1])):
        distances = circle().distances(np.zeros(2), states, np.ones((1, 2)), sizes)
        np.testing.assert_allclose(distances, [[1e-3, 0.0], [0.0, 2e-3]], rtol=2e-3)


def test_projected_states_satisfy_the_constraints():
    states = np.random.default_rng(0).uniform(0.5, 1.5, (2, 20))
    projected = circle().projected(np.zeros(20), states, np.ones((1, 20)))
    np.testing.assert_allclose((projected**2).sum(axis=0), 1.0, rtol=1e-14)
    direction = circle().tangential(0.0, projected[:, 0], np.ones(1), np.array([0.3, 0.7]))
    assert abs(direction @ projected[:, 0]) < 1e-14
    assert np.linalg.norm(direction) > 0.1
