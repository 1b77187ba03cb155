"""A damped pendulum: theta'' + c theta' + g sin(theta) = 0, released at theta0.

Lengths are in units of the pendulum's. Asked: the angle for every gravity, damping and angle of
release; sin(theta) is not a polynomial, so that the equation is solved by sampling trajectories,
or, with method="train", with the sine and the cosine of the angle as two further unknowns.
"""

import sympy as sp

import rankone as ro

RTOL = 1e-6

t, g, c, start = sp.symbols("t g c theta0")
theta = sp.Function("theta")(t)

problem = ro.Problem(
    equations=[sp.Eq(theta.diff(t, 2) + c * theta.diff(t) + g * sp.sin(theta), 0)],
    time=(t, 0, 5),
    parameters={g: (7, 13), c: (0.14, 0.26), start: (0.7, 1.3)},
    initial={theta: start, theta.diff(t): 0},
    name="pendulum",
)


def main() -> None:
    compiled = ro.compile(problem)
    solution = compiled.solve(rtol=RTOL)
    print(solution)
    print(compiled.lifted)
    for angle in (0.7, 1.0, 1.3):
        print(f"theta(5) from {angle}: {solution[theta](t=5.0, g=9.81, c=0.2, theta0=angle):.5f}")


if __name__ == "__main__":
    main()
