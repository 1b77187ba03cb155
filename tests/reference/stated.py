"""Systems stated once, as text, and their trajectories by SciPy without anything of rankone.

The text is a right-hand side in Python's own syntax, so ``exec`` makes a function of plain floats
of it, and LSODA integrates each trajectory alone, every state resolved relative to its own size.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Self

import numpy as np
import scipy.integrate

from rankone import Problem, Solution
from tests.reference.measure import SEED, Array

__all__ = ["Stated", "around", "reactions"]

POINTS, TIMES, EARLY = 48, 21, 8
RTOL, NEGLIGIBLE = 1e-9, 1e-6
_NAME = re.compile(r"(?<![\w.])[A-Za-z_]\w*")
_PASSES = 3  # a state that starts from zero shows its size only when it is integrated
_MOST_STEPS = 200_000


@dataclass(frozen=True, eq=False)
class Stated:
    """A published system as text.

    Attributes
    ----------
    name, citation : str
        The citation is of the model; boxes and horizons are ours unless it says otherwise.
    rates : mapping of str to str
        The right-hand side of each state.
    initial : mapping of str to (str or float)
        Zero for states that are not named.
    parameters : mapping of str to (float, float)
    end : float
        The end of the horizon, which starts at 0.
    constants : mapping of str to (float or str)
        Numbers, or formulas of states, parameters, ``t`` and the constants before them.
    """

    name: str
    citation: str
    rates: Mapping[str, str]
    initial: Mapping[str, str | float]
    parameters: Mapping[str, tuple[float, float]]
    end: float
    constants: Mapping[str, float | str] = field(default_factory=dict)

    @classmethod
    def factor(
        cls,
        factor: float,
        varied: Sequence[str],
        *,
        constants: Mapping[str, float | str],
        **rest: object,
    ) -> Self:
        """A system some of whose constants vary by a factor up and down."""
        box = {
            name: (float(constants[name]) / factor, float(constants[name]) * factor)
            for name in varied
        }
        others = {name: text for name, text in constants.items() if name not in box}
        return cls(parameters=box, constants=others, **rest)  # type: ignore[arg-type]

    def problem(self) -> Problem:
        """The problem that rankone is given."""
        return Problem.from_strings(
            rhs={state: self._closed(rate) for state, rate in self.rates.items()},
            initial={
                state: self._closed(str(self.initial.get(state, 0.0))) for state in self.rates
            },
            parameters=dict(self.parameters),
            time=(0.0, self.end),
            name=self.name,
        )

    @cached_property
    def _formulas(self) -> dict[str, str]:
        formulas: dict[str, str] = {}
        for name, text in self.constants.items():
            formulas[name] = f"({_NAME.sub(lambda m: formulas.get(m[0], m[0]), str(text))})"
        return formulas

    def _closed(self, text: str) -> str:
        """A formula of states, parameters and time alone."""
        return _NAME.sub(lambda match: self._formulas.get(match[0], match[0]), text)

    @cached_property
    def functions(self) -> tuple[Callable[..., list[float]], Callable[..., list[float]]]:
        """``rhs(t, u, p)`` and ``initial(p)`` on plain floats."""
        names = "".join(f"    {name} = {text}\n" for name, text in self.constants.items())
        starts = {
            name: text
            for name, text in self.constants.items()
            if not set(_NAME.findall(str(text))) & {*self.rates, "t"}
        }
        starting = "".join(f"    {name} = {text}\n" for name, text in starts.items())
        first = ", ".join(str(self.initial.get(state, 0.0)) for state in self.rates)
        source = (
            f"def rhs(t, u_, p_):\n"
            f"    ({', '.join(self.parameters)},) = p_\n    ({', '.join(self.rates)},) = u_\n"
            f"{names}    return [{', '.join(self.rates.values())}]\n"
            f"def initial(p_):\n    ({', '.join(self.parameters)},) = p_\n"
            f"{starting}    return [{first}]\n"
        )
        namespace: dict[str, Callable[..., list[float]]] = {
            name: getattr(math, name) for name in ("exp", "log", "sqrt", "tanh", "sin", "cos", "pi")
        }
        exec(source, namespace)
        return namespace["rhs"], namespace["initial"]

    def points(self, count: int = POINTS) -> Array:
        """Random points (count, d), every second one in the logarithms of positive parameters."""
        generator = np.random.default_rng(SEED)
        lower, upper = np.array(list(self.parameters.values())).T
        points = generator.uniform(lower, upper, (count, lower.size))
        shares = generator.uniform(size=points.shape)
        ratio = np.where(lower > 0.0, upper / np.where(lower > 0.0, lower, 1.0), 1.0)
        scaled = np.where(lower > 0.0, lower * ratio**shares, points)
        points[::2] = scaled[::2]
        return points

    @cached_property
    def times(self) -> Array:
        """Evenly spaced times, and early ones for what happens at once."""
        early = self.end * np.geomspace(1e-5, 0.03, EARLY)
        return np.union1d(np.linspace(0.0, self.end, TIMES), early)

    def trajectory(self, point: Sequence[float], times: Array) -> Array:
        """States (n, T) of one trajectory at the times, which begin with 0."""
        rhs, initial = self.functions
        p = [float(x) for x in point]
        start = np.array(initial(p), dtype=float)
        sizes = np.where(start != 0.0, np.abs(start), np.abs(start).max(initial=0.0) or 1.0)
        for _ in range(_PASSES):
            states = self._integrated(rhs, p, start, times, RTOL * NEGLIGIBLE * sizes)
            largest = np.abs(states).max(axis=0)
            if np.all(largest >= 1e-3 * sizes):
                break
            sizes = np.where(largest > 0.0, largest, sizes)
        return np.asarray(states.T)

    def _integrated(
        self,
        rhs: Callable[..., list[float]],
        p: list[float],
        start: Array,
        times: Array,
        atol: Array,
    ) -> Array:
        """States (T, n) by LSODA, or by Radau where rates over many decades stop LSODA."""

        def rates(t: float, u: Array) -> list[float]:
            return rhs(t, u.tolist(), p)

        with warnings.catch_warnings():
            warnings.simplefilter("ignore", scipy.integrate.ODEintWarning)
            states, facts = scipy.integrate.odeint(
                rates,
                start,
                times,
                rtol=RTOL,
                atol=atol,
                mxstep=_MOST_STEPS,
                full_output=True,
                tfirst=True,
            )
        if facts["message"] == "Integration successful.":
            return np.asarray(states)
        span = float(times[0]), float(times[-1])
        options = {"method": "Radau", "rtol": RTOL, "atol": atol, "t_eval": times}
        second = scipy.integrate.solve_ivp(rates, span, start, **options)
        if not second.success:
            raise RuntimeError(f"{self.name}: {facts['message']} {second.message}")
        return np.asarray(second.y.T)

    @cached_property
    def exact(self) -> Array:
        """States (n, m, T) at the points and times."""
        return np.stack([self.trajectory(point, self.times) for point in self.points()], axis=1)

    @cached_property
    def sizes(self) -> Array:
        """The largest value of each unknown at the points and times, (n,)."""
        return np.asarray(np.abs(self.exact).max(axis=(1, 2)))

    def errors(self, solution: Solution) -> Array:
        """Largest error of each unknown over the unknown's size, (n,)."""
        points = self.points()
        of_names = dict(zip(self.parameters, points.T[..., None], strict=True))
        differences = np.abs(solution({**of_names, "t": self.times}) - self.exact)
        return np.asarray(differences.max(axis=(1, 2)) / self.sizes)


def around(factor: float, **centres: float) -> dict[str, tuple[float, float]]:
    """Intervals from a number divided by the factor to the number times the factor."""
    return {name: (x / factor, x * factor) for name, x in centres.items()}


def reactions(text: str, fixed: Sequence[str] = ()) -> dict[str, str]:
    """The rates of all species of a network, from a line for each reaction.

    ``A + 2 B = C : k`` is mass action, ``A = B : k, back`` the same both ways, and ``A -> B : law``
    has the rate that is written. Amounts of ``fixed`` species do not change.
    """
    changes: dict[str, list[str]] = {}
    for line in filter(None, (line.split("#")[0].strip() for line in text.splitlines())):
        sides, law = (part.strip() for part in line.split(":"))
        for left, right, rate in _directions(sides, law):
            for sign, side in (("-", left), ("+", right)):
                for amount, species in side:
                    terms = changes.setdefault(species, [])
                    terms.append(f"{sign} {amount:g}*{rate}" if amount != 1.0 else f"{sign} {rate}")
    return {species: " ".join(terms) for species, terms in changes.items() if species not in fixed}


def _directions(
    sides: str, law: str
) -> Iterator[tuple[list[tuple[float, str]], list[tuple[float, str]], str]]:
    """Both sides and the rate of a reaction, once for each direction."""
    written = "->" in sides
    left, right = (_side(side) for side in sides.split("->" if written else "="))
    if written:
        yield left, right, f"({law})"
        return
    forth, *back = (constant.strip() for constant in law.split(","))
    yield left, right, _mass_action(forth, left)
    if back:
        yield right, left, _mass_action(back[0], right)


def _side(text: str) -> list[tuple[float, str]]:
    """Amounts and species; a share of a species that is lost by a reaction is negative."""
    pairs = []
    for sign, amount, species in re.findall(r"([+-]?)\s*([\d.]*)\s*([A-Za-z_]\w*)", text):
        pairs.append((float(f"{sign}{amount or 1}"), species))
    return pairs


def _mass_action(constant: str, side: list[tuple[float, str]]) -> str:
    powers = [species if many == 1.0 else f"{species}**{many:g}" for many, species in side]
    return "*".join([f"({constant})", *powers])
