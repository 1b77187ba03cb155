"""Steady states over boxes in which a branch ends, turns unstable, meets another one, or goes on.

Thirty problems for ``rankone.steady_state``: at most one bifurcation of the branch of the centre of
each box, of a known kind at a known value. Values are closed forms, or roots of one equation in one
unknown; ``test_steady_states.py`` compares them with the Jacobian and the branch itself. Citations
are of the model; values and boxes are ours.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import brentq
from scipy.special import lambertw

from tests.reference.stated import Stated

__all__ = ["KINDS", "STEADY", "Resting"]

KINDS = ("fold", "Hopf", "transcritical", "pitchfork")

Formula = Callable[..., list[float]]


@dataclass(frozen=True, eq=False)
class Resting:
    """A problem for ``steady_state``, and what is known of it.

    Attributes
    ----------
    system : Stated
    kind : str
        One of KINDS, or ``"none"``.
    parameter : str
        The parameter that is varied across the bifurcation.
    value : callable or None
        Its value there, as a function of the other parameters.
    critical : callable or None
        The states there, as a function of all parameters.
    fate : str
        Without a bifurcation: ``"solved"``; ``"refused"`` if there is no steady state that attracts
        trajectories; ``"either"`` if a refusal is right as well.
    exact : callable or None
        Without a bifurcation, the steady state as a function of all parameters.
    false : tuple of str
        What no message may say of it.
    settle, rtol : float
    """

    system: Stated
    kind: str = "none"
    parameter: str = ""
    value: Callable[..., float] | None = None
    critical: Formula | None = None
    fate: str = "solved"
    exact: Formula | None = None
    false: tuple[str, ...] = field(default=())
    settle: float | None = None
    rtol: float = 1e-6

    @property
    def name(self) -> str:
        return self.system.name


def _root(of: Callable[[float], float], lower: float, upper: float) -> float:
    return float(brentq(of, lower, upper, xtol=4e-16, rtol=1e-15))


def _at(
    kind: str,
    name: str,
    citation: str,
    rates: Mapping[str, str],
    initial: Mapping[str, str | float],
    box: Mapping[str, tuple[float, float]],
    value: float | Callable[..., float],
    critical: list[float] | Formula,
    end: float = 10.0,
    settle: float | None = None,
) -> Resting:
    """A problem with a bifurcation over the first parameter of its box."""
    system = Stated(name, citation, rates=rates, initial=initial, parameters=box, end=end)
    return Resting(
        system,
        kind,
        next(iter(box)),
        value if callable(value) else lambda: value,
        critical if callable(critical) else lambda **_: critical,
        settle=settle,
    )


def _folds() -> list[Resting]:
    ignition = (1.0 - math.sqrt(0.5)) / 2.0  # x (1 - x) = 1/8
    refuge = _root(lambda x: 2.0 * x**3 - 10.0 * (x**2 - 1.0), 1.0001, 1.5)

    def closed(u: float) -> float:
        """Determinant of the toggle switch at u, with v = 3/(1 + u^2) and a = u (1 + v^2)."""
        v = 3.0 / (1.0 + u**2)
        return 1.0 - 2.0 * u * v / (1.0 + v**2) * 6.0 * u / (1.0 + u**2) ** 2

    off = _root(closed, 0.05, 1.0)
    repressed = 3.0 / (1.0 + off**2)

    def flow(q: float) -> float:
        """(1 + q)^2 times the derivative of the fresh water that a flow q of salt water takes."""
        return 3.0 * (1.0 + q) - q * (1.0 + q) ** 2 - (0.3 + q) * (3.0 + (1.0 + q) ** 2)

    slowest = _root(flow, 0.0, 2.0)
    fresh = (0.3 + slowest) * (3.0 / (1.0 + slowest) - slowest)

    def turning(d: float) -> float:
        """The state at which the slope of x^2/(1 + x^2) is d."""
        return _root(lambda x: 2.0 * x / (1.0 + x**2) ** 2 - d, 0.0, 0.5)

    low = 2.0 - 1.0 / math.sqrt(3.0)
    apart = -(0.05 ** (1.0 / 3.0))
    return [
        _at(
            "fold",
            "Schlögl",
            "F. Schlögl, Z. Phys. 253 (1972) 147-161",
            {"x": "g - 11*x + 6*x**2 - x**3"},
            {"x": 0.0},
            {"g": (5.7, 6.7)},
            6.0 + 2.0 / (3.0 * math.sqrt(3.0)),
            [low],
        ),
        _at(
            "fold",
            "CSTR, ignition",
            "A. Uppal, W. H. Ray and A. B. Poore, Chem. Eng. Sci. 29 (1974) 967-985 (adiabatic)",
            {"x": "-x + Da*(1 - x)*exp(T)", "T": "-T + 8*Da*(1 - x)*exp(T)"},
            {"x": 0.0, "T": 0.0},
            {"Da": (0.03, 0.065)},
            ignition / (1.0 - ignition) * math.exp(-8.0 * ignition),
            [ignition, 8.0 * ignition],
        ),
        _at(
            "fold",
            "toggle switch, one promoter",
            "T. S. Gardner, C. R. Cantor and J. J. Collins, Nature 403 (2000) 339-342",
            {"u": "a/(1 + v**2) - u", "v": "3/(1 + u**2) - v"},
            {"u": 0.0, "v": 3.0},
            {"a": (2.5, 4.2)},
            off * (1.0 + repressed**2),
            [off, repressed],
        ),
        _at(
            "fold",
            "budworm",
            "D. Ludwig, D. D. Jones and C. S. Holling, J. Anim. Ecol. 47 (1978) 315-332; R. M. "
            "May, Nature 269 (1977) 471-477",
            {"x": "r*x*(1 - x/10) - x**2/(1 + x**2)"},
            {"x": 0.01},
            {"r": (0.45, 0.62)},
            2.0 * refuge**3 / (1.0 + refuge**2) ** 2,
            [refuge],
        ),
        _at(
            "fold",
            "gene that activates itself",
            "P. Smolen, D. A. Baxter and J. H. Byrne, Am. J. Physiol. 274 (1998) C531-C542",
            {"x": "a + x**2/(1 + x**2) - d*x"},
            {"x": 0.0},
            {"a": (0.02, 0.06), "d": (0.42, 0.46)},
            lambda d: d * turning(d) - turning(d) ** 2 / (1.0 + turning(d) ** 2),
            lambda a, d: [turning(d)],
        ),
        _at(
            "fold",
            "thermohaline circulation",
            "H. Stommel, Tellus 13 (1961) 224-230; nondimensional as H. A. Dijkstra, Nonlinear "
            "Physical Oceanography, Springer 2005",
            {"T": "3 - T*(1 + sqrt((T - S)**2))", "S": "f - S*(0.3 + sqrt((T - S)**2))"},
            {"T": 3.0, "S": 0.5},
            {"f": (1.0, 1.3)},
            fresh,
            [3.0 / (1.0 + slowest), fresh / (0.3 + slowest)],
        ),
        _at(
            "fold",
            "imperfect pitchfork, the separate branch",
            "M. Golubitsky and D. G. Schaeffer, Commun. Pure Appl. Math. 32 (1979) 21-98",
            {"x": "0.1 + r*x - x**3"},
            {"x": -1.0},
            {"r": (0.3, 1.0)},
            3.0 * 0.05 ** (2.0 / 3.0),
            [apart],
        ),
    ]


def _hopf_points() -> list[Resting]:
    v = -math.sqrt(1.0 - 0.064)
    w = (v + 0.7) / 0.8
    z = 4.0**0.1
    goodwin = (0.2 / z) ** (1.0 / 3.0)
    square = (0.88 + math.sqrt(0.52)) / 2.0  # of b, where the trace vanishes at a = 0.06
    hot = (18.0 - math.sqrt(44.0)) / 28.0  # 14 x^2 - 18 x + 5 = 0
    lorenz = 10.0 * (10.0 + 8.0 / 3.0 + 3.0) / (10.0 - 8.0 / 3.0 - 1.0)
    side = math.sqrt(8.0 / 3.0 * (lorenz - 1.0))
    return [
        _at(
            "Hopf",
            "Brusselator",
            "I. Prigogine and R. Lefever, J. Chem. Phys. 48 (1968) 1695-1700",
            {"x": "1 + x**2*y - (b + 1)*x", "y": "b*x - x**2*y"},
            {"x": 1.0, "y": 1.0},
            {"b": (1.2, 2.5)},
            2.0,
            [1.0, 2.0],
            settle=5000.0,
        ),
        _at(
            "Hopf",
            "FitzHugh-Nagumo",
            "R. FitzHugh, Biophys. J. 1 (1961) 445-466",
            {"v": "v - v**3/3 - w + I", "w": "0.08*(v + 0.7 - 0.8*w)"},
            {"v": -1.2, "w": -0.6},
            {"I": (0.1, 0.5)},
            w - v + v**3 / 3.0,
            [v, w],
            end=50.0,
        ),
        _at(
            "Hopf",
            "Goodwin",
            "B. C. Goodwin, Adv. Enzyme Regul. 3 (1965) 425-438; J. S. Griffith, J. Theor. Biol. "
            "20 (1968) 202-208",
            {"x": "1/(1 + z**10) - a*x", "y": "x - a*y", "z": "y - a*z"},
            {"x": 0.2, "y": 0.3, "z": 0.5},
            {"a": (0.52, 0.72)},
            goodwin,
            [goodwin**2 * z, goodwin * z, z],
            settle=5000.0,
        ),
        _at(
            "Hopf",
            "Sel'kov",
            "E. E. Sel'kov, Eur. J. Biochem. 4 (1968) 79-86; as cubic autocatalator P. Gray and S. "
            "K. Scott, Chem. Eng. Sci. 39 (1984) 1087-1097",
            {"x": "-x + 0.06*y + x**2*y", "y": "b - 0.06*y - x**2*y"},
            {"x": 0.9, "y": 1.0},
            {"b": (0.85, 1.05)},
            math.sqrt(square),
            [math.sqrt(square), math.sqrt(square) / (0.06 + square)],
            settle=5000.0,
        ),
        _at(
            "Hopf",
            "predator of Holling's second type",
            "M. L. Rosenzweig and R. H. MacArthur, Am. Nat. 97 (1963) 209-223",
            {"x": "x*(1 - x/K) - x*y/(1 + x)", "y": "x*y/(1 + x) - y/2"},
            {"x": 1.0, "y": 1.0},
            {"K": (2.0, 3.4)},
            3.0,
            [1.0, 4.0 / 3.0],
            settle=5000.0,
        ),
        _at(
            "Hopf",
            "CSTR, oscillations",
            "A. Uppal, W. H. Ray and A. B. Poore, Chem. Eng. Sci. 29 (1974) 967-985",
            {"x": "-x + Da*(1 - x)*exp(T)", "T": "-4*T + 14*Da*(1 - x)*exp(T)"},
            {"x": 0.3, "T": 1.0},
            {"Da": (0.1, 0.19)},
            hot / (1.0 - hot) * math.exp(-3.5 * hot),
            [hot, 3.5 * hot],
            settle=5000.0,
        ),
        _at(
            "Hopf",
            "Lorenz",
            "E. N. Lorenz, J. Atmos. Sci. 20 (1963) 130-141 (subcritical)",
            {"x": "10*(y - x)", "y": "x*(r - z) - y", "z": "x*y - 8*z/3"},
            {"x": "sqrt(8*(r - 1)/3) + 0.01", "y": "sqrt(8*(r - 1)/3)", "z": "r - 1"},
            {"r": (21.0, 25.5)},
            lorenz,
            [side, side, lorenz - 1.0],
            settle=2000.0,
        ),
        _at(
            "Hopf",
            "van der Pol, at zero",
            "B. van der Pol, Philos. Mag. 2 (1926) 978-992",
            {"x": "v", "v": "m*(1 - x**2)*v - x"},
            {"x": 0.1, "v": 0.0},
            {"m": (-1.0, 0.6)},
            0.0,
            [0.0, 0.0],
            settle=5000.0,
        ),
    ]


def _crossings() -> list[Resting]:
    """Transcritical points and pitchforks."""
    turing = 1.2 * 8.0 / 4.0  # (1 + 2 d1) (a^2 + 2 d2)/(2 d2) with a = 2, d1 = 0.1, d2 = 2
    return [
        _at(
            "transcritical",
            "endemic threshold",
            "H. W. Hethcote, SIAM Rev. 42 (2000) 599-653",
            {"s": "0.1 - b*s*i - 0.1*s", "i": "b*s*i - 0.6*i", "r": "0.5*i - 0.1*r"},
            {"s": 0.9, "i": 0.1, "r": 0.0},
            {"b": (0.4, 1.1)},
            0.6,
            [1.0, 0.0, 0.0],
            end=50.0,
        ),
        _at(
            "transcritical",
            "laser threshold",
            "H. Haken, Synergetics, Springer 1983 (photons and inversion)",
            {"n": "(2*N - 1.5)*n", "N": "p - N - 2*n*N"},
            {"n": 0.01, "N": 0.0},
            {"p": (0.3, 1.0)},
            0.75,
            [0.0, 0.75],
            settle=5000.0,
        ),
        _at(
            "transcritical",
            "predator with logistic prey",
            "V. Volterra, Mem. R. Accad. Naz. Lincei 2 (1926) 31-113",
            {"x": "x*(1 - x) - x*y", "y": "y*(x - d)"},
            {"x": 0.8, "y": 0.2},
            {"d": (0.4, 1.3)},
            1.0,
            [1.0, 0.0],
            settle=5000.0,
        ),
        _at(
            "transcritical",
            "chemostat, washout",
            "J. Monod, Ann. Inst. Pasteur 79 (1950) 390-410",
            {"s": "D*(4 - s) - 2*x*s/(0.5 + s)", "x": "x*(s/(0.5 + s) - D)"},
            {"s": 2.0, "x": 0.5},
            {"D": (0.5, 1.1)},
            8.0 / 9.0,
            [4.0, 0.0],
            settle=5000.0,
        ),
        _at(
            "pitchfork",
            "Euler buckling of a link",
            "L. Euler, Methodus inveniendi lineas curvas, 1744; one rigid link with a spring",
            {"q": "w", "w": "P*sin(q) - q - w"},
            {"q": 0.1, "w": 0.0},
            {"P": (0.4, 1.3)},
            1.0,
            [0.0, 0.0],
            settle=5000.0,
        ),
        _at(
            "pitchfork",
            "toggle switch, both promoters",
            "T. S. Gardner, C. R. Cantor and J. J. Collins, Nature 403 (2000) 339-342",
            {"u": "a/(1 + v**2) - u", "v": "a/(1 + u**2) - v"},
            {"u": 1.5, "v": 0.5},
            {"a": (1.0, 2.6)},
            2.0,
            [1.0, 1.0],
            settle=5000.0,
        ),
        _at(
            "pitchfork",
            "two cells of the Brusselator",
            "A. M. Turing, Philos. Trans. R. Soc. B 237 (1952) 37-72; I. Prigogine and R. Lefever",
            {
                "x": "2 + x**2*y - (b + 1)*x + 0.1*(v - x)",
                "y": "b*x - x**2*y + 2*(w - y)",
                "v": "2 + v**2*w - (b + 1)*v + 0.1*(x - v)",
                "w": "b*v - v**2*w + 2*(y - w)",
            },
            {"x": 2.01, "y": 1.0, "v": 1.99, "w": 1.0},
            {"b": (1.8, 2.7)},
            turing,
            [2.0, turing / 2.0, 2.0, turing / 2.0],
            settle=5000.0,
        ),
    ]


_LEVELS = 10
_SLOW, _SHARE = 5e-4, 0.05  # rate of the last level, and Michaelis constants


def _cascade_rates() -> dict[str, str]:
    """Ten levels, each modified by the one before; the last one slowly."""
    rates = {}
    for i in range(1, _LEVELS + 1):
        by = "V1" if i == 1 else f"x{i - 1}"
        back = "V2" if i == 1 else "0.5"
        pace = f"{_SLOW}*" if i == _LEVELS else ""
        rates[f"x{i}"] = (
            f"{pace}({by}*(1 - x{i})/({_SHARE} + 1 - x{i}) - {back}*x{i}/({_SHARE} + x{i}))"
        )
    return rates


def _cascade(V1: float, V2: float) -> list[float]:
    """The modified shares, level by level: each is the root of a monotonic function."""
    shares: list[float] = []
    by, back = V1, V2
    for _ in range(_LEVELS):
        shares.append(
            _root(
                lambda x, by=by, back=back: (
                    by * (1.0 - x) / (_SHARE + 1.0 - x) - back * x / (_SHARE + x)
                ),
                0.0,
                1.0,
            )
        )
        by, back = shares[-1], 0.5
    return shares


def _final_size(b: float) -> list[float]:
    """Who was never ill: s = 0.99 exp(-(b/0.2) (1 - s))."""
    ratio = b / 0.2
    s = -float(lambertw(-ratio * 0.99 * np.exp(-ratio)).real) / ratio
    return [s, 0.0, 1.0 - s]


def _without() -> list[Resting]:
    """No bifurcation: smooth branches, slow ones, continua, and nothing at all."""
    oscillates = ("oscillat",)
    chain = {
        f"y{i}": f"{'5e-4' if i == 1 else '1.0'}*({'k' if i == 1 else f'y{i - 1}'} - y{i})"
        for i in range(1, 11)
    }
    return [
        Resting(
            Stated(
                "cascade of ten levels, the last one slow",
                "A. Goldbeter and D. E. Koshland, Proc. Natl. Acad. Sci. USA 78 (1981) 6840-6844",
                rates=_cascade_rates(),
                initial={},
                parameters={"V1": (1.2, 1.7), "V2": (0.9, 1.1)},
                end=100.0,
            ),
            exact=_cascade,
            false=oscillates,
            settle=1e6,
            rtol=1e-4,
        ),
        Resting(
            Stated(
                "chain of ten species behind a slow one",
                "linear, leading eigenvalue -5e-4",
                rates=chain,
                initial={},
                parameters={"k": (1.0, 2.0)},
                end=100.0,
            ),
            exact=lambda k: [k] * 10,
            false=oscillates,
            settle=1e5,
        ),
        Resting(
            Stated(
                "decay to zero",
                "linear",
                rates={"x": "-k*x", "y": "x - y"},
                initial={"x": 1.0},
                parameters={"k": (0.5, 2.0)},
                end=10.0,
            ),
            exact=lambda k: [0.0, 0.0],
            false=oscillates,
        ),
        Resting(
            Stated(
                "enzyme kinetics, closed",
                "L. Michaelis and M. L. Menten, Biochem. Z. 49 (1913) 333-369",
                rates={
                    "E": "-a*E*S + C + k*C",
                    "S": "-a*E*S + C",
                    "C": "a*E*S - C - k*C",
                    "P": "k*C",
                },
                initial={"E": 0.2, "S": 1.0},
                parameters={"a": (1.0, 3.0), "k": (0.5, 2.0)},
                end=20.0,
            ),
            exact=lambda a, k: [0.2, 0.0, 0.0, 1.0],
            false=oscillates,
        ),
        Resting(
            Stated(
                "epidemic, a continuum of ends",
                "W. O. Kermack and A. G. McKendrick, Proc. R. Soc. Lond. A 115 (1927) 700-721",
                rates={"s": "-b*s*i", "i": "b*s*i - 0.2*i", "r": "0.2*i"},
                initial={"s": 0.99, "i": 0.01},
                parameters={"b": (0.3, 0.6)},
                end=100.0,
            ),
            fate="either",
            exact=_final_size,
            false=oscillates,
        ),
        Resting(
            Stated(
                "thermal explosion, short of the fold",
                "N. N. Semenov, Z. Phys. 48 (1928) 571-582 (the fold is at 1/e = 0.3679)",
                rates={"T": "d*exp(T) - T"},
                initial={},
                parameters={"d": (0.2, 0.366)},
                end=20.0,
            ),
            exact=lambda d: [-float(lambertw(-d).real)],
            false=oscillates,
            rtol=1e-4,
        ),
        Resting(
            Stated(
                "Brusselator, a limit cycle in all of the box",
                "I. Prigogine and R. Lefever, J. Chem. Phys. 48 (1968) 1695-1700",
                rates={"x": "1 + x**2*y - (b + 1)*x", "y": "b*x - x**2*y"},
                initial={"x": 1.0, "y": 1.0},
                parameters={"b": (2.5, 3.0)},
                end=10.0,
            ),
            fate="refused",
        ),
        Resting(
            Stated(
                "storage that only fills",
                "a constant inflow: no steady state",
                rates={"x": "k - x", "y": "x"},
                initial={},
                parameters={"k": (0.5, 1.5)},
                end=10.0,
            ),
            fate="refused",
            false=oscillates,
        ),
    ]


STEADY = (*_folds(), *_hopf_points(), *_crossings(), *_without())
