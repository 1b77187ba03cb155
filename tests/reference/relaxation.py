"""Stiff relaxation oscillators and ignitions over one to five jumps, parameters ±20 %.

Every trajectory jumps at a time of its own, in a sliver of the horizon. Boxes are narrower where
some of their trajectories would not jump at all. The thresholds of the library were chosen on the
first eleven systems, and not on those from ``cell_cycle`` on.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
import scipy.integrate

from tests.reference.measure import Array
from tests.reference.stated import Stated

__all__ = ["RELAXATION"]

_VAN_DER_POL = "B. van der Pol, On relaxation-oscillations, Phil. Mag. 2 (1926) 978-992"
_PULSES = "J. Chem. Phys. 60 (1974) 1877-1884 (values; start and horizon of the IVP test set)"


class Jumping(Stated):
    """A system whose unknowns may have spikes that no compared time meets."""

    @cached_property
    def sizes(self) -> Array:
        """The largest values (n,), also on the steps of the trajectory at the centre of the box.

        In the jumps of van der Pol (mu = 1,000) v is a million times as large as at the times that
        are compared.
        """
        rhs, initial = self.functions
        centre = [0.5 * (lower + upper) for lower, upper in self.parameters.values()]
        steps = scipy.integrate.solve_ivp(
            lambda t, u: rhs(t, u.tolist(), centre), (0.0, self.end), initial(centre), "LSODA"
        )
        return np.maximum(super().sizes, np.abs(steps.y).max(axis=1))


def _around(**centres: float) -> dict[str, tuple[float, float]]:
    return {name: (0.8 * x, 1.2 * x) for name, x in centres.items()}


def _van_der_pol(mu: float) -> Jumping:
    return Jumping(
        f"van_der_pol_{mu:g}",
        _VAN_DER_POL,
        rates={"x": "v", "v": "mu*(1 - x**2)*v - w*x"},
        initial={"x": 2.0},
        parameters=_around(mu=mu, w=1.0),
        end=2.0 * mu,
    )


_SYSTEMS = (
    _van_der_pol(50.0),
    _van_der_pol(100.0),
    _van_der_pol(1000.0),
    Jumping(
        "oregonator",
        f"R. J. Field and R. M. Noyes, Oscillations in chemical systems IV, {_PULSES}",
        rates={
            "x": "s*(y - x*y + x - q*x**2)",
            "y": "(z - y - x*y)/s",
            "z": "w*(x - z)",
        },
        initial={"x": 1.0, "y": 2.0, "z": 3.0},
        parameters=_around(s=77.27, w=0.161, q=8.375e-6),
        end=360.0,
    ),
    Jumping(
        "morris_lecar",
        "C. Morris and H. Lecar, Voltage oscillations in the barnacle giant muscle fiber, Biophys. "
        "J. 35 (1981) 193-213; constants of J. Rinzel and G. B. Ermentrout 1989, potassium slower",
        rates={
            "v": "(I - 2*(v + 60) - g*m*(v - 120) - 8*w*(v + 84))/20",
            "w": "phi*(wi - w)*rate",
        },
        constants={
            "m": "0.5*(1 + tanh((v + 1.2)/18))",
            "wi": "0.5*(1 + tanh((v - 2)/30))",
            "rate": "0.5*(exp((v - 2)/60) + exp(-(v - 2)/60))",
        },
        initial={"v": -20.0, "w": 0.1},
        parameters={"phi": (0.0016, 0.0024), "g": (4.4, 5.0), "I": (95.0, 120.0)},
        end=1500.0,
    ),
    Jumping(
        "hodgkin_huxley",
        "A. L. Hodgkin and A. F. Huxley, A quantitative description of membrane current, J. "
        "Physiol. 117 (1952) 500-544 (values; depolarisation positive)",
        rates={
            "v": "I - gna*m**3*h*(v - 115) - gk*n**4*(v + 12) - 0.3*(v - 10.613)",
            "m": "0.1*(25 - v)/(exp((25 - v)/10) - 1)*(1 - m) - 4*exp(-v/18)*m",
            "h": "0.07*exp(-v/20)*(1 - h) - h/(exp((30 - v)/10) + 1)",
            "n": "0.01*(10 - v)/(exp((10 - v)/10) - 1)*(1 - n) - 0.125*exp(-v/80)*n",
        },
        initial={"m": 0.0529, "h": 0.5961, "n": 0.3177},
        parameters=_around(I=12.0, gna=120.0, gk=36.0),
        end=40.0,
    ),
    Jumping(
        "fitzhugh_nagumo",
        "J. Nagumo, S. Arimoto and S. Yoshizawa, An active pulse transmission line simulating "
        "nerve axon, Proc. IRE 50 (1962) 2061-2070 (fast by a factor of 1,000)",
        rates={"v": "(v - v**3/3 - w + I)/eps", "w": "v + a - 0.8*w"},
        initial={"v": -1.0, "w": 1.0},
        parameters=_around(eps=1e-3, a=0.5, I=0.6),
        end=6.0,
    ),
    Jumping(
        "bonhoeffer",
        "R. FitzHugh, Impulses and physiological states in theoretical models of nerve membrane, "
        "Biophys. J. 1 (1961) 445-466 (Bonhoeffer-van der Pol; c = 60 instead of 3)",
        rates={"x": "c*(x + y - x**3/3 - z)", "y": "-(x - a + 0.8*y)/c"},
        initial={"x": 2.0},
        parameters=_around(c=60.0, a=0.4, z=0.35),
        end=250.0,
    ),
    Jumping(
        "hindmarsh_rose",
        "J. L. Hindmarsh and R. M. Rose, A model of neuronal bursting using three coupled first "
        "order differential equations, Proc. R. Soc. Lond. B 221 (1984) 87-102 (values; one burst)",
        rates={
            "x": "y - x**3 + 3*x**2 - z + I",
            "y": "1 - 5*x**2 - y",
            "z": "r*(s*(x + 1.6) - z)",
        },
        initial={"x": -1.6, "y": -11.8, "z": 1.8},
        parameters=_around(I=3.2, r=0.006, s=4.0),
        end=25.0,
    ),
    Jumping(
        "calcium",
        "A. Goldbeter, G. Dupont and M. J. Berridge, Minimal model for signal-induced Ca2+ "
        "oscillations, Proc. Natl. Acad. Sci. USA 87 (1990) 1461-1465 (values)",
        rates={
            "z": "1 + 7.3*beta - pump + release + y - 10*z",
            "y": "pump - release - y",
        },
        constants={
            "pump": "65*z**2/(1 + z**2)",
            "release": "vm*y**2/(4 + y**2)*z**4/(0.9**4 + z**4)",
        },
        initial={"z": 0.1, "y": 1.5},
        parameters={"beta": (0.35, 0.5), "vm": (400.0, 600.0)},
        end=2.0,
    ),
    Jumping(
        "autocatalator",
        "B. Peng, S. K. Scott and K. Showalter, Period doubling and chaos in a three-variable "
        "autocatalator, J. Phys. Chem. 94 (1990) 5243-5246 (kappa = 65; faster by 10 to 100)",
        rates={
            "a": "mu*(65 + c) - a*b**2 - a",
            "b": "(a*b**2 + a - b)/sigma",
            "c": "(b - c)/delta",
        },
        initial={"a": 1.0, "b": 1.0, "c": 1.0},
        parameters=_around(mu=0.05, sigma=5e-5, delta=2e-2),
        end=0.4,
    ),
    Jumping(
        "cell_cycle",
        "J. J. Tyson, Modeling the cell division cycle: cdc2 and cyclin interactions, Proc. Natl. "
        "Acad. Sci. USA 88 (1991) 7328-7332 (two variables; values)",
        rates={"u": "k4*(v - u)*(1e-4 + u**2) - k6*u", "v": "k1 - k6*u"},
        initial={"u": 0.01, "v": 0.1},
        parameters={"k4": (144.0, 216.0), "k1": (0.0145, 0.0175), "k6": (0.9, 1.0)},
        end=120.0,
    ),
    Jumping(
        "li_rinzel",
        "Y.-X. Li and J. Rinzel, Equations for InsP3 receptor-mediated [Ca2+]i oscillations, J. "
        "Theor. Biol. 166 (1994) 461-473 (values)",
        rates={
            "c": "0.185*flux*(store - c) - v3*c**2/(0.01 + c**2)",
            "h": "0.2*(1.049*(p + 0.13)/(p + 0.9434)*(1 - h) - c*h)",
        },
        constants={
            "store": "(2 - c)/0.185",
            "flux": "6*(p/(p + 0.13)*c/(c + 0.08234)*h)**3 + 0.11",
        },
        initial={"c": 0.1, "h": 0.8},
        parameters={"p": (0.45, 0.55), "v3": (0.85, 0.95)},
        end=60.0,
    ),
    Jumping(
        "selkov",
        "E. E. Sel'kov, Self-oscillations in glycolysis, Eur. J. Biochem. 4 (1968) 79-86 (scaled; "
        "product faster by 20)",
        rates={"x": "(-x + a*y + x**2*y)/eps", "y": "b - a*y - x**2*y"},
        initial={"x": 0.5, "y": 1.0},
        parameters=_around(a=0.05, b=0.5, eps=0.05),
        end=25.0,
    ),
    Jumping(
        "thermal_explosion",
        "D. A. Frank-Kamenetskii, Diffusion and Heat Transfer in Chemical Kinetics, Plenum 1969 "
        "(a well-stirred vessel whose fuel is used up)",
        rates={
            "T": "c*exp(T/(1 + 0.05*T)) - a*T",
            "c": "-eps*c*exp(T/(1 + 0.05*T))",
        },
        initial={"c": 1.0},
        parameters=_around(a=1.5, eps=0.01),
        end=20.0,
    ),
    Jumping(
        "flame",
        "L. F. Shampine, I. Gladwell and S. Thompson, Solving ODEs with MATLAB, Cambridge 2003 (a "
        "ball of flame, after C. Moler)",
        rates={"y": "k*(y**2 - y**3)"},
        initial={"y": "d"},
        parameters=_around(k=1.0, d=1e-3),
        end=2000.0,
    ),
    Jumping(
        "scaled_oregonator",
        "J. J. Tyson and P. C. Fife, Target patterns in a realistic model of the "
        "Belousov-Zhabotinskii reaction, J. Chem. Phys. 73 (1980) 2224-2237 (without diffusion)",
        rates={"x": "(x*(1 - x) - f*z*(x - q)/(x + q))/eps", "z": "x - z"},
        initial={"x": 0.2, "z": 0.2},
        parameters=_around(eps=0.01, f=1.0, q=2e-3),
        end=12.0,
    ),
)
RELAXATION = {system.name: system for system in _SYSTEMS}
