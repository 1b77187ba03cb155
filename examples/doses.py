"""Six doses of a drug in two compartments, with an elimination that saturates.

The concentrations c in the blood and p in tissue (mg/L, as if it had the same volume) follow

    c' = -Vmax c / ((Km + c) V) - k12 c + k21 p,    p' = k12 c - k21 p.

Every twelve hours 100 mg are injected, so that c jumps by 100/V. Asked: both concentrations for
every volume V (L), largest rate of elimination Vmax (mg/h), Michaelis constant Km (mg/L) and rate
of exchange k12 (1/h), over three days.
"""

import sympy as sp

import rankone as ro

RTOL = 1e-5

dose, k21 = 100, sp.Rational(1, 4)  # mg, 1/h
doses = range(0, 72, 12)  # h

t, V, Vmax, Km, k12 = sp.symbols("t V Vmax Km k12")
c, p = (sp.Function(name)(t) for name in "cp")
exchange = k12 * c - k21 * p

problem = ro.Problem(
    equations=[
        sp.Eq(c.diff(t), -Vmax * c / ((Km + c) * V) - exchange),
        sp.Eq(p.diff(t), exchange),
    ],
    time=(t, 0, 72),
    parameters={V: (25, 35), Vmax: (8, 12), Km: (2, 3), k12: (0.2, 0.3)},
    initial={c: 0, p: 0},
    jumps={tuple(doses): {c: c + dose / V}},
    name="six doses",
)


def main() -> None:
    solution = ro.solve(problem, rtol=RTOL)
    print(solution)
    person = {"V": 30.0, "Vmax": 10.0, "Km": 2.5, "k12": 0.25}
    for hour in doses:
        before = 0.0 if hour == 0 else solution[c](hour - 1e-9, person)
        print(f"{hour:2d} h: from {before:.4f} to {solution[c](hour, person):.4f} mg/L")


if __name__ == "__main__":
    main()
