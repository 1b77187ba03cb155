"""Full trajectories of fields: sparse steps, compressed as they come."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
import scipy.sparse as ss

from rankone.support.tasks import open_pool
from rankone.trajectories.fields.field_factors import factorisation_of
from rankone.trajectories.fields.field_steps import EndsEarlyError
from rankone.trajectories.fields.field_system import (
    FieldSystem,
    LinearTerm,
    PointwiseTerm,
    SourceTerm,
    Unknown,
)
from rankone.trajectories.fields.field_trajectories import (
    Compression,
    FieldIntegration,
    field_sizes,
    field_trajectory,
)

SOURCE = """
import numpy as np
TIMED = (2,)
def coefficients(t, p):
    (k,) = p
    return np.stack(np.broadcast_arrays(1.0, k, np.cos(t)))
def g0(t, z, p):
    return z[0] ** 2
def g0_slopes(t, z, p):
    return np.stack([2 * z[0]])
def initial_coefficients(p):
    return np.ones((1, *p.shape[1:]))
"""


def second_differences(n):
    return ss.csr_array(ss.diags_array([1.0, -2, 1], offsets=[-1, 0, 1], shape=(n, n))) * n**2


def system(n=40, growth=0.0, mass=None, horizon=(0.0, 0.5)):
    """Diffusion with a moving source, and with growth u**2."""
    x = np.linspace(0, np.pi, n)
    identity = ss.csr_array(ss.eye_array(n))
    square = PointwiseTerm(0, identity * growth, (identity,), np.zeros((0, n)), "g0")
    return FieldSystem(
        unknowns=(Unknown("u", 0, n),),
        parameters=("k",),
        box=((0.1, 1.0),),
        horizon=horizon,
        linear=(LinearTerm(1, second_differences(n) * 1e-2),),
        sources=(SourceTerm(2, x),),
        pointwise=(square,) if growth else (),
        initial_vectors=np.sin(x)[:, None],
        source=SOURCE,
        mass=mass,
    )


def reference(fields, point, times, mass=None):
    own = fields.at(point)
    inverse = np.eye(fields.size) if mass is None else np.linalg.inv(mass.toarray())
    solved = scipy.integrate.solve_ivp(
        lambda t, u: inverse @ own.force(t, u),
        fields.horizon,
        fields.initial(point),
        method="Radau",
        rtol=1e-10,
        atol=1e-12,
        t_eval=times,
    )
    return solved.y


@pytest.mark.parametrize("growth", [0.0, 0.3])
def test_trajectories_are_those_of_scipy(growth):
    fields, point = system(growth=growth), np.array([0.7])
    sizes = field_sizes(fields, point[None])
    trajectory = field_trajectory(fields, point, sizes, 1e-8, 1e-7)
    exact = reference(fields, point, trajectory.times)
    assert np.abs(trajectory.states[0].at(slice(None)) - exact).max() < 2e-6 * sizes[0]
    assert np.isclose(trajectory.largest[0], np.abs(exact).max(), rtol=1e-6)
    assert np.isclose(sizes[0], trajectory.largest[0], rtol=0.02)
    for values in trajectory.pointwise:
        assert np.abs(values.at(slice(None)) - exact**2).max() < 1e-5


def test_asked_times_in_place_of_steps():
    fields, point = system(), np.array([0.3])
    times = np.array([0.0, 0.011, 0.2, 0.5])
    trajectory = field_trajectory(fields, point, np.ones(1), 1e-8, 1e-8, times)
    assert (trajectory.times == times).all()
    exact = reference(fields, point, times)
    assert np.abs(trajectory.states[0].at(slice(None)) - exact).max() < 1e-5


def test_a_mass_matrix_stands_before_the_rates():
    n = 30
    mass = ss.csr_array(ss.diags_array([1.0, 4, 1], offsets=[-1, 0, 1], shape=(n, n))) / 6
    fields, point = system(n, mass=mass), np.array([0.5])
    trajectory = field_trajectory(fields, point, np.ones(1), 1e-8, 1e-8)
    exact = reference(fields, point, trajectory.times, mass)
    assert np.abs(trajectory.states[0].at(slice(None)) - exact).max() < 1e-5


def wave(n=30, mass=None):
    """A damped wave: positions u, and their velocities v."""
    zero, one = ss.csr_array((n, n)), ss.eye_array(n)
    stiffness = second_differences(n) * 1e-2
    moves = ss.block_array([[zero, one], [zero, 0.05 * stiffness]], format="csr")
    pulls = ss.block_array([[zero, zero], [stiffness, zero]], format="csr")
    x = np.linspace(0, np.pi, n)
    return FieldSystem(
        unknowns=(Unknown("u", 0, n), Unknown("v", n, n)),
        parameters=("k",),
        box=((0.1, 1.0),),
        horizon=(0.0, 2.0),
        linear=(LinearTerm(0, moves), LinearTerm(1, pulls)),
        sources=(SourceTerm(2, np.concatenate([0 * x, x])),),
        pointwise=(),
        initial_vectors=np.concatenate([np.sin(x), 0 * x])[:, None],
        source=SOURCE,
        mass=None if mass is None else ss.block_diag([one, mass], format="csr"),
    )


@pytest.mark.parametrize("weighed", [False, True])
def test_positions_are_eliminated_before_factors(weighed):
    n = 30
    element = ss.csr_array(ss.diags_array([1.0, 4, 1], offsets=[-1, 0, 1], shape=(n, n))) / 6
    fields, point = wave(n, element if weighed else None), np.array([0.5])
    assert fields.velocities == {0: 1}
    matrix = fields.mass if weighed else ss.eye_array(2 * n)
    matrix = ss.csc_array(matrix - 0.1 * fields.at(point).jacobian(0.0, np.zeros(2 * n)))
    right = np.random.default_rng(0).standard_normal(2 * n)
    solution = factorisation_of(fields).of(matrix).solve(right)
    assert np.abs(matrix @ solution - right).max() < 1e-10
    trajectory = field_trajectory(fields, point, np.ones(2), 1e-8, 1e-8)
    exact = reference(fields, point, trajectory.times, fields.mass)
    states = np.concatenate([states.at(slice(None)) for states in trajectory.states])
    assert np.abs(states - exact).max() < 1e-5


def test_velocities_are_rates_and_nothing_else():
    fields = wave(5)
    assert system().velocities == {}
    motion, _ = fields.linear
    pushed = replace(fields, sources=(SourceTerm(0, np.ones(10)),))
    assert pushed.velocities == {}
    both = ss.csr_array(motion.matrix + ss.eye_array(10, k=-5))
    assert replace(fields, linear=(LinearTerm(1, both),)).velocities == {0: 1}
    assert replace(fields, linear=(LinearTerm(1, ss.csr_array(motion.matrix.T)),)).velocities == {}
    turning = ss.csr_array(ss.eye_array(10, k=5) - ss.eye_array(10, k=-5))
    assert replace(fields, linear=(LinearTerm(0, turning),)).velocities == {0: 1}
    assert replace(fields, mass=ss.csr_array(2 * ss.eye_array(10))).velocities == {}


def test_a_blow_up_is_told_with_its_time():
    fields = system(growth=8.0)
    with pytest.raises(EndsEarlyError) as ended:
        field_trajectory(fields, np.array([0.1]), np.ones(1), 1e-6, 1e-6)
    assert 0.05 < ended.value.time < 0.5
    assert ended.value.grows


def test_jacobians_are_the_derivatives_of_rates():
    fields, point = system(growth=0.5), np.array([0.4])
    own, generator = fields.at(point), np.random.default_rng(0)
    u, direction = generator.standard_normal((2, fields.size))
    step = 1e-6
    difference = (own.force(0.2, u + step * direction) - own.force(0.2, u - step * direction)) / 2
    assert np.allclose(own.jacobian(0.2, u) @ direction, difference / step, rtol=1e-6, atol=1e-6)


def test_compressed_vectors_miss_no_entry_by_more_than_asked():
    generator = np.random.default_rng(1)
    vectors = generator.standard_normal((200, 6)) @ generator.standard_normal((6, 90))
    vectors += 1e-4 * generator.standard_normal(vectors.shape)
    for tolerance, most in ((1e-3, 6), (1e-8, 90)):
        compression = Compression(tolerance)
        for first in range(0, 90, 32):
            compression.add(vectors[:, first : first + 32])
        result = compression.result()
        assert np.abs(result.at(slice(None)) - vectors).max() <= 1.01 * tolerance
        assert result.modes.shape[1] <= most
        assert np.allclose(result.modes.T @ result.modes, np.eye(result.modes.shape[1]))


@pytest.mark.slow
def test_processes_give_the_same_bits():
    fields = system(growth=0.3)
    points = np.array([[0.2], [0.9]])
    here = FieldIntegration(fields, np.ones(1), 1e-6, 1e-6).trajectories(points)
    with open_pool(2) as pool:
        there = FieldIntegration(fields, np.ones(1), 1e-6, 1e-6, pool).trajectories(points)
    for ours, theirs in zip(here, there, strict=True):
        assert (ours.times == theirs.times).all()
        assert (ours.states[0].numbers == theirs.states[0].numbers).all()
