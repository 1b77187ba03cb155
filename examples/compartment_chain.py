"""Ten compartments in a row, ten uncertain rates: x_i' = k_{i-1} x_{i-1} - k_i x_i.

A tracer starts in the first compartment and moves down the chain; each rate is known to 30 per
cent. A grid of ten values per rate would have 10^10 points; the solution has eleven dimensions
with time. Asked: the contents of every compartment up to the time 5.
"""

import sympy as sp

import rankone as ro

RTOL = 1e-4

t = sp.Symbol("t")
rates = sp.symbols("k1:11")
contents = [sp.Function(f"x{i}")(t) for i in range(1, 11)]

inflow = [0, *(rate * content for rate, content in zip(rates, contents, strict=True))]

problem = ro.Problem(
    equations=[
        sp.Eq(contents[i].diff(t), inflow[i] - rates[i] * contents[i]) for i in range(len(rates))
    ],
    time=(t, 0, 5),
    parameters=dict.fromkeys(rates, (0.7, 1.3)),
    initial={content: int(i == 0) for i, content in enumerate(contents)},
    name="compartment chain",
)


def main() -> None:
    solution = ro.solve(problem, rtol=RTOL)
    print(solution)
    print("contents at t = 5, all rates one:", solution(5.0, dict.fromkeys(rates, 1.0)).round(5))


if __name__ == "__main__":
    main()
