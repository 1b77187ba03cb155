"""Right Radau collocation."""

import numpy as np
import pytest

from rankone.tensors import RadauCollocation, legendre_values


@pytest.mark.parametrize("count", [1, 2, 3, 9, 16])
def test_polynomials_of_degree_k_are_differentiated_exactly(count):
    radau = RadauCollocation.of(count)
    derivative = radau.derivative @ radau.nodes**count - radau.start * 0.0
    np.testing.assert_allclose(derivative, count * radau.nodes ** (count - 1), atol=1e-10)
    assert radau.nodes[-1] == 1.0
    np.testing.assert_allclose(radau.derivative.sum(axis=1), radau.start, atol=1e-10)


def test_three_stages_are_the_nodes_of_radau_iia():
    expected = [(4 - np.sqrt(6)) / 10, (4 + np.sqrt(6)) / 10, 1.0]
    np.testing.assert_allclose(RadauCollocation.of(3).nodes, expected, rtol=1e-14)


@pytest.mark.parametrize("count", [2, 3])
def test_end_value_converges_with_order_2k_minus_1(count):
    radau = RadauCollocation.of(count)

    def end_error(steps):
        h, u = 1.0 / steps, 1.0
        for _ in range(steps):
            u = np.linalg.solve(radau.derivative + h * np.eye(count), radau.start * u)[-1]
        return abs(u - np.exp(-1.0))

    order = np.log2(end_error(4) / end_error(8))
    assert order == pytest.approx(2 * count - 1, abs=0.25)


def test_modal_coefficients_reproduce_the_polynomial():
    radau = RadauCollocation.of(6)
    points = np.concatenate([[0.0], radau.nodes])
    coefficients = radau.to_modal @ np.exp(points)
    s = np.linspace(0.0, 1.0, 30)
    np.testing.assert_allclose(legendre_values(2 * s - 1, 7) @ coefficients, np.exp(s), atol=1e-7)


def test_times_stay_inside_the_slab():
    times = RadauCollocation.of(5).times(3.0, 0.5)
    assert times[0] > 3.0
    assert 3.5 - 1e-8 < times[-1] < 3.5
    np.testing.assert_allclose(times, 3.0 + 0.5 * RadauCollocation.of(5).nodes, atol=1e-9)
