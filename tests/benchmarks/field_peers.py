"""Linear fields reduced by pyMOR: POD of implicit Euler trajectories, and a Galerkin projection."""

import itertools
import time

import numpy as np

STEPS = 200  # Of a trajectory


def model_of(system):
    """A linear system of fields without a mass matrix as a model of pyMOR."""
    from pymor.algorithms.timestepping import ImplicitEulerTimeStepper
    from pymor.models.basic import InstationaryModel
    from pymor.operators.constructions import LincombOperator
    from pymor.operators.numpy import NumpyMatrixOperator
    from pymor.parameters.functionals import GenericParameterFunctional

    names = dict.fromkeys((f"p{j}" for j in range(len(system.parameters))), 1)

    def coefficient(number):
        def value(mu):
            point = np.array([mu[name][0] for name in names])
            return float(np.ravel(system.coefficients(0.0, point)[number])[0])

        return GenericParameterFunctional(value, names)

    rates = LincombOperator(
        [NumpyMatrixOperator(-term.matrix.tocsc()) for term in system.linear],
        [coefficient(term.coefficient) for term in system.linear],
    )
    sources = LincombOperator(
        [NumpyMatrixOperator(term.vector[:, None]) for term in system.sources],
        [coefficient(term.coefficient) for term in system.sources],
    )
    point = np.array([sum(ends) / 2 for ends in system.box])
    start = rates.source.from_numpy(system.initial(point)[:, None])
    return InstationaryModel(
        system.horizon[1] - system.horizon[0],
        start,
        rates,
        sources,
        time_stepper=ImplicitEulerTimeStepper(nt=STEPS),
    )


def by_pymor(system, points, further, reference):
    """Lines that say what modes of trajectories at points cost, and their errors at further ones.

    ``reference(point, times)`` is an accurate trajectory (N, T).
    """
    try:
        from pymor.algorithms.pod import pod
        from pymor.core.logger import set_log_levels
        from pymor.reductors.basic import InstationaryRBReductor
    except ImportError:
        return ["pyMOR is not installed: pip install pymor"]
    set_log_levels({"pymor": "ERROR"})
    model = model_of(system)

    def of(point):
        pairs = zip(itertools.count(), point.tolist(), strict=False)
        return model.parameters.parse({f"p{j}": value for j, value in pairs})

    began = time.process_time()
    snapshots = model.solution_space.empty()
    for point in points:
        snapshots.append(model.solve(of(point)))
    modes, _ = pod(snapshots)
    reductor = InstationaryRBReductor(model, RB=modes)
    reduced = reductor.reduce()
    offline = time.process_time() - began
    times = np.linspace(*system.horizon, STEPS + 1)
    own = missed = 0.0
    began = time.process_time()
    coefficients = [reduced.solve(of(point)) for point in further]
    online = (time.process_time() - began) / len(further)
    for point, each in zip(further, coefficients, strict=True):
        ours = reductor.reconstruct(each).to_numpy()
        exact = reference(point, times)
        size = np.abs(exact).max()
        own = max(own, np.abs(ours - model.solve(of(point)).to_numpy()).max() / size)
        missed = max(missed, np.abs(ours - exact).max() / size)
    return [
        f"pyMOR, {len(points)} implicit Euler trajectories of {STEPS} steps: {offline:.1f} s, "
        f"{len(modes)} modes",
        f"  error {own:.1e} against its own steps, {missed:.1e} against accurate ones; "
        f"{1e3 * online:.0f} ms a reduced trajectory",
    ]
