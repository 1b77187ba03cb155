"""Systems with a parameter over two to four decades, or more, given as a plain interval."""

from __future__ import annotations

from tests.reference.stated import Stated, around, reactions

__all__ = ["DECADES"]

_INFECTION = {"T": "10 - 0.1*T - beta*T*V", "I": "beta*T*V - 0.5*I", "V": "p*I - 5*V"}
_LOGISTIC = "P.-F. Verhulst, Corr. Math. Phys. 10 (1838) 113-121 (from almost nothing)"
_ARRHENIUS = "S. Arrhenius, Z. Phys. Chem. 4 (1889) 226-248"

_SYSTEMS = (
    Stated(
        "sir",
        "W. O. Kermack and A. G. McKendrick, Proc. R. Soc. Lond. A 115 (1927) 700-721",
        rates={"s": "-b*s*i", "i": "b*s*i - g*i", "r": "g*i"},
        initial={"s": "1 - i0", "i": "i0"},
        parameters={"b": (0.1, 1.08), "g": (0.2, 0.6), "i0": (1e-6, 1e-2)},
        end=44.0,
    ),
    Stated(
        "seir",
        "R. M. Anderson and R. M. May, Infectious Diseases of Humans, Oxford University Press 1991",
        rates={"s": "-b*s*i", "e": "b*s*i - 0.2*e", "i": "0.2*e - g*i", "r": "g*i"},
        initial={"s": "1 - e0", "e": "e0"},
        parameters={"b": (0.3, 0.6), "g": (0.1, 0.2), "e0": (1e-6, 1e-3)},
        end=100.0,
    ),
    Stated(
        "enzyme",
        "L. Michaelis and M. L. Menten, Biochem. Z. 49 (1913) 333-369; mass action of G. E. Briggs "
        "and J. B. S. Haldane, Biochem. J. 19 (1925) 338-339",
        rates=reactions("E + S = C : on, off\nC = E + P : cat"),
        initial={"E": 0.1, "S": 1.0},
        parameters={"on": (1.0, 100.0), "off": (0.1, 10.0), "cat": (0.1, 10.0)},
        end=20.0,
    ),
    Stated(
        "haldane",
        "J. B. S. Haldane, Enzymes, Longmans 1930; J. F. Andrews, Biotechnol. Bioeng. 10 (1968) "
        "707-723 (batch growth inhibited by substrate)",
        rates={"x": "mu*x", "s": "-2*mu*x"},
        constants={"mu": "0.5*s/(ks + s + s**2/ki)"},
        initial={"x": "x0", "s": 10.0},
        parameters={"ks": (0.05, 5.0), "ki": (2.0, 200.0), "x0": (1e-3, 0.1)},
        end=30.0,
    ),
    Stated(
        "logistic_19",
        _LOGISTIC,
        rates={"x": "r*x*(1 - x)"},
        initial={"x": "x0"},
        parameters={"x0": (1e-19, 1e-15), "r": (0.9, 1.1)},
        end=50.0,
    ),
    Stated(
        "logistic_12",
        _LOGISTIC,
        rates={"x": "r*x*(1 - x)"},
        initial={"x": "x0"},
        parameters={"x0": (1e-12, 1e-3), "r": (0.9, 1.1)},
        end=40.0,
    ),
    Stated(
        "infection",
        "A. S. Perelson and P. W. Nelson, Mathematical analysis of HIV-1 dynamics in vivo, SIAM "
        "Rev. 41 (1999) 3-44 (infectivity and production × and ÷ 100)",
        rates=_INFECTION,
        initial={"T": 100.0, "V": 1.0},
        parameters=around(100.0, beta=5e-4, p=10.0),
        end=10.0,
    ),
    Stated(
        "enzyme_cascade",
        "A. Goldbeter and D. E. Koshland, Proc. Natl. Acad. Sci. USA 78 (1981) 6840-6844 (three "
        "levels, sharpness and signal over two decades)",
        rates={
            "a": "signal*(1 - a)/(k + 1 - a) - 0.5*a/(k + a)",
            "b": "a*(1 - b)/(k + 1 - b) - 0.4*b/(k + b)",
            "c": "b*(1 - c)/(1.1 - c) - 0.4*c/(0.1 + c)",
        },
        initial={},
        parameters={"signal": (0.05, 5.0), "k": (0.1, 10.0)},
        end=15.0,
    ),
    Stated(
        "signal_cascade",
        "R. Heinrich, B. G. Neel and T. A. Rapoport, Mol. Cell 9 (2002) 957-970 (a chain of four "
        "kinases, each rate over two decades)",
        rates={
            "r": "-l*r",
            "x1": "a*r*(1 - x1) - b*x1",
            "x2": "a*x1*(1 - x2) - b*x2",
            "x3": "a*x2*(1 - x3) - b*x3",
        },
        initial={"r": 1.0},
        parameters={"l": (0.02, 2.0), "a": (0.1, 10.0), "b": (0.05, 5.0)},
        end=10.0,
    ),
    Stated(
        "gene_cascade",
        "S. Hooshangi, S. Thiberge and R. Weiss, Ultrasensitivity and noise propagation in a "
        "synthetic transcriptional cascade, Proc. Natl. Acad. Sci. USA 102 (2005) 3581-3586",
        rates={
            "x": "u**2/(1 + u**2) - x",
            "y": "b*x**2/(k**2 + x**2) - y",
            "z": "1/(1 + y**2) - z",
        },
        initial={},
        parameters={"u": (0.03, 30.0), "b": (0.1, 10.0), "k": (0.05, 5.0)},
        end=8.0,
    ),
    Stated(
        "arrhenius",
        f"{_ARRHENIUS} (a batch of two consecutive reactions, activation energies ±30 %)",
        rates=reactions("A = B : k1\nB = C : k2"),
        constants={"k1": "1e8*exp(-e1/8.314/350)", "k2": "2e8*exp(-e2/8.314/350)"},
        initial={"A": 1.0},
        parameters={"e1": (38_500.0, 71_500.0), "e2": (38_500.0, 71_500.0)},
        end=20.0,
    ),
    Stated(
        "arrhenius_heat",
        f"{_ARRHENIUS}; R. Aris, Introduction to the Analysis of Chemical Reactors, Prentice-Hall "
        "1965 (a cooled batch that does not ignite, activation energy ±30 %)",
        rates={"c": "-k*c", "T": "10*k*c - h*(T - 350)"},
        constants={"k": "1e8*exp(-e/8.314/T)"},
        initial={"c": 1.0, "T": 350.0},
        parameters={"e": (38_500.0, 71_500.0), "h": (0.1, 10.0)},
        end=10.0,
    ),
    Stated(
        "clearance",
        "J. G. Wagner, Fundamentals of Clinical Pharmacokinetics, Drug Intelligence 1975 (two "
        "compartments, oral; clearance over two decades)",
        rates={
            "gut": "-ka*gut",
            "a": "ka*gut - cl/10*a - 0.5*a + 0.1*b",
            "b": "0.5*a - 0.1*b",
        },
        initial={"gut": 1.0},
        parameters={"cl": (0.2, 20.0), "ka": (0.1, 10.0)},
        end=24.0,
    ),
    Stated(
        "drug_target",
        "G. Levy, Pharmacologic target-mediated drug disposition, Clin. Pharmacol. Ther. 56 (1994) "
        "248-252; D. E. Mager and W. J. Jusko, J. Pharmacokinet. Pharmacodyn. 28 (2001) 507-532",
        rates=reactions("L + R = C : on, 0.01\nL -> N : 0.1*L\nC -> N : 0.05*C", fixed=["N"]),
        initial={"L": "dose", "R": 1.0},
        parameters={"dose": (0.1, 30.0), "on": (0.05, 5.0)},
        end=24.0,
    ),
    Stated(
        "chemostat",
        "J. Monod, La technique de culture continue, Ann. Inst. Pasteur 79 (1950) 390-410 "
        "(inoculum over three decades)",
        rates={"s": "d*(5 - s) - 2*mu*x", "x": "(mu - d)*x"},
        constants={"mu": "s/(ks + s)"},
        initial={"s": 5.0, "x": "x0"},
        parameters={"d": (0.1, 0.6), "ks": (0.05, 2.0), "x0": (1e-4, 0.1)},
        end=20.0,
    ),
)
DECADES = {system.name: system for system in _SYSTEMS}
