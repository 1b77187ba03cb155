"""A derivative with a parameter in front of it: k (u' + 1) = 10, u(0) = 0.

The equation is solved for u' symbolically, which makes 1/k a factor. The exact solution
(10/k - 1) t is a product of a function of k and a function of t: one mode is enough, and the
solution is exact up to rounding. Asked: u for every k from 1 to 10 up to the time 5.
"""

import sympy as sp

import rankone as ro

RTOL = 1e-6

t, k = sp.symbols("t k")
u = sp.Function("u")(t)

problem = ro.Problem(
    equations=[sp.Eq(k * (u.diff(t) + 1), 10)],
    time=(t, 0, 5),
    parameters={k: (1, 10)},
    initial={u: 0},
    name="linear",
)


def main() -> None:
    solution = ro.solve(problem, rtol=RTOL)
    print(solution)
    print(f"u(t=3, k=4) = {solution[u](t=3.0, k=4.0):.12f}, exactly 4.5")


if __name__ == "__main__":
    main()
