"""Exponential decay with an uncertain rate: u' + k u = 0, u(0) = 1.

The smallest parametric problem there is, with the exact solution exp(-k t). Asked: u for every
rate k from 0.5 to 5 and every time up to 2.
"""

import math

import sympy as sp

import rankone as ro

RTOL = 1e-6

t, k = sp.symbols("t k")
u = sp.Function("u")(t)

problem = ro.Problem(
    equations=[sp.Eq(u.diff(t) + k * u, 0)],
    time=(t, 0, 2),
    parameters={k: (0.5, 5)},
    initial={u: 1},
    name="decay",
)


def main() -> None:
    solution = ro.solve(problem, rtol=RTOL)
    print(solution)
    print(f"u(t=1, k=2) = {solution[u](t=1.0, k=2.0):.8f}, exactly {math.exp(-2.0):.8f}")


if __name__ == "__main__":
    main()
