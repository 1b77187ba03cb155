"""Three unknowns, each driven by the product of the others, from uncertain initial values.

    u1' + u2 u3 = 1,   u2' + u1 u3 = 2,   u3' + u1 u2 = 3

A strongly coupled system: methods that treat one equation at a time do not converge on it, and
every trajectory blows up in finite time, none before 0.75. Asked: the unknowns up to the time 0.5
from every initial state in [0.5, 1.5]^3, which are the parameters a1, a2, a3.
"""

import sympy as sp

import rankone as ro

RTOL = 1e-6

t = sp.Symbol("t")
a1, a2, a3 = sp.symbols("a1:4")
u1, u2, u3 = (sp.Function(f"u{i}")(t) for i in (1, 2, 3))

problem = ro.Problem(
    equations=[
        sp.Eq(u1.diff(t) + u2 * u3, 1),
        sp.Eq(u2.diff(t) + u1 * u3, 2),
        sp.Eq(u3.diff(t) + u1 * u2, 3),
    ],
    time=(t, 0, 0.5),
    parameters={a1: (0.5, 1.5), a2: (0.5, 1.5), a3: (0.5, 1.5)},
    initial={u1: a1, u2: a2, u3: a3},
    name="coupled",
)


def main() -> None:
    solution = ro.solve(problem, rtol=RTOL)
    print(solution)
    print("u(t=0.5) from (1, 1, 1):", solution(t=0.5, a1=1.0, a2=1.0, a3=1.0))


if __name__ == "__main__":
    main()
