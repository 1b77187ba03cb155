"""How often printed 95 % intervals hold the true values, and what carries a label instead.

    python -m tests.benchmarks.intervals [--only NAME] [--count N] [--calibrations N]
                                         [--method profile|linear] [--processes N] [--noises N]

The twelve designs of tests/reference/designs.py are solved once each and fitted to 400 data sets.
For each parameter are printed: what the data say of it; how many intervals were printed, and the
share of these that hold the truth, with the exact binomial limits of 95 %; the share with a label
instead of an interval, and with words beside it; and the share of intervals without a word beside
them that are as short as if what the data do not determine were known, while a brute force over the
box finds values farther out ("held"). Combinations have rows of their own. Then the same of
`ro.calibrate`, from wide bounds, and with --noises the designs of
tests/inference/estimation/experiments.py, where the noise is estimated as well.

Bars: determined parameters cover in 91 to 98.5 % and carry no label; limited ones cover in 91 % or
more and have no label instead of an interval; printed intervals of undetermined ones cover in 91 %
or more; none is held. With fewer than 400 data sets, "?" says that the binomial limits alone reach
the bar.
"""

from __future__ import annotations

import argparse
import re
import time
from collections import Counter, defaultdict
from concurrent.futures import ProcessPoolExecutor
from functools import partial

import numpy as np
import scipy.optimize
import scipy.stats

import rankone as ro
from tests.inference.estimation.experiments import DESIGNS as NOISES
from tests.inference.estimation.experiments import TRUE
from tests.reference.designs import DESIGNS, SETS, WIDE

LEAST, MOST = 0.91, 0.985
NORMAL = float(scipy.stats.norm.ppf(0.975))
# Ratio of marginal and conditional deviations from which a held interval can be told
TOLD_APART = 1.3
RARE = 0.2  # Share of the data sets below which combinations share a row
ROW = re.compile(r"\s+(\S+)\s+(?:[-+\d.]\S*|-?inf|nan)?\s*(\[([^,\]]+), ([^\]]+)\])?(.*)$")


def problem_of(design):
    return ro.Problem.from_strings(
        dict(design.rates), dict(design.initial), dict(design.box), (0, design.end)
    )


def printed_rows(text):
    """What a printed table says of each name: the interval, or None, and the words beside it."""
    rows = {}
    for line in text.splitlines():
        match = ROW.match(line)
        if match and match[1] not in ("success:", "no", "note:", "parameter"):
            interval = (_number(match[3]), _number(match[4])) if match[2] else None
            rows[match[1]] = interval, match[5].strip()
    return rows


def _number(text):
    try:
        return float(text)
    except ValueError:
        return np.nan


def of_fit(fit, method):
    """For each parameter and combination the interval, or None, and a label, or nothing."""
    printed = printed_rows(str(fit))
    said = {}
    for name, interval in fit.interval(0.95, method=method).items():
        words = printed.get(name, (None, ""))[1]
        without = not fit.identifiable[name] or not np.isfinite(interval).any()
        said[name] = (None if without else interval, words)
    for name in fit.combinations:
        said[name] = (fit.interval_of(name, 0.95), "")
    return said, fit.success


def of_calibration(calibration):
    """The same as printed by a calibration; a success whose own fit is none is a false one."""
    said = {}
    for name, (interval, words) in printed_rows(str(calibration)).items():
        finite = interval is not None and np.isfinite(interval).any()
        said[name] = (interval if finite else None, words)
        if interval is not None and not finite and calibration.success:
            said[name] = (None, "infinite, in a success")
    false = calibration.success and calibration.fit is not None and not calibration.fit.success
    return said, "false" if false else calibration.success


def covers(interval, truth):
    low, high = interval
    return (not low > truth) and (not high < truth)


def is_held(design, data, name, interval):
    """Whether other values in the box let the parameter go much farther than the interval says.

    A brute force judges: at each end inside the box, the curve of the design is fitted to the data
    with the parameter held there, from many starts. The root of the rise of chi2 is the normal
    quantile at an end of a profile; it is less by the ratio of marginal and conditional deviations
    where the undetermined parameters were held. Halfway, on a logarithmic scale, lies the limit.
    The expected deviations tell only where to look: those of one data set differ widely, as
    where its estimate of an undetermined parameter is in a part of the box that changes nothing.
    """
    inner, marginal = design.conditional.get(name), design.marginal.get(name)
    if inner is None or marginal < TOLD_APART * inner or not np.isfinite(interval).all():
        return False
    if min(interval) <= 0.0 and len(design.box[name]) == 3:
        return False
    low, high = (design.place(name, end) for end in interval)
    if (high - low) / (2.0 * NORMAL) > marginal:
        return False
    least = least_chi2(design, data)
    limit = NORMAL * np.sqrt(inner / marginal)
    rises = [least_chi2(design, data, {name: z}) - least for z in (low, high) if 0.0 < z < 1.0]
    return any(rise < limit**2 for rise in rises)


def least_chi2(design, data, held=()):
    """The least chi2 in the box, by the closed form alone; ``held`` are places of parameters."""
    held = dict(held)
    free = [name for name in design.box if name not in held]

    def residuals(z):
        places = {**held, **dict(zip(free, z, strict=True))}
        at = {name: design.value(name, place) for name, place in places.items()}
        return (design.curve(design.times, **at) - data) / design.sigma

    if not free:
        return float(np.sum(residuals([]) ** 2))
    truth = [design.place(name, design.truth[name]) for name in free]
    starts = [np.clip(truth, 0.01, 0.99), *np.random.default_rng(0).random((8, len(free)))]
    ends = [scipy.optimize.least_squares(residuals, z, bounds=(0.0, 1.0)) for z in starts]
    return 2.0 * min(end.cost for end in ends)


def value_of(text, truth):
    return float(eval(text, {"__builtins__": {}}, dict(truth)))


def counted(design, outcomes):
    """Counts for each name, over what was said of the data sets in order."""
    counts, whole = defaultdict(Counter), Counter()
    for k, (said, success) in enumerate(outcomes):
        whole["success"] += success is True
        whole["false success"] += success == "false"
        for name, (interval, words) in said.items():
            own = counts[name]
            truth = design.truth.get(name)
            truth = value_of(name, design.truth) if truth is None else truth
            own["beside"] += bool(words) and interval is not None
            own["instead"] += interval is None
            own["infinite"] += words.startswith("infinite")
            if interval is not None:
                own["printed"] += 1
                own["covers"] += covers(interval, truth)
                own["held"] += not words and is_held(design, design.data(k), name, interval)
    return counts, whole


def limits(k, n):
    """Exact binomial limits of 95 %."""
    low = scipy.stats.beta.ppf(0.025, k, n - k + 1) if k else 0.0
    high = scipy.stats.beta.ppf(0.975, k + 1, n - k) if k < n else 1.0
    return float(low), float(high)


def verdict(says, own):
    """What a row misses, and whether that is sure."""
    missed, n = [], own["printed"]
    most = MOST if says == "determined" else 1.0
    if n:
        share, (low, high) = own["covers"] / n, limits(own["covers"], n)
        if not LEAST <= share <= most:
            sure = n >= SETS or high < LEAST or low > most
            missed.append("covers" if sure else "covers?")
    if own["instead"] and says in ("determined", "limited"):
        missed.append("label instead")
    if own["beside"] and says == "determined":
        missed.append("label beside")
    missed += [word for word in ("held", "infinite") if own[word]]
    return missed


def lines_of(design, outcomes):
    """The table of a design, and the number of rows that miss a bar."""
    counts, whole = counted(design, outcomes)
    n, failures = len(outcomes), 0
    combined = [name for name in counts if name not in design.box]
    for name in combined:
        if counts[name]["printed"] < RARE * n:
            counts["others"] += counts.pop(name)
    names = [*design.box, *(name for name in counts if name not in design.box)]
    for name in names:
        own = counts[name]
        says = design.says(name) if name in design.box else "combination"
        missed = verdict("limited" if says == "combination" else says, own)
        failures += any(not each.endswith("?") for each in missed)
        shares = "    -               "
        if own["printed"]:
            low, high = limits(own["covers"], own["printed"])
            share = own["covers"] / own["printed"]
            shares = f"{100 * share:5.1f} [{100 * low:5.1f}, {100 * high:5.1f}]"
        yield (
            (
                f"  {name:12} {says:12} {own['printed']:4} of {n}: {shares}  "
                f"instead {100 * own['instead'] / n:5.1f}  beside {100 * own['beside'] / n:5.1f}  "
                f"held {100 * own['held'] / n:5.1f}  {', '.join(missed) or 'ok'}"
            ),
            failures,
        )
    yield f"  {whole['success']} success, {whole['false success']} false ones", failures


def fits_of(name, count, method):
    """What fits of a design say of its data sets, and the processor time of the fits."""
    design = next(each for each in DESIGNS if each.name == name)
    solution = ro.solve(problem_of(design), design.rtol)
    begin, outcomes = time.process_time(), []
    for k in range(count):
        options = {"sigma": design.sigma} if design.told else {}
        fit = solution.fit(design.times, design.data(k), observe=design.observed, **options)
        outcomes.append(of_fit(fit, method))
    return outcomes, time.process_time() - begin


def calibrations_of(name, count):
    """What calibrations of a design say of its data sets, and their processor time."""
    design = next(each for each in WIDE if each.name == name)
    problem, begin, outcomes = problem_of(design), time.process_time(), []
    for k in range(count):
        experiment = ro.Experiment(
            design.data(k), design.times, observe=design.observed, sigma=design.sigma
        )
        outcomes.append(of_calibration(ro.calibrate(problem, experiment, starts=4, seed=k)))
    return outcomes, time.process_time() - begin


def noise_line(name, count, method):
    """How many intervals of a design with noise of unknown level hold the true values."""
    inside = Counter()
    for seed in range(count):
        fit = NOISES[name](seed)
        for parameter, interval in fit.interval(method=method).items():
            inside[parameter] += covers(interval, TRUE[parameter])
    texts = ", ".join(f"{parameter} {hits}" for parameter, hits in inside.items())
    return f"{name}: {texts} of {count}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="")
    parser.add_argument("--count", type=int, default=SETS)
    parser.add_argument("--calibrations", type=int, default=20)
    parser.add_argument("--noises", type=int, default=0)
    parser.add_argument("--method", default="profile", choices=["profile", "linear"])
    parser.add_argument("--processes", type=int, default=1)
    chosen = parser.parse_args()
    runs = [
        (designs, [d for d in designs if chosen.only in d.name], run, count)
        for designs, run, count in (
            (DESIGNS, partial(fits_of, count=chosen.count, method=chosen.method), chosen.count),
            (WIDE, partial(calibrations_of, count=chosen.calibrations), chosen.calibrations),
        )
    ]
    failures = rows = 0
    with ProcessPoolExecutor(chosen.processes) as pool:
        for designs, wanted, run, count in runs:
            if not count:
                continue
            for design, (outcomes, seconds) in zip(
                wanted, pool.map(run, [d.name for d in wanted]), strict=True
            ):
                kind = "poorly identified, " if design.poor else ""
                kind += "calibrated" if designs is WIDE else "fitted"
                each = 1e3 * seconds / count
                print(f"{design.name} ({kind}, {count} data sets, {each:.0f} ms each)")
                missed = 0
                for line, missed in lines_of(design, outcomes):  # noqa: B007 - the last one counts
                    print(line, flush=True)
                failures, rows = failures + missed, rows + len(design.box)
        if chosen.noises:
            names = [name for name in NOISES if chosen.only in name]
            lines = pool.map(partial(noise_line, count=chosen.noises, method=chosen.method), names)
            for line in lines:
                print(line, flush=True)
    print(f"{failures} rows miss a bar, of {rows} parameters and their combinations")


if __name__ == "__main__":
    main()
