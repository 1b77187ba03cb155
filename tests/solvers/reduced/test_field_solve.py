"""Fields solved by their modes, against trajectories of SciPy."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as ss

from rankone.solvers.engines.engine_options import CrossOptions
from rankone.solvers.reduced.field_bases import Interpolation, Snapshots
from rankone.solvers.reduced.field_modes import FieldModes
from rankone.solvers.reduced.field_request import FieldRequest
from rankone.solvers.reduced.field_residual import FieldResidual
from rankone.solvers.reduced.field_solve import solve_fields
from rankone.solvers.reduced.reduced_system import reduced_system
from rankone.solvers.request import Domain
from rankone.tensors.evaluator import TrainEvaluator
from rankone.trajectories.fields.field_trajectories import field_trajectory
from rankone.trajectories.integrators.integrator import Spans, Tolerances, share_paths
from rankone.trajectories.integrators.single import SingleIntegrator
from rankone.trajectories.rest import from_states
from rankone.trajectories.system.verdict import Status
from tests.trajectories.fields.test_field_trajectories import reference, system, wave

ADVECTION = """
import numpy as np
TIMED = ()
def coefficients(t, p):
    (c,) = p
    return np.stack(np.broadcast_arrays(1.0 + 0.0 * t, c))
def initial_coefficients(p):
    return np.ones((1, *p.shape[1:]))
"""


def request(fields, rtol, **options):
    return FieldRequest(rtol, Domain(fields.horizon, fields.box, fields.scales), **options)


@pytest.mark.parametrize(
    ("growth", "rtol"), [(0.3, 1e-3), pytest.param(0.0, 1e-5, marks=pytest.mark.slow)]
)
def test_a_solution_is_within_the_tolerance_everywhere(growth, rtol):
    fields = system(80, growth=growth)
    solved = solve_fields(fields, request(fields, rtol))
    assert solved.verdict.status is Status.CONVERGED
    assert solved.trajectories <= 40
    assert len(solved.modes.names) < 30
    evaluator, times = TrainEvaluator(solved.outcome.slabs), np.linspace(0, 0.5, 21)
    for k in (0.1, 0.37, 0.83, 1.0):
        point = np.array([k])
        rows = slice(0, len(solved.modes.names))
        states = evaluator.curves(times[:, None], point[:, None], rows)[:, :, 0]
        error = np.abs(solved.modes.fields(states) - reference(fields, point, times)).max()
        assert error <= rtol * solved.modes.scales[0]


def test_a_mass_matrix_is_projected():
    n = 70
    mass = ss.csr_array(ss.diags_array([1.0, 4, 1], offsets=[-1, 0, 1], shape=(n, n))) / 6
    fields = system(n, mass=mass)
    solved = solve_fields(fields, request(fields, 1e-3))
    assert solved.verdict.status is Status.CONVERGED
    times, point = np.linspace(0, 0.5, 9), np.array([0.55])
    rows = slice(0, len(solved.modes.names))
    states = TrainEvaluator(solved.outcome.slabs).curves(times[:, None], point[:, None], rows)
    exact = reference(fields, point, times, mass)
    assert (
        np.abs(solved.modes.fields(states[:, :, 0]) - exact).max() < 1e-3 * solved.modes.scales[0]
    )


@pytest.mark.slow
def test_positions_share_the_modes_of_their_velocities():
    fields = wave(80)
    solved = solve_fields(fields, request(fields, 1e-4))
    assert solved.verdict.status is Status.CONVERGED
    assert solved.trajectories <= 40
    positions, velocities = solved.modes.modes
    assert positions is velocities
    times, point = np.linspace(0, 2, 9), np.array([0.55])
    rows = slice(0, len(solved.modes.names))
    states = TrainEvaluator(solved.outcome.slabs).curves(times[:, None], point[:, None], rows)
    errors = np.abs(solved.modes.fields(states[:, :, 0]) - reference(fields, point, times))
    assert errors[:80].max() < 1e-4 * solved.modes.scales[0]
    assert errors[80:].max() < 1e-4 * solved.modes.scales[1]


@pytest.mark.slow
def test_travelling_fronts_are_refused_early():
    n = 1000
    central = ss.csr_array(ss.diags_array([0.5, -0.5], offsets=[-1, 1], shape=(n, n))) * n
    x = np.linspace(0, 1, n)
    fields = replace(
        system(n, horizon=(0.0, 0.5)),
        linear=(replace(system(n).linear[0], matrix=central),),
        sources=(),
        box=((0.5, 1.0),),
        initial_vectors=np.exp(-(((x - 0.2) / 0.003) ** 2))[:, None],
        source=ADVECTION,
    )
    solved = solve_fields(fields, request(fields, 1e-2))
    assert solved.verdict.status is Status.RANK_LIMIT
    assert "decay too slowly" in str(solved.verdict)
    assert solved.trajectories <= 25


def test_the_limit_of_trajectories_ends_a_solve():
    fields = system()
    solved = solve_fields(fields, request(fields, 1e-4, trajectories=4))
    assert solved.verdict.status is Status.TRAJECTORY_LIMIT
    assert solved.trajectories <= 4


def test_what_was_not_checked_is_no_success():
    fields = system()
    solved = solve_fields(fields, request(fields, 1e-3, check=0))
    assert solved.verdict.status is Status.UNCHECKED
    assert solved.modes.errors == ()


def test_blow_up_is_told():
    fields = system(growth=8.0)
    solved = solve_fields(fields, request(fields, 1e-3))
    assert solved.verdict.status is Status.BLOW_UP
    assert "leaves all bounds inside the horizon, at t = " in str(solved.verdict)


def test_a_limit_that_the_coefficients_reach_is_named():
    fields = system()
    asked = replace(request(fields, 1e-5), options=CrossOptions(max_rank=1))
    solved = solve_fields(fields, asked)
    assert solved.verdict.status is not Status.CONVERGED
    assert "raise max_rank" in str(solved.verdict)


def learnt(fields, points):
    states, values = Snapshots(1e-9), [Snapshots(1e-9) for _ in fields.pointwise]
    for point in points:
        trajectory = field_trajectory(fields, np.array([point]), np.ones(1), 1e-9, 1e-9)
        states.add(trajectory.states[0])
        for snapshots, of_function in zip(values, trajectory.pointwise, strict=True):
            snapshots.add(of_function)
    modes = FieldModes(fields.unknowns, (states.modes(1e-6),), (1.0,))
    functions = [Interpolation.of(s.modes(1e-6), s.modes(0.0)) for s in values]
    return modes, functions


def test_the_reduced_system_is_the_projection():
    fields = system(60, growth=0.3)
    modes, functions = learnt(fields, (0.1, 0.5, 1.0))
    reduced = reduced_system(fields, modes, functions, 1e-4)
    generator, point = np.random.default_rng(0), np.array([0.5])
    trajectory = field_trajectory(fields, point, np.ones(1), 1e-9, 1e-9)
    states = trajectory.states[0].at(slice(None))[:, ::9]
    a = modes.modes[0].T @ states / fields.size
    times = trajectory.times[::9]
    rates = np.stack(
        [fields.at(point).force(t, u) for t, u in zip(times, states.T, strict=True)], axis=1
    )
    projected = modes.modes[0].T @ rates / fields.size
    ours = reduced.rates(times, a, np.repeat(point[:, None], times.size, axis=1))
    assert np.abs(ours - projected).max() < 1e-4 * np.abs(projected).max()
    direction, step = generator.standard_normal(len(a)), 1e-6
    columns = np.array([0.4]), a[:, :1], point[:, None]
    t, a0, p = columns
    difference = reduced.rates(t, a0 + step * direction[:, None], p) - reduced.rates(t, a0, p)
    jacobian = reduced.jacobian(t, a0, p)[:, :, 0]
    assert np.allclose(jacobian @ direction, difference[:, 0] / step, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("way", ["share", "states"])
def test_trajectories_of_wrapped_systems_are_those_of_the_reduced_one(way):
    """Rates at one point, which single trajectories use, belong to the parameters of the system."""
    fields = system(60, growth=0.3)
    reduced = reduced_system(fields, *learnt(fields, (0.1, 0.5, 1.0)), 1e-4).system
    points, tolerances = np.array([[0.3], [0.7]]), Tolerances(1e-8, 1e-10)
    start, end = reduced.horizon
    states, run = reduced.initial(points.T), SingleIntegrator().run
    exact = run(reduced, points, (start, end), tolerances)
    if way == "share":
        spans = Spans(np.full(2, start), states, np.full(2, end))
        paths = share_paths(run, reduced, points, spans, tolerances)
        ends = np.stack([path.state for path in paths], axis=1)
    else:
        wrapped = from_states(reduced, reduced.horizon)
        numbers = np.column_stack([points, states.T])
        ends = run(wrapped, numbers, (start, end), tolerances).state
    assert np.abs(ends - exact.state).max() < 1e-6 * np.abs(exact.state).max()


def test_the_residual_is_that_of_the_fields():
    fields = system(50)
    modes, functions = learnt(fields, (0.1,))
    reduced = reduced_system(fields, modes, functions, 1e-4)
    residual = FieldResidual(fields, modes, functions, reduced)
    a = np.random.default_rng(0).standard_normal((len(modes.names), 1))
    t, p = np.array([0.2]), np.array([[0.8]])
    rates = modes.modes[0] @ reduced.rates(t, a, p)[:, 0]
    force = fields.at(p[:, 0]).force(0.2, modes.modes[0] @ a[:, 0])
    expected = np.sqrt(np.square(rates - force).mean())
    assert np.isclose(residual(t, a, p)[0], expected, rtol=1e-8)
    worse = residual(np.zeros(2), np.zeros((len(a), 2)), np.array([[0.1, 1.0]]))
    assert worse.shape == (2,)
