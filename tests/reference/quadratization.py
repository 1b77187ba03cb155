"""Quadratisation problems, with the number of unknowns that QBee adds.

The systems are those of QBee (A. Bychkov and G. Pogudin, "Optimal monomial quadratization for ODE
systems", 2021; https://github.com/AndreyBychkov/QBee) and of its documentation, with numbers for
their parameters, and variants. The counts were made with QBee 0.8.2,
``polynomialize_and_quadratize``, with and without negative powers, the smaller of both; where its
documentation states one it is the same.
"""

from __future__ import annotations

__all__ = ["PROBLEMS"]

PROBLEMS: dict[str, tuple[dict[str, str], int]] = {
    "toy x1*x2, -x1*x2^3": ({"x1": "x1*x2", "x2": "-x1*x2**3"}, 1),
    "x^5": ({"x": "x**5"}, 1),
    "(x+1)^10": ({"x": "(x+1)**10"}, 5),
    "Circular(3)": ({"x": "y**3", "y": "x**3"}, 3),
    "Circular(5)": ({"x": "y**5", "y": "x**5"}, 4),
    "Hill(5)": ({"h": "5*i**2*s**4", "i": "-5*i**2*s**4", "s": "1"}, 2),
    "Hill(10)": ({"h": "10*i**2*s**9", "i": "-10*i**2*s**9", "s": "1"}, 4),
    "Hard(3)": ({"a": "c**3 + a**2*b**2*c**3", "b": "a**2", "c": "b**2"}, 9),
    "Long Monom(2)": ({"x0": "x1**2 + x0**2*x1**2", "x1": "x0**2 + x0**2*x1**2"}, 3),
    "Cubic Cycle(6)": (
        {"x0": "x1**3", "x1": "x2**3", "x2": "x3**3", "x3": "x4**3", "x4": "x5**3", "x5": "x0**3"},
        12,
    ),
    "Cubic Bicycle(6)": (
        {
            "x0": "x1**3 + x5**3",
            "x1": "x2**3 + x0**3",
            "x2": "x3**3 + x1**3",
            "x3": "x4**3 + x2**3",
            "x4": "x5**3 + x3**3",
            "x5": "x0**3 + x4**3",
        },
        12,
    ),
    "Selkov": ({"x": "-x+2*y/25+x**2*y", "y": "3/5-2*y/25-x**2*y"}, 2),
    "Rabinovich-Fabrikant": (
        {"x": "y*(z-1+x**2)+x/10", "y": "x*(3*z+1-x**2)+y/10", "z": "-2*z*(7/50+x*y)"},
        3,
    ),
    "Blue-sky catastrophe": (
        {
            "x": "(2-10*(x**2+y**2))*x+y**2+2*y+z**2",
            "y": "-z**3-(1+y)*(y**2+2*y+z**2)-4*x+y",
            "z": "(1+y)*z**2+x**2",
        },
        4,
    ),
    "exp(1/x)": ({"x": "exp(1/x)"}, 3),
    "1/(1+exp(1/x))": ({"x": "1/(1+exp(1/x))"}, 5),
    "sigmoid": ({"x": "1/(1+exp(x))"}, 3),
    "x*sin(2x)+1": ({"x": "x*sin(2*x)+1"}, 4),
    "pendulum": ({"x": "y", "y": "-sin(x)-y/5"}, 2),
    "x*log(x)": ({"x": "x*log(x)-x**2"}, 1),
    "Hill function 1/(2+x^3)": ({"x": "1/(2+x**3)"}, 3),
    "solar wind, n=3": (
        {
            "v1": "(v1+v2)/v1-3*(v1+v2)",
            "v2": "(v1+v2+v3)/v2+3*(v1+v2+v3)",
            "v3": "(v2+v3)/v3+3*(v2+v3)",
        },
        11,
    ),
    "combustion A1, T an input": (
        {
            "c1": "-3*exp(-2/(2+t))*c1**0.2*c2**1.3",
            "c2": "-6*exp(-2/(2+t))*c1**0.2*c2**1.3",
            "c3": "3*exp(-2/(2+t))*c1**0.2*c2**1.3",
            "c4": "6*exp(-2/(2+t))*c1**0.2*c2**1.3",
        },
        10,
    ),
    "combustion A1, constant T": (
        {
            "c1": "-3*c1**0.2*c2**1.3",
            "c2": "-6*c1**0.2*c2**1.3",
            "c3": "3*c1**0.2*c2**1.3",
            "c4": "6*c1**0.2*c2**1.3",
        },
        4,
    ),
    "combustion A1, T a state": (
        {
            "c1": "-3*exp(-2/T)*c1**0.2*c2**1.3",
            "c2": "-6*exp(-2/T)*c1**0.2*c2**1.3",
            "c3": "3*exp(-2/T)*c1**0.2*c2**1.3",
            "c4": "6*exp(-2/T)*c1**0.2*c2**1.3",
            "T": "5*exp(-2/T)*c1**0.2*c2**1.3",
        },
        8,
    ),
}
"""For each the right-hand sides, and how many unknowns QBee adds."""
