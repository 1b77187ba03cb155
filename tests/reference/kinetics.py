"""Published kinetic networks of 15 to 40 states that are stiff, three constants × and ÷ 1.5.

Stoichiometry and constants are those of the citations, unless it says what differs; horizons are
ours. Concentrations are in the units of the papers, or nanomolar.
"""

from __future__ import annotations

import itertools
import re
from math import exp, log

from tests.reference.published import _POLLU_RATES, _POLLU_REACTIONS, _POLLU_START
from tests.reference.stated import Stated, reactions

__all__ = ["KINETICS"]

_FACTOR = 1.5


def _network(
    name: str,
    citation: str,
    rates: dict[str, str],
    initial: dict[str, str | float],
    constants: dict[str, float | str],
    varied: str,
    end: float,
) -> Stated:
    return Stated.factor(
        _FACTOR,
        varied.split(),
        name=name,
        citation=citation,
        rates=rates,
        initial=initial,
        constants=constants,
        end=end,
    )


def _table(text: str) -> dict[str, float | str]:
    """Constants of a text such as ``k1=0.1 k2=3``."""
    pairs = (pair.split("=") for pair in text.split())
    return {name: float(number) for name, number in pairs}


# -- chemistry of the air -------------------------------------------------------------------------


def _pollu() -> Stated:
    lines = []
    for index, (used, made) in enumerate(_POLLU_REACTIONS, 1):
        left = " + ".join(f"y{i}" for i in used)
        right = " + ".join(f"{many} y{i}" for i, many in made.items())
        lines.append(f"{left} = {right} : k{index}")
    return _network(
        "pollu",
        "J. G. Verwer, Gauss-Seidel iteration for stiff ODEs from chemical kinetics, SIAM J. Sci. "
        "Comput. 15 (1994) 1243-1250 (values; problem POLLU of the Test Set for IVP Solvers)",
        reactions("\n".join(lines)),
        {f"y{i}": amount for i, amount in _POLLU_START.items()},
        {f"k{index}": rate for index, rate in enumerate(_POLLU_RATES, 1)},
        "k1 k2 k14",
        60.0,
    )


_CARBON_BOND = """
NO2 = NO + O : j1
O = O3 : 1.4e3*exp(1175/T)
O3 + NO = NO2 : c*1.8e-12*exp(-1370/T)
O + NO2 = NO : c*9.3e-12
O + NO2 = NO3 : c*1.6e-13*exp(687/T)
O + NO = NO2 : c*2.2e-13*exp(602/T)
O3 + NO2 = NO3 : c*1.2e-13*exp(-2450/T)
O3 = O : 0.04*j1
O3 = O1D : 2.8e-3*j1
O1D = O : 1.9e8*exp(390/T)
O1D = 2 OH : 2.2e-10*c*H2O
O3 + OH = HO2 : c*1.6e-12*exp(-940/T)
O3 + HO2 = OH : c*1.4e-14*exp(-580/T)
NO3 = 0.89 NO2 + 0.89 O + 0.11 NO : 15.5*j1
NO3 + NO = 2 NO2 : c*1.3e-11*exp(250/T)
NO3 + NO2 = NO + NO2 : c*2.5e-14*exp(-1230/T)
NO3 + NO2 = N2O5 : c*5.3e-13*exp(256/T)
N2O5 = 2 HNO3 : 1.3e-21*c*H2O
N2O5 = NO3 + NO2 : 3.5e14*exp(-10897/T)
2 NO = 2 NO2 : c*1.8e-20*exp(530/T)
NO + NO2 = 2 HONO : 4.4e-40*c*c*H2O
OH + NO = HONO : c*4.5e-13*exp(806/T)
HONO = OH + NO : 0.17*j1
OH + HONO = NO2 : c*6.6e-12
2 HONO = NO + NO2 : c*1.0e-20
OH + NO2 = HNO3 : kn*exp(713/T)
OH + HNO3 = NO3 : c*5.1e-15*exp(1000/T)
HO2 + NO = OH + NO2 : ko*exp(240/T)
HO2 + NO2 = PNA : c*1.2e-13*exp(749/T)
PNA = HO2 + NO2 : 4.8e13*exp(-10121/T)
OH + PNA = NO2 : c*1.3e-12*exp(380/T)
2 HO2 = H2O2 : c*5.9e-14*exp(1150/T)
2 HO2 = H2O2 : 2.2e-38*exp(5800/T)*c*c*H2O
H2O2 = 2 OH : 7.1e-4*j1
OH + H2O2 = HO2 : c*3.1e-12*exp(-187/T)
OH + CO = HO2 : c*2.2e-13
HCHO + OH = HO2 + CO : c*1.0e-11
HCHO = 2 HO2 + CO : 3.2e-3*j1
HCHO = CO : 4.2e-3*j1
HCHO + O = OH + HO2 + CO : c*3.0e-11*exp(-1550/T)
HCHO + NO3 = HNO3 + HO2 + CO : c*6.3e-16
ALD2 + O = C2O3 + OH : c*1.2e-11*exp(-986/T)
ALD2 + OH = C2O3 : c*7.0e-12*exp(250/T)
ALD2 + NO3 = C2O3 + HNO3 : c*2.5e-15
ALD2 = HCHO + XO2 + CO + 2 HO2 : 4.5e-4*j1
C2O3 + NO = HCHO + XO2 + HO2 + NO2 : c*5.4e-12*exp(250/T)
C2O3 + NO2 = PAN : c*8.0e-20*exp(5500/T)
PAN = C2O3 + NO2 : 9.4e16*exp(-14000/T)
2 C2O3 = 2 HCHO + 2 XO2 + 2 HO2 : c*2.0e-12
C2O3 + HO2 = 0.79 HCHO + 0.79 XO2 + 0.79 HO2 + 0.79 OH : c*6.5e-12
OH = HCHO + XO2 + HO2 : 110*exp(-1710/T)
PAR + OH = 0.87 XO2 + 0.13 XO2N + 0.11 HO2 + 0.11 ALD2 + 0.76 ROR - 0.11 PAR : c*8.1e-13
ROR = 1.1 ALD2 + 0.96 XO2 + 0.94 HO2 + 0.04 XO2N + 0.02 ROR - 2.1 PAR : 1e15*exp(-8000/T)
ROR = HO2 : 1600
ROR + NO2 = PROD : c*1.5e-11
O + OLE = 0.63 ALD2 + 0.38 HO2 + 0.28 XO2 + 0.3 CO + 0.2 HCHO + 0.02 XO2N \
  + 0.22 PAR + 0.2 OH : c*1.2e-11*exp(-324/T)
OH + OLE = HCHO + ALD2 + XO2 + HO2 - PAR : c*5.2e-12*exp(504/T)
O3 + OLE = 0.5 ALD2 + 0.74 HCHO + 0.33 CO + 0.44 HO2 \
  + 0.22 XO2 + 0.1 OH - PAR : c*1.4e-14*exp(-2105/T)
NO3 + OLE = 0.91 XO2 + HCHO + ALD2 + 0.09 XO2N + NO2 - PAR : c*7.7e-15
O + ETH = HCHO + 0.7 XO2 + CO + 1.7 HO2 + 0.3 OH : c*1.0e-11*exp(-792/T)
OH + ETH = XO2 + 1.56 HCHO + HO2 + 0.22 ALD2 : c*2.0e-12*exp(411/T)
O3 + ETH = HCHO + 0.42 CO + 0.12 HO2 : c*1.3e-14*exp(-2633/T)
OH + TOL = 0.08 XO2 + 0.36 CRES + 0.44 HO2 + 0.56 TO2 : c*2.1e-12*exp(322/T)
TO2 + NO = 0.9 NO2 + 0.9 OPEN + 0.9 HO2 : c*8.1e-12
TO2 = HO2 + CRES : 4.2
OH + CRES = 0.4 CRO + 0.6 XO2 + 0.6 HO2 + 0.3 OPEN : c*4.1e-11
NO3 + CRES = CRO + HNO3 : c*2.2e-11
CRO + NO2 = PROD : c*1.4e-11
OH + XYL = 0.7 HO2 + 0.5 XO2 + 0.2 CRES + 0.8 MGLY + 1.1 PAR + 0.3 TO2 : c*1.7e-11*exp(116/T)
OH + OPEN = XO2 + C2O3 + 2 HO2 + 2 CO + HCHO : c*3.0e-11
OPEN = C2O3 + CO + HO2 : 6.0e-3*j1
O3 + OPEN = 0.03 ALD2 + 0.62 C2O3 + 0.7 HCHO + 0.03 XO2 + 0.69 CO \
  + 0.08 OH + 0.76 HO2 + 0.2 MGLY : c*5.4e-17*exp(-500/T)
OH + MGLY = XO2 + C2O3 : c*1.7e-11
MGLY = C2O3 + CO + HO2 : 1.86e-2*j1
O + ISOP = 0.6 HO2 + 0.8 ALD2 + 0.55 OLE + 0.5 XO2 + 0.5 CO + 0.45 ETH + 0.9 PAR : c*1.8e-11
OH + ISOP = HCHO + XO2 + 0.67 HO2 + 0.4 MGLY + 0.2 C2O3 + ETH + 0.2 ALD2 + 0.13 XO2N : c*9.6e-11
O3 + ISOP = HCHO + 0.4 ALD2 + 0.55 ETH + 0.2 MGLY + 0.06 CO + 0.1 PAR \
  + 0.44 HO2 + 0.1 OH : c*1.2e-17
NO3 + ISOP = XO2N : c*3.2e-13
XO2 + NO = NO2 : c*8.1e-12
2 XO2 = PROD : c*1.7e-14*exp(1300/T)
XO2N + NO = PROD : c*6.8e-13
"""


def _at_temperature(text: str, kelvin: float) -> str:
    return re.sub(r"exp\((-?\d+)/T\)", lambda match: repr(exp(float(match[1]) / kelvin)), text)


def _carbon_bond() -> Stated:
    per_ppb = 2.4476e13
    return _network(
        "carbon_bond",
        "M. W. Gery, G. Z. Whitten, J. P. Killus and M. C. Dodge, A photochemical kinetics "
        "mechanism for urban and regional scale computer modeling, J. Geophys. Res. 94 (1989) "
        "12925-12956 (CBM-IV as A. Sandu et al. used it, Atmos. Environ. 31 (1997) 3151-3166: "
        "a box at 298 K, here with constant sunlight)",
        reactions(_at_temperature(_CARBON_BOND, 298.0), fixed=["PROD"]),
        _table(
            "NO=50 NO2=20 HONO=1 O3=100 HCHO=10 ALD2=10 PAN=1 PAR=50 OLE=10 ETH=10 TOL=10 XYL=10 "
            "ISOP=10 CO=300"
        ),
        {
            "c": per_ppb,
            "H2O": 1.25e7,
            "j1": 8.89e-3,
            "kn": 1.0e-12 * per_ppb,
            "ko": 3.7e-12 * per_ppb,
        },
        "j1 kn ko",
        7200.0,
    )


# -- signals --------------------------------------------------------------------------------------

_CASCADE = """
K + E1 = KE1 : a1, d1
KE1 = Kp + E1 : k1
Kp + E2 = KpE2 : a2, d2
KpE2 = K + E2 : k2
M + Kp = MKp : a3, d3
MKp = Mp + Kp : k3
Mp + MP = MpMP : a4, d4
MpMP = M + MP : k4
Mp + Kp = MpKp : a5, d5
MpKp = Mpp + Kp : k5
Mpp + MP = MppMP : a6, d6
MppMP = Mp + MP : k6
R + Mpp = RMpp : a7, d7
RMpp = Rp + Mpp : k7
Rp + RP = RpRP : a8, d8
RpRP = R + RP : k8
Rp + Mpp = RpMpp : a9, d9
RpMpp = Rpp + Mpp : k9
Rpp + RP = RppRP : a10, d10
RppRP = Rp + RP : k10
"""


def _huang_ferrell() -> Stated:
    rates = {
        f"{letter}{i}": rate
        for letter, rate in (("a", 1e3), ("d", 150.0), ("k", 150.0))
        for i in range(1, 11)
    }
    return _network(
        "huang_ferrell",
        "C.-Y. F. Huang and J. E. Ferrell, Ultrasensitivity in the mitogen-activated protein "
        "kinase cascade, Proc. Natl. Acad. Sci. USA 93 (1996) 10078-10083 (values, in micromolar)",
        reactions(_CASCADE),
        {"E1": "e1", "E2": "e2", "K": 3e-3, "M": 1.2, "MP": 3e-4, "R": 1.2, "RP": "rp"},
        {**rates, "e1": 3e-5, "e2": 3e-4, "rp": 0.12},
        "e1 e2 rp",
        100.0,
    )


def _levchenko() -> Stated:
    table = {
        "a": (1, 0.5, 3.3, 10, 3.3, 10, 20, 5, 20, 5),
        "d": (0.4, 0.5, 0.42, 0.8, 0.4, 0.8, 0.6, 0.4, 0.6, 0.4),
    }
    rates = {
        f"{letter}{i}": float(rate)
        for letter, row in table.items()
        for i, rate in enumerate(row, 1)
    }
    return _network(
        "levchenko",
        "A. Levchenko, J. Bruck and P. W. Sternberg, Scaffold proteins may biphasically affect "
        "the levels of mitogen-activated protein kinase signaling, Proc. Natl. Acad. Sci. USA 97 "
        "(2000) 5818-5823 (values; the cascade without scaffold)",
        reactions(_CASCADE),
        {"E1": 0.1, "E2": 0.3, "K": 0.4, "M": 0.2, "MP": 0.2, "R": 0.4, "RP": 0.3},
        {**rates, **{f"k{i}": 0.1 for i in range(1, 11)}},
        "k1 k3 a9",
        300.0,
    )


_GROWTH_FACTOR = """
R + EGF = Ra : 0.003, 0.06
2 Ra = R2 : 0.01, 0.1
R2 = RP : 1, 0.01
RP -> R2 : v4*RP/(50 + RP)
RP + PLC = RPL : 0.06, 0.2
RPL = RPLP : 1, 0.05
RPLP = RP + PLCP : 0.3, 0.006
PLCP -> PLC : PLCP/(100 + PLCP)
RP + Grb = RG : 0.003, 0.05
RG + SOS = RGS : 0.01, 0.06
RGS = RP + GS : 0.03, 4.5e-3
GS = Grb + SOS : 1.5e-3, 1e-4
RP + Shc = RSh : k13, 0.6
RSh = RShP : 6, 0.06
RShP = RP + ShP : 0.3, 9e-4
ShP -> Shc : v16*ShP/(340 + ShP)
RShP + Grb = RShG : 0.003, 0.1
RShG = RP + ShG : 0.3, 9e-4
RShG + SOS = RShGS : 0.01, 2.14e-2
RShGS = RP + ShGS : 0.12, 2.4e-4
ShP + Grb = ShG : 0.003, 0.1
ShG + SOS = ShGS : 0.03, 0.064
ShGS = ShP + GS : 0.1, 0.021
RShP + GS = RShGS : 0.009, 4.29e-2
PLCP = PLCI : 1, 0.03
"""


def _kholodenko() -> Stated:
    return _network(
        "growth_factor",
        "B. N. Kholodenko, O. V. Demin, G. Moehren and J. B. Hoek, Quantification of short term "
        "signaling by the epidermal growth factor receptor, J. Biol. Chem. 274 (1999) 30169-30181 "
        "(values)",
        reactions(_GROWTH_FACTOR),
        {"EGF": 680.0, "R": 100.0, "PLC": 105.0, "Grb": 85.0, "SOS": 34.0, "Shc": 150.0},
        {"v4": 450.0, "k13": 0.09, "v16": 1.7},
        "v4 k13 v16",
        120.0,
    )


def _lipniacki() -> Stated:
    constants = _table(
        "kprod=2.5e-5 kdeg=1.25e-4 k1=2.5e-3 k2=0.1 k3=1.5e-3 a1=0.5 a2=0.2 a3=1 t1=0.1 t2=0.1 "
        "kv=5 c1=5e-7 c3=4e-4 c4=0.5 c5=3e-4 c5a=1e-4 c6a=2e-5 i1=2.5e-3 e1a=5e-4 i1a=1e-3 e2a=1e-2"
    )
    rates = {
        "IKKn": "kprod - kdeg*IKKn - k1*IKKn",
        "IKKa": "k1*IKKn - k3*IKKa - kdeg*IKKa - k2*IKKa*A20 - a2*IKKa*IkB + t1*IKKIkB "
        "- a3*IKKa*Cp + t2*IKKCp",
        "IKKi": "k3*IKKa - kdeg*IKKi + k2*IKKa*A20",
        "IKKIkB": "a2*IKKa*IkB - t1*IKKIkB",
        "IKKCp": "a3*IKKa*Cp - t2*IKKCp",
        "NF": "c6a*Cp - a1*NF*IkB + t2*IKKCp - i1*NF",
        "NFn": "i1*kv*NF - a1*IkBn*NFn",
        "A20": "c4*A20t - c5*A20",
        "A20t": "c1*NFn - c3*A20t",
        "IkB": "-a2*IKKa*IkB - a1*IkB*NF + c4*IkBt - c5a*IkB - i1a*IkB + e1a*IkBn",
        "IkBn": "-a1*IkBn*NFn + i1a*kv*IkB - e1a*kv*IkBn",
        "IkBt": "c1*NFn - c3*IkBt",
        "Cp": "a1*IkB*NF - c6a*Cp - a3*IKKa*Cp + e2a*Cpn",
        "Cpn": "a1*IkBn*NFn - e2a*kv*Cpn",
        "cgen": "c1*NFn - c3*cgen",
    }
    return _network(
        "nf_kappa_b",
        "T. Lipniacki, P. Paszek, A. R. Brasier, B. Luxon and M. Kimmel, Mathematical model of "
        "NF-kappaB regulatory module, J. Theor. Biol. 228 (2004) 195-215 (values; stimulated from "
        "the start, from a rounded resting state)",
        rates,
        {"IKKn": 0.2, "Cp": 0.059, "NFn": 3e-4, "IkB": 2.5e-3, "IkBn": 3.4e-3, "A20": 4.8e-3}
        | {"A20t": 3e-6, "IkBt": 3e-6, "cgen": 3e-6, "NF": 1e-4},
        constants,
        "k3 i1 c5",
        3.6e4,
    )


def _wnt() -> Stated:
    text = """
    X1 = X2 : k1, k2
    X4 -> X5 + X6 : k3*X2*X4
    X4 = X3 : k4, k5
    X5 + X6 = X4 : k6, km6
    X7 + X12 = X6 : b, 50*b
    X3 + X11 = X8 : b, 120*b
    X8 = X9 : k9
    X9 = X3 + X10 : 206
    X11 + X13 = X14 : b, 30*b
    X7 + X11 = X15 : b, 1200*b
    """
    rates = reactions(text)
    rates["X10"] += " - 0.417*X10"
    rates["X11"] += " + 0.423 - 2.57e-4*X11"
    rates["X12"] += " + 8.22e-5 - 0.167*X12"
    return _network(
        "wnt",
        "E. Lee, A. Salic, R. Krueger, R. Heinrich and M. W. Kirschner, The roles of APC and axin "
        "derived from experimental and theoretical analysis of the Wnt pathway, PLoS Biol. 1 "
        "(2003) e10 (values, nM and min; binding in equilibrium there is fast here, 10/nM/min)",
        rates,
        {"X1": 100.0, "X5": 50.0, "X7": 100.0, "X13": 15.0, "X11": 25.0, "X12": 1e-3},
        _table("k1=0.182 k2=1.82e-2 k3=5e-2 k4=0.267 k5=0.133 k6=9.09e-2 km6=0.909 b=10 k9=206"),
        "k4 k6 k9",
        600.0,
    )


def _phosphorylation_sites(sites: int = 5) -> Stated:
    lines = []
    for i in range(sites):
        lines += [
            f"S{i} + E = S{i}E : a, b",
            f"S{i}E = S{i + 1} + E : k",
            f"S{i + 1} + F = S{i + 1}F : a, b",
            f"S{i + 1}F = S{i} + F : f",
        ]
    return _network(
        "sites",
        "M. Thomson and J. Gunawardena, Unlimited multistability in multisite phosphorylation "
        "systems, Nature 460 (2009) 274-277 (five sites; the same constants at each, ours)",
        reactions("\n".join(lines)),
        {"S0": 10.0, "E": 0.5, "F": 0.4},
        _table("a=100 b=50 k=1 f=0.8"),
        "a k f",
        100.0,
    )


# -- blood, growth, decay -------------------------------------------------------------------------

_COAGULATION = """
TF + VII = TFVII : 3.2e-3, 3.1e-3
TF + VIIa = TFVIIa : 2.3e-2, 3.1e-3
TFVIIa + VII = TFVIIa + VIIa : 4.4e-4
Xa + VII = Xa + VIIa : 1.3e-2
IIa + VII = IIa + VIIa : 2.3e-5
TFVIIa + X = TFVIIaX : 2.5e-2, 1.05
TFVIIaX = TFVIIaXa : 6
TFVIIa + Xa = TFVIIaXa : 2.2e-2, 19
TFVIIa + IX = TFVIIaIX : 1e-2, 2.4
TFVIIaIX = TFVIIa + IXa : 1.8
Xa + II = Xa + IIa : 7.5e-6
IIa + VIII = IIa + VIIIa : 2e-2
VIIIa + IXa = IXaVIIIa : 1e-2, 5e-3
IXaVIIIa + X = IXaVIIIaX : 0.1, 1e-3
IXaVIIIaX = IXaVIIIa + Xa : k22
VIIIa = VIIIa1 + VIIIa2 : 6e-3, 2.2e-5
IXaVIIIaX = VIIIa1 + VIIIa2 + X + IXa : 1e-3
IXaVIIIa = VIIIa1 + VIIIa2 + IXa : 1e-3
IIa + V = IIa + Va : 2e-2
Xa + Va = XaVa : 0.4, 0.2
XaVa + II = XaVaII : 0.1, 103
XaVaII = XaVa + mIIa : k31
mIIa + XaVa = IIa + XaVa : 1.5e-2
Xa + TFPI = XaTFPI : 9e-4, 3.6e-4
TFVIIaXa + TFPI = TFVIIaXaTFPI : 0.32, 1.1e-4
TFVIIa + XaTFPI = TFVIIaXaTFPI : 5e-2
Xa + AT = XaAT : 1.5e-6
mIIa + AT = mIIaAT : 7.1e-6
IXa + AT = IXaAT : 4.9e-7
IIa + AT = IIaAT : k41
TFVIIa + AT = TFVIIaAT : 2.3e-7
"""


def _coagulation() -> Stated:
    return _network(
        "coagulation",
        "M. F. Hockin, K. C. Jones, S. J. Everse and K. G. Mann, A model for the stoichiometric "
        "regulation of blood coagulation, J. Biol. Chem. 277 (2002) 18322-18333 (values, 25 pM "
        "tissue factor)",
        reactions(_COAGULATION),
        {"TF": 0.025, "VII": 10.0, "VIIa": 0.1, "X": 160.0, "IX": 90.0, "II": 1400.0}
        | {"VIII": 0.7, "V": 20.0, "TFPI": 2.5, "AT": 3400.0},
        {"k22": 8.2, "k31": 63.5, "k41": 7.1e-6},
        "k22 k31 k41",
        700.0,
    )


def _clusters(largest: int = 20) -> Stated:
    lines = [f"2 c1 -> c2 : c1*c1 - loss*{_loss(2)}*c2"]
    for r in range(2, largest):
        lines.append(
            f"c1 + c{r} -> c{r + 1} : {r ** (1 / 3)!r}*c1*c{r} - loss*{_loss(r + 1)}*c{r + 1}"
        )
    return _network(
        "clusters",
        "R. Becker and W. Döring, Kinetische Behandlung der Keimbildung in übersättigten Dämpfen, "
        "Ann. Phys. 416 (1935) 719-752; rates of O. Penrose, Commun. Math. Phys. 124 (1989) "
        "515-541 (up to 20 particles)",
        reactions("\n".join(lines)),
        {"c1": "total"},
        _table("loss=1 zs=0.05 q=0.3 total=1"),
        "loss q total",
        300.0,
    )


def _loss(size: int) -> str:
    return f"{size ** (1 / 3)!r}*(zs + q*{size ** (-1 / 3)!r})"


_HALF_LIVES = {
    "U238": 4.468e9,
    "Th234": 24.10 / 365.25,
    "Pa234": 1.159 / 525_960,
    "U234": 2.455e5,
    "Th230": 7.54e4,
    "Ra226": 1600.0,
    "Rn222": 3.8235 / 365.25,
    "Po218": 3.098 / 525_960,
    "Pb214": 26.8 / 525_960,
    "Bi214": 19.9 / 525_960,
    "Po214": 164.3e-6 / 31_557_600,
    "Pb210": 22.2,
    "Bi210": 5.012 / 365.25,
    "Po210": 138.376 / 365.25,
}
"""In years: 14 nuclides of the uranium series."""


def _uranium() -> Stated:
    nuclides = [*_HALF_LIVES, "Pb206"]
    lines = [f"{a} = {b} : l{a}" for a, b in itertools.pairwise(nuclides)]
    return _network(
        "uranium_series",
        "H. Bateman, Solution of a system of differential equations occurring in the theory of "
        "radioactive transformations, Proc. Camb. Phil. Soc. 15 (1910) 423-427 (half-lives of "
        "NUBASE)",
        reactions("\n".join(lines)),
        {"U238": 1.0},
        {f"l{name}": log(2.0) / years for name, years in _HALF_LIVES.items()},
        "lU234 lRa226 lPb210",
        1e4,
    )


_SLUDGE = ("SI", "SS", "XI", "XS", "XBH", "XBA", "XP", "SO", "SNO", "SNH", "SND", "XND", "SALK")
_INFLUENT = dict(
    zip(_SLUDGE, (30, 69.5, 51.2, 202.32, 28.17, 0, 0, 0, 0, 31.56, 6.95, 10.59, 7), strict=True)
)


def _activated_sludge() -> Stated:
    rates: dict[str, str] = {}
    constants = _table(
        "muH=4 KS=10 KOH=0.2 KNO=0.5 bH=0.3 ng=0.8 nh=0.8 kh=3 KX=0.1 muA=0.5 KNH=1 bA=0.05 "
        "KOA=0.4 ka=0.05 YA=0.24 YH=0.67 fP=0.08 iB=0.08 iP=0.06 kLa=240 waste=0.03"
    )
    for tank, other, volume in ((1, 2, 2000.0), (2, 1, 4000.0)):
        for name, text in _sludge_processes(tank).items():
            constants[name] = text
        for state, terms in _sludge_terms(tank).items():
            flow, back = 18446.0 / volume, 3.0 * 18446.0 / volume
            held = state.startswith("X") and tank == 2
            out = f"{flow!r}*waste*{state}{tank}" if held else f"{flow!r}*{state}{tank}"
            feed = f"{flow!r}*{_INFLUENT[state]!r}" if tank == 1 else f"{flow!r}*{state}1"
            mixing = f"{back!r}*({state}{other} - {state}{tank})"
            rates[f"{state}{tank}"] = f"{feed} - {out} + {mixing} {terms}"
    rates["SO2"] += " + kLa*(8 - SO2)"
    start = (30, 2, 1100, 80, 2500, 150, 450, 1, 6, 6, 1, 5, 5)
    return _network(
        "activated_sludge",
        "M. Henze, C. P. L. Grady, W. Gujer, G. v. R. Marais and T. Matsuo, Activated Sludge "
        "Model No. 1, IAWPRC 1987; values and influent of J. B. Copp, The COST Simulation "
        "Benchmark, 2002 (one anoxic and one aerated tank, an ideal settler)",
        rates,
        {
            f"{state}{tank}": float(x)
            for tank in (1, 2)
            for state, x in zip(_SLUDGE, start, strict=True)
        },
        constants,
        "muH muA kLa",
        2.0,
    )


def _sludge_processes(i: int) -> dict[str, str]:
    return {
        f"p{i}1": f"muH*SS{i}/(KS + SS{i})*SO{i}/(KOH + SO{i})*XBH{i}",
        f"p{i}2": f"muH*SS{i}/(KS + SS{i})*KOH/(KOH + SO{i})*SNO{i}/(KNO + SNO{i})*ng*XBH{i}",
        f"p{i}3": f"muA*SNH{i}/(KNH + SNH{i})*SO{i}/(KOA + SO{i})*XBA{i}",
        f"p{i}4": f"bH*XBH{i}",
        f"p{i}5": f"bA*XBA{i}",
        f"p{i}6": f"ka*SND{i}*XBH{i}",
        f"p{i}7": f"kh*XS{i}/(KX*XBH{i} + XS{i})"
        f"*(SO{i}/(KOH + SO{i}) + nh*KOH/(KOH + SO{i})*SNO{i}/(KNO + SNO{i}))*XBH{i}",
        f"p{i}8": f"p{i}7*XND{i}/XS{i}",
    }


def _sludge_terms(i: int) -> dict[str, str]:
    def p(index: int) -> str:
        return f"p{i}{index}"

    return {
        "SI": "",
        "SS": f"- ({p(1)} + {p(2)})/YH + {p(7)}",
        "XI": "",
        "XS": f"+ (1 - fP)*({p(4)} + {p(5)}) - {p(7)}",
        "XBH": f"+ {p(1)} + {p(2)} - {p(4)}",
        "XBA": f"+ {p(3)} - {p(5)}",
        "XP": f"+ fP*({p(4)} + {p(5)})",
        "SO": f"- (1 - YH)/YH*{p(1)} - (4.57 - YA)/YA*{p(3)}",
        "SNO": f"- (1 - YH)/(2.86*YH)*{p(2)} + {p(3)}/YA",
        "SNH": f"- iB*({p(1)} + {p(2)}) - (iB + 1/YA)*{p(3)} + {p(6)}",
        "SND": f"- {p(6)} + {p(8)}",
        "XND": f"+ (iB - fP*iP)*({p(4)} + {p(5)}) - {p(8)}",
        "SALK": f"- iB/14*{p(1)} + ((1 - YH)/(14*2.86*YH) - iB/14)*{p(2)} "
        f"- (iB/14 + 1/(7*YA))*{p(3)} + {p(6)}/14",
    }


_SYSTEMS = (
    _pollu(),
    _carbon_bond(),
    _huang_ferrell(),
    _levchenko(),
    _kholodenko(),
    _lipniacki(),
    _wnt(),
    _phosphorylation_sites(),
    _coagulation(),
    _clusters(),
    _uranium(),
    _activated_sludge(),
)
KINETICS = {system.name: system for system in _SYSTEMS}
