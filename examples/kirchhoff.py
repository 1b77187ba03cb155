"""A rigid body in an ideal fluid: the Kirchhoff equations (Lamb, Hydrodynamics, ch. VI).

    (m E + M) u' = (m E + M) u x w + f
    (J + I)   w' = (J + I) w x w + (M u) x u

u and w are the velocity and the angular velocity in the body frame; M and I are added mass and
added inertia. The mass matrix is inverted symbolically. Asked: the motion from every initial state
in [0.5, 1]^6, six parameters, so that with time there are seven dimensions. Up to the time 1 it
is moderate; up to 3 the states depend steeply on where the motion began.
"""

import sympy as sp

import rankone as ro

RTOL = 1e-4
RTOL_LONG = 1e-3

t = sp.Symbol("t")
start = sp.symbols("a1:7")
u = sp.Matrix([sp.Function(f"u{i}")(t) for i in (1, 2, 3)])
w = sp.Matrix([sp.Function(f"w{i}")(t) for i in (1, 2, 3)])


def motion(horizon: float) -> ro.Problem:
    """The problem up to a time."""
    mass = sp.diag(2, 2.5, 3)
    added_mass = sp.diag(1, 1.5, 2)
    inertia = sp.diag(0.4, 0.6, 0.9)
    force = sp.Matrix([0, 0, -0.5])
    linear = mass * u.diff(t) - (mass * u).cross(w) - force
    angular = inertia * w.diff(t) - (inertia * w).cross(w) - (added_mass * u).cross(u)
    return ro.Problem(
        equations=[*linear, *angular],
        time=(t, 0, horizon),
        parameters=dict.fromkeys(start, (0.5, 1)),
        initial=dict(zip([*u, *w], start, strict=True)),
        name="Kirchhoff",
    )


problem = motion(1)


def main() -> None:
    centre = dict.fromkeys(start, 0.75)
    for horizon, rtol in ((1, RTOL), (3, RTOL_LONG)):
        solution = ro.solve(motion(horizon), rtol=rtol)
        print(solution)
        print(f"velocities at t = {horizon} from the centre:", solution(horizon, centre))


if __name__ == "__main__":
    main()
