"""A rubber beam that swings under two loads, for every stiffness: finite elements in the plane.

The beam is clamped at its left end. Its material is that of St. Venant and Kirchhoff: with the
gradient H of the displacements, F = 1 + H and the strains E = (H + H' + H' H) / 2, the stress is
P = F (2 mu E + lambda tr E). A load pulls its tip down and stays; a wind on its upper side turns to
and fro. Damping is light, in proportion to stiffness. Lengths are in metres, times in seconds, the
modulus k in megapascals, the pull f in newtons a metre, the wind w in pascals.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as ss
import sympy as sp

import rankone as ro

try:
    import skfem
except ImportError as error:
    raise SystemExit("the beam is assembled by scikit-fem: pip install scikit-fem") from error

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RTOL, SIZE, END = 1e-4, 4, 0.8  # Two swings
LENGTH, HEIGHT, DENSITY, DAMPING = 0.2, 0.02, 1100.0, 0.002
POISSON = sp.Rational(2, 5)
LAME = POISSON / ((1 + POISSON) * (1 - 2 * POISSON)), 1 / (2 * (1 + POISSON))  # Of modulus one
t, STIFFNESS, PULL, WIND = sp.symbols("t k f w")
AXES = range(2)
PASCALS = 10**6  # In a megapascal


@dataclass(frozen=True)
class Body:
    """The beam in matrices over its entries: displacements along x and y of node after node.

    ``gradients[i][j]`` has the derivatives of displacements along i by place j at the points of
    quadrature, whose ``weights`` are areas.
    """

    places: np.ndarray
    gradients: list[list[ss.csr_array]]
    weights: np.ndarray
    mass: ss.csr_array
    pull: np.ndarray
    wind: np.ndarray


def assembled(n: int) -> Body:
    """The beam with n elements of second order across its height, and twenty times n along it."""
    grid = np.linspace(0, LENGTH, 20 * n + 1), np.linspace(0, HEIGHT, n + 1)
    mesh = skfem.MeshQuad.init_tensor(*grid)
    element = skfem.ElementVector(skfem.ElementQuad2())
    basis = skfem.Basis(mesh, element, intorder=4)
    along_y = np.zeros(basis.N, dtype=int)
    for numbers in (basis.nodal_dofs, basis.facet_dofs, basis.interior_dofs):
        along_y[numbers[1]] = 1
    x, y = basis.doflocs.round(9)
    order = np.lexsort((along_y, y, x))
    free = order[x[order] > 0.0]

    def load(where: np.ndarray) -> np.ndarray:
        sides = skfem.FacetBasis(mesh, element, facets=where)
        return np.asarray(skfem.LinearForm(lambda v, _: -v[1]).assemble(sides)[free])

    mass = skfem.BilinearForm(lambda u, v, _: DENSITY * (u[0] * v[0] + u[1] * v[1]))
    return Body(
        places=np.stack([x[free[::2]], y[free[::2]]], axis=1),
        gradients=[[gradient(basis, i, j)[:, free] for j in AXES] for i in AXES],
        weights=basis.dx.ravel(),
        mass=ss.csr_array(mass.assemble(basis))[free][:, free],
        pull=load(mesh.facets_satisfying(lambda at: np.isclose(at[0], LENGTH))) / HEIGHT,
        wind=load(mesh.facets_satisfying(lambda at: np.isclose(at[1], HEIGHT))),
    )


def gradient(basis: skfem.Basis, i: int, j: int) -> ss.csr_array:
    """The derivative of displacements along i by place j: (points of quadrature, entries)."""
    points = np.arange(basis.dx.size).reshape(basis.dx.shape)
    entries, rows, columns = [], [], []
    for k in range(basis.Nbfun):
        slopes = np.broadcast_to(basis.basis[k][0].grad[i, j], points.shape)
        entries.append(slopes.ravel())
        rows.append(points.ravel())
        columns.append(np.repeat(basis.element_dofs[k], points.shape[1]))
    where = np.concatenate(rows), np.concatenate(columns)
    matrix = ss.csr_array((np.concatenate(entries), where), shape=(basis.dx.size, basis.N))
    matrix.eliminate_zeros()
    return matrix


def stresses(h: sp.Matrix, large: bool = True) -> sp.Matrix:
    """The stress of a material of modulus one at gradients of displacements; if small, linear."""
    first, second = LAME
    strain = (h + h.T + h.T * h if large else h + h.T) / 2
    stress = 2 * second * strain + first * strain.trace() * sp.eye(2)
    return (sp.eye(2) + h) * stress if large else stress


def problem(n: int) -> ro.Problem:
    """The beam, straight and at rest at first."""
    body = assembled(n)
    u = ro.field("u", body.pull.size)

    def force(stress: sp.Matrix) -> sp.Expr:
        """What stresses do to the entries: their virtual work."""
        pairs = [(i, j) for i in AXES for j in AXES]
        work = {(i, j): (body.gradients[i][j].T * body.weights).tocsr() for i, j in pairs}
        return -sum(ro.apply(work[pair], stress[pair]) for pair in pairs)

    def gradients(of: sp.Expr) -> sp.Matrix:
        return sp.Matrix(2, 2, lambda i, j: ro.apply(body.gradients[i][j], of))

    elastic = force(stresses(gradients(u)))
    damping = DAMPING * force(stresses(gradients(u.diff(t)), large=False))
    pulled = ro.apply(body.pull, PULL * (1 - sp.exp(-((20 * t) ** 2))))
    blown = ro.apply(body.wind, WIND * sp.sin(12 * t))
    return ro.Problem(
        [sp.Eq(u.diff(t, 2), PASCALS * STIFFNESS * (elastic + damping) + pulled + blown)],
        (t, 0, END),
        {STIFFNESS: (0.8, 1.25), PULL: (3, 6), WIND: (0, 20)},
        {u: 0, u.diff(t): 0},
        mass={u: body.mass},
        name="beam of rubber",
    )


@cache
def solved(n: int) -> ro.FieldSolution:
    """The solution for all stiffnesses and loads."""
    return ro.solve(problem(n), rtol=RTOL, method="reduced")


def triangles(n: int) -> np.ndarray:
    """The corners of triangles between the nodes, which are sorted along the beam."""
    across = 2 * n + 1
    corner = (np.arange(40 * n - 1)[:, None] * across + np.arange(across - 1)).ravel()
    lower = np.stack([corner, corner + across, corner + across + 1], axis=1)
    upper = np.stack([corner, corner + across + 1, corner + 1], axis=1)
    return np.concatenate([lower, upper])


def draw(n: int) -> Figure:
    """The beam at several times, and how its tip moves."""
    import matplotlib.pyplot as plt  # the problem alone needs no figures

    solution = solved(n)
    print(solution)
    places = assembled(n).places
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
    point = {"k": 0.8, "f": 6.0, "w": 20.0}
    for time, colour in ((0.0, "0.7"), (0.1, "C0"), (0.2, "C1")):
        at = places + solution["u"](time, point).reshape(-1, 2)
        left.triplot(*at.T, triangles(n), color=colour, linewidth=0.3)
        left.plot([], color=colour, label=f"t = {time:g}")
    left.set(xlabel="x", ylabel="y", aspect="equal", ylim=(-0.05, 0.05))
    left.set_title("soft beam, large loads", fontsize="small")
    left.legend(loc="lower left", fontsize="small")
    times = np.linspace(0, END, 161)
    tip = solution["u"][len(places) * 2 - 1]
    for k in (0.8, 1.0, 1.25):
        right.plot(times, tip(times, k=k, f=6.0, w=20.0), label=f"k = {k:g}")
    right.set(xlabel="t", ylabel="displacement of the tip")
    right.legend()
    return figure


def page(n: int, folder: Path) -> Path:
    """A page on which the beam moves."""
    solution = solved(n)
    u = solution["u"]
    return solution.explore(
        folder / "beam.html",
        places=assembled(n).places,
        triangles=triangles(n),
        displacement=(u[0::2], u[1::2]),
        title="A beam of rubber",
        overwrite=True,
    )


if __name__ == "__main__":
    from common import run

    run("beam", SIZE, draw, page)
