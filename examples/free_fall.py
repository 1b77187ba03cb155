"""A body falling through air: u' = rho A C_D u^2 / (2 m) - g, u(0) = 0.

u is the velocity, upwards positive; the drag grows with its square until it balances the weight.
The drag coefficient C_D depends on a shape that is not known. Asked: the velocity for every C_D
from 0.1 to 1.5 during the first three seconds.
"""

import sympy as sp

import rankone as ro

RTOL = 1e-6

density, area, mass, gravity = 1.2, 0.1, 1, 9.81  # kg/m^3, m^2, kg, m/s^2

t, C_D = sp.symbols("t C_D")
u = sp.Function("u")(t)

problem = ro.Problem(
    equations=[sp.Eq(u.diff(t), sp.Rational(1, 2) * density * area * C_D * u**2 / mass - gravity)],
    time=(t, 0, 3),
    parameters={C_D: (0.1, 1.5)},
    initial={u: 0},
    name="free fall",
)


def main() -> None:
    solution = ro.solve(problem, rtol=RTOL)
    print(solution)
    for drag in (0.1, 0.5, 1.5):
        print(f"velocity after 3 s with C_D = {drag}: {solution[u](t=3.0, C_D=drag):.5f} m/s")


if __name__ == "__main__":
    main()
