"""``rankone fit FILE data.csv``: parameters from measured data."""

from __future__ import annotations

import argparse
import csv
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from rankone.share.commands.common import (
    FAILURE,
    PAIRS,
    SOLVED_HELP,
    SUCCESS,
    Commands,
    add_command,
    add_solve_arguments,
    display,
    finite_or_none,
    solution_of,
)
from rankone.support.budget import effort_of
from rankone.support.errors import OptionError
from rankone.support.wording import listing, quote

if TYPE_CHECKING:
    from rankone.inference.estimation.fit import Fit
    from rankone.inference.estimation.posterior import Posterior
    from rankone.tensors.bases.distributions import Distribution

T = TypeVar("T")

_SIGMA_HELP = "standard deviation of the noise, one or by unknown, numbers or expressions"
_NOISE_HELP = "kind of noise, one or by unknown: constant, proportional, combined, ..."
_OBSERVE_HELP = "columns to use, perhaps with what they are: signal='scale*x + offset'"
_DOSES_HELP = "the parameter that is the amount of a dose, and the column of amounts"
_BOUNDS_HELP = "interval of a parameter; SCALE is log"
_EFFORT_HELP = "low, normal (default), high or a factor on the budget of the solve and the starts"
_EXIT_HELP = """\
data: a table with commas; the first line names the columns: time (by the name it has in the
problem) and what was measured. Empty cells are missing values. Columns `condition` and `subject`
tell experiments apart, columns of parameters hold their values, `sigma` and `sigma_x` the
standard deviations. With --doses, rows of doses have an amount and no data.

exit status:
  0  nothing speaks against the fit
  1  something does; it is printed all the same
  2  bad input
"""


def register(commands: Commands) -> None:
    parser = add_command(
        commands,
        "fit",
        _fit,
        usage="rankone fit FILE DATA [options]",
        help="fit parameters to measured data",
        description="Fit parameters of a solution, or of a problem that is solved first, to data.",
        epilog=_EXIT_HELP,
    )
    add = parser.add_argument
    add("file", metavar="FILE", type=Path, help=SOLVED_HELP)
    add("data", metavar="DATA", type=Path, help="a .csv file (see below)")
    add("--observe", metavar="NAME[=EXPR]", **PAIRS, help=_OBSERVE_HELP)
    add("--sigma", metavar="S|NAME=S", nargs="+", help=_SIGMA_HELP)
    add("--noise", metavar="KIND|NAME=KIND", nargs="+", help=_NOISE_HELP)
    add("--doses", metavar="NAME=COLUMN", **PAIRS, help=_DOSES_HELP)
    for option, meaning in (("fixed", "parameters that are known"), ("start", "where to start")):
        add(f"--{option}", metavar="NAME=VALUE", **PAIRS, help=meaning)
    add(
        "--bounds",
        metavar="NAME=LOWER:UPPER[:SCALE]",
        **PAIRS,
        help=_BOUNDS_HELP,
    )
    add(
        "--prior",
        metavar="NAME=DISTRIBUTION",
        **PAIRS,
        help="what was known before, as in scipy.stats: k='norm(1, 0.1)'",
    )
    add("--level", type=float, default=0.95, help="level of intervals (default: %(default)g)")
    add("--posterior", action="store_true", help="the distribution of the parameters as well")
    add_solve_arguments(parser)
    add("--effort", metavar="E", type=effort_of, default="normal", help=_EFFORT_HELP)
    add("--json", action="store_true", help="print the result as JSON")


def _fit(arguments: argparse.Namespace) -> int:
    from rankone.inference.estimation.posterior import posterior_of
    from rankone.share.export.program import box_of, pairs_of

    solution = solution_of(arguments, effort=arguments.effort)
    table = _read(arguments.data)
    fit = solution.fit(
        table,
        observe=_observe(arguments.observe),
        sigma=_one_or_named("--sigma", arguments.sigma, _number_or_text),
        noise=_one_or_named("--noise", arguments.noise, str),
        fixed=pairs_of("--fixed", arguments.fixed, float),
        doses=pairs_of("--doses", arguments.doses, str, "--doses dose=amt") or None,
        start=pairs_of("--start", arguments.start, float) or None,
        bounds={k: tuple(ends) for k, ends in box_of(arguments.bounds, "--bounds").items()},
        prior=_priors(arguments.prior),
        level=arguments.level,
        effort=arguments.effort,
    )
    posterior = posterior_of(fit) if arguments.posterior else None
    if arguments.json:
        print(json.dumps(_plain(fit, posterior), indent=2, allow_nan=False))
    else:
        display(fit)
        if posterior is not None:
            display(posterior)
    return SUCCESS if fit.success else FAILURE


def _observe(texts: Sequence[str] | None) -> dict[str, str] | None:
    """What was measured, by the name of its column."""
    if texts is None:
        return None
    pairs = [text.partition("=") for text in texts]
    names = [name.strip() for name, _, _ in pairs]
    if len({*names}) < len(names):
        raise OptionError(f"--observe names an unknown twice: {listing(names)}", term=names)
    return {name: (right or name).strip() for name, (_, _, right) in zip(names, pairs, strict=True)}


def _priors(texts: Sequence[str] | None) -> dict[str, Distribution]:
    """Distributions by parameter: ``k=norm(loc=1, scale=0.1)``."""
    from rankone.tensors.bases.distributions import from_text

    priors = {}
    for text in texts or ():
        name, _, right = text.partition("=")
        if not name or not right:
            raise OptionError(f"--prior: {text!r} cannot be read", remedy="write k='norm(1, 0.1)'")
        priors[name.strip()] = from_text(right.strip())
    return priors


def _one_or_named(option: str, texts: Sequence[str] | None, read: Callable[[str], T]) -> Any:
    """One for all that was measured, one for each by name, or nothing."""
    from rankone.share.export.program import pairs_of

    if texts is None:
        return None
    if len(texts) > 1 or "=" in texts[0]:
        return pairs_of(option, texts, read)
    return read(texts[0])


def _number_or_text(text: str) -> float | str:
    """A number, or an expression."""
    try:
        return float(text)
    except ValueError:
        return text


def _read(file: Path) -> dict[str, list[str]]:
    """The columns of a table."""
    try:
        with file.open(newline="", encoding="utf-8-sig") as stream:
            reader = csv.reader(stream)
            lines = [(reader.line_num, row) for row in reader if any(map(str.strip, row))]
    except (OSError, ValueError, csv.Error) as reason:
        raise OptionError(f"{quote(file)} cannot be read: {reason}", term=str(file)) from None
    if not lines:
        raise OptionError(f"{quote(file)} is empty", term=str(file))
    header = [name.strip() for name in lines[0][1]]
    if len(header) == 1 and ";" in header[0]:
        raise OptionError(
            f"{quote(file)} has semicolons between its columns", remedy="write commas"
        )
    if len(set(header)) < len(header):
        raise OptionError(f"{quote(file)} names a column twice: {listing(header)}", term=header)
    for line, row in lines[1:]:
        if len(row) != len(header):
            raise OptionError(
                f"{quote(file)}, line {line}: {len(row)} cells for {len(header)} columns", term=row
            )
    return {name: [row[i].strip() for _, row in lines[1:]] for i, name in enumerate(header)}


def _ends(intervals: Mapping[str, tuple[float, float]]) -> dict[str, list[float | None]]:
    return {name: [*map(finite_or_none, ends)] for name, ends in intervals.items()}


def _plain(fit: Fit, posterior: Posterior | None) -> dict[str, object]:
    """The fit for JSON; numbers that are not finite are null."""
    more: dict[str, object] = {}
    if posterior is not None:
        more["posterior"] = {
            "success": posterior.success,
            "message": posterior.message,
            "mean": posterior.mean,
            "std": posterior.std,
            "interval": _ends(posterior.interval()),
        }
    return {
        "success": fit.success,
        "message": fit.message,
        "x": fit.x,
        "interval": _ends(fit.interval()),
        "level": fit.level,
        "std": {name: finite_or_none(deviation) for name, deviation in fit.std.items()},
        "identifiable": fit.identifiable,
        "limits": fit.limits,
        "combinations": {
            text: {
                "value": fit.value_of(text),
                "interval": [*map(finite_or_none, fit.interval_of(text))],
            }
            for text in fit.combinations
        },
        "fixed": fit.fixed,
        "experiments": [trial.name for trial in fit.trials],
        "observed": list(fit.observed),
        "data": fit.size,
        "dof": fit.dof,
        "chi2": fit.chi2,
        "sigma": finite_or_none(fit.sigma),
        "p_value": finite_or_none(fit.p_value),
        "log_likelihood": finite_or_none(fit.log_likelihood),
        "aic": finite_or_none(fit.aic),
        "bic": finite_or_none(fit.bic),
        "checks": list(fit.checks),
        **more,
    }
