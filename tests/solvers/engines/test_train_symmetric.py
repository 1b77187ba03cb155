"""Packed contractions against plain einsum."""

import numpy as np
import pytest

from rankone.solvers.engines.train_sweep import left_products, multiplicity, right_products, unpack


@pytest.mark.parametrize(("r", "size", "s"), [(1, 2, 1), (3, 4, 2), (9, 3, 5), (13, 2, 17)])
def test_right_products(r, size, s):
    rng = np.random.default_rng(0)
    core, vector = rng.standard_normal((r, size, s)), rng.standard_normal(size)
    raw = rng.standard_normal((s, s, s))
    env = sum(
        np.transpose(raw, p)
        for p in [(0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)]
    )
    full = np.einsum("n,ina,jnb,cab->ijnc", vector, core, core, env)
    i, j = np.triu_indices(r)
    packed = right_products(env, core, vector)
    np.testing.assert_allclose(packed, full[i, j].reshape(i.size, size * s), atol=1e-11)
    np.testing.assert_allclose(
        unpack(packed.T, r), full.reshape(r, r, -1).transpose(2, 0, 1), atol=1e-11
    )


@pytest.mark.parametrize(("r", "size", "s"), [(1, 2, 1), (3, 4, 2), (9, 3, 5), (13, 2, 17)])
def test_left_products(r, size, s):
    rng = np.random.default_rng(1)
    core, vector = rng.standard_normal((r, size, s)), rng.standard_normal(size)
    env = rng.standard_normal((4, r, r))
    env = env + env.swapaxes(1, 2)
    full = np.einsum("n,cab,ani,bnj->cnij", vector, env, core, core)
    i, j = np.triu_indices(s)
    expected = full[:, :, i, j].reshape(4 * size, -1) * multiplicity(s)
    np.testing.assert_allclose(left_products(env, core, vector), expected, atol=1e-11)
