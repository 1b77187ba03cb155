"""Predators y and prey x (Lotka 1925, Volterra 1926) from uncertain initial populations.

    x' = x (1.5 - y),   y' = -y (3 - x)

The initial populations x0 and y0 are parameters like any others. Over two periods trajectories
from neighbouring states drift apart and the populations change steeply, which is what makes the
problem hard. Asked: both populations up to the time 6 for every x0 in [8, 12], y0 in [4, 6].
"""

import sympy as sp

import rankone as ro

RTOL = 1e-6

t, x0, y0 = sp.symbols("t x0 y0")
x, y = sp.Function("x")(t), sp.Function("y")(t)

problem = ro.Problem(
    equations=[sp.Eq(x.diff(t), x * (1.5 - y)), sp.Eq(y.diff(t), -y * (3 - x))],
    time=(t, 0, 6),
    parameters={x0: (8, 12), y0: (4, 6)},
    initial={x: x0, y: y0},
    name="Lotka-Volterra",
)


def main() -> None:
    solution = ro.solve(problem, rtol=RTOL)
    print(solution)
    print("x, y at t = 1 from (9, 5):", solution(t=1.0, x0=9.0, y0=5.0))
    print("x at t = 6 from (8, 5), (10, 5), (12, 5):", solution[x](6.0, {x0: [8, 10, 12], y0: 5}))


if __name__ == "__main__":
    main()
