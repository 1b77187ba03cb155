"""Robertson's chemical kinetics (1966), the standard stiff problem, with uncertain rates.

    y1' = -k1 y1 + k2 y2 y3
    y2' =  k1 y1 - k2 y2 y3 - k3 y2^2
    y3' =  k3 y2^2

The rates differ by nine orders of magnitude and y2 never exceeds a few 1e-5; the tolerance holds
for each component relative to its own size. Asked: the concentrations up to the time 40 for rates
known to 20 to 33 per cent.
"""

import sympy as sp

import rankone as ro

RTOL = 1e-4

t, k1, k2, k3 = sp.symbols("t k1 k2 k3")
y1, y2, y3 = (sp.Function(f"y{i}")(t) for i in (1, 2, 3))

problem = ro.Problem(
    equations=[
        sp.Eq(y1.diff(t), -k1 * y1 + k2 * y2 * y3),
        sp.Eq(y2.diff(t), k1 * y1 - k2 * y2 * y3 - k3 * y2**2),
        sp.Eq(y3.diff(t), k3 * y2**2),
    ],
    time=(t, 0, 40),
    parameters={k1: (0.03, 0.05), k2: (0.8e4, 1.2e4), k3: (2e7, 4e7)},
    initial={y1: 1, y2: 0, y3: 0},
    name="Robertson",
)


def main() -> None:
    solution = ro.solve(problem, rtol=RTOL)
    print(solution)
    print("y(t=40) with the usual rates:", solution(t=40.0, k1=0.04, k2=1e4, k3=3e7))


if __name__ == "__main__":
    main()
