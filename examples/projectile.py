"""A ball with spin in air: drag against the velocity v, lift across it, both as |v| v.

With k = rho A / (2 m) the velocities over the ground u and upwards w follow

    u' = -k |v| (C_D u + C_L w),    w' = -k |v| (C_D w - C_L u) - g,    |v| = sqrt(u^2 + w^2),

for a golf ball (diameter 42.67 mm, mass 45.93 g). Asked: its flight for every drag and lift
coefficient, speed and angle of launch, for the first three seconds.
"""

import math

import sympy as sp

import rankone as ro

RTOL = 1e-6

density, diameter, mass, gravity = 1.225, 0.04267, 0.04593, 9.81  # kg/m^3, m, kg, m/s^2
k = 0.5 * density * math.pi * diameter**2 / 4 / mass  # 1/m

t, C_D, C_L, speed, angle = sp.symbols("t C_D C_L speed angle")
x, z, u, w = (sp.Function(name)(t) for name in "xzuw")
size = sp.sqrt(u**2 + w**2)

problem = ro.Problem(
    equations=[
        sp.Eq(x.diff(t), u),
        sp.Eq(z.diff(t), w),
        sp.Eq(u.diff(t), -k * size * (C_D * u + C_L * w)),
        sp.Eq(w.diff(t), -k * size * (C_D * w - C_L * u) - gravity),
    ],
    time=(t, 0, 3),
    parameters={C_D: (0.2, 0.3), C_L: (0.1, 0.2), speed: (55, 70), angle: (0.15, 0.35)},
    initial={x: 0, z: 0, u: speed * sp.cos(angle), w: speed * sp.sin(angle)},
    name="projectile with drag and lift",
)


def main() -> None:
    solution = ro.solve(problem, rtol=RTOL)
    print(solution)
    for lift in (0.1, 0.15, 0.2):
        at = {"C_D": 0.25, "C_L": lift, "speed": 65.0, "angle": 0.2}
        print(
            f"after 3 s with C_L = {lift}: {solution[x](3.0, at):.3f} m far, "
            f"{solution[z](3.0, at):.3f} m high"
        )


if __name__ == "__main__":
    main()
