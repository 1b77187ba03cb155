"""Populations of two published data sets, beside the estimates that other tools publish for them.

    python -m tests.benchmarks.published_populations THEOPHYLLINE.csv [WARFARIN.csv]

The tables are not shipped. Theophylline is the data set Theoph of R (Boeckmann, Sheiner & Beal,
NONMEM Users Guide V, 1994), with the columns Subject, Wt, Dose (mg/kg), Time and conc. Warfarin
(O'Reilly & Aggeler, Circulation 38, 1968) has the columns id, time, amt, dv, dvid (1 is the
concentration), as in the R package nlmixr2data and the demonstrations of Monolix.

Theophylline is beside the estimates of nlmixr2 by FOCEI, warfarin beside those of NONMEM 7.4.3 by
FOCEI, in the documentation of nlmixr2 and babelmixr2. The latter fit has the effect of warfarin as
well, and two steps of absorption whose rates come out equal, 1.00; here they are one. Printed is
each estimate with its standard error, the published one, and their distance in standard errors.
"""

from __future__ import annotations

import csv
import sys
import time

import numpy as np

import rankone as ro

# Logarithms of means and levels of noise, and for variances the coefficient of variation
THEOPHYLLINE = {
    "ka": np.exp(0.464),
    "CL": np.exp(1.01),
    "V": np.exp(3.46),
    "omega_ka": np.sqrt(np.log1p(0.706**2)),
    "omega_CL": np.sqrt(np.log1p(0.268**2)),
    "omega_V": np.sqrt(np.log1p(0.139**2)),
    "sigma_C": 0.693,
}
THEOPHYLLINE_LIKELIHOOD = -179.7021
WARFARIN = {
    "ka": 1.0,
    "CL": np.exp(-2.004),
    "V": np.exp(2.052),
    "omega_CL": np.sqrt(np.log1p(0.2859**2)),
    "omega_V": np.sqrt(np.log1p(0.2283**2)),
    "sigma_C": 0.5116,
    "relative_C": 0.09858,
}


def columns(path):
    """The columns of a CSV file by name, numbers where they can be."""
    with open(path, newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return {name: np.array([float(row[name]) for row in rows]) for name in rows[0] if name}


def theophylline(path):
    """One compartment with absorption of first order."""
    table = columns(path)
    problem = ro.Problem.from_strings(
        {"A": "-ka*A", "C": "ka*A/V - CL/V*C"},
        {"A": "dose", "C": "0"},
        {"ka": (0.15, 15), "CL": (0.7, 10), "V": (12, 80), "dose": (200, 400)},
        (0, 25),
    )
    data = {
        "subject": table["Subject"],
        "t": table["Time"],
        "dose": table["Dose"] * table["Wt"],
        "C": table["conc"],
    }
    return problem, data, {"random": ["ka", "CL", "V"], "noise": "constant"}


def warfarin(path):
    """One compartment behind two equal steps of absorption; concentrations alone."""
    table = columns(path)
    here = table["dvid"] == 1
    problem = ro.Problem.from_strings(
        {"D": "-ka*D", "G": "ka*D - ka*G", "C": "ka*G/V - CL/V*C"},
        {"D": "dose", "G": "0", "C": "0"},
        {"ka": (0.1, 15, "log"), "CL": (0.03, 0.6), "V": (2, 30), "dose": (50, 160)},
        (0, 125),
    )
    data = {
        "subject": table["id"][here],
        "t": table["time"][here],
        "dose": table["amt"][here],
        "C": table["dv"][here],
    }
    return problem, data, {"random": ["ka", "CL", "V"], "noise": "combined"}


def compared(name, problem, data, options, published):
    """Print a fit beside published estimates."""
    solution = ro.solve(problem, 1e-4)
    begin = time.process_time()
    fit = solution.fit_population(data, **options)
    print(f"{name}: {time.process_time() - begin:.2f} s of processor time")
    print(fit)
    for key, other in published.items():
        apart = abs(fit.x[key] - other) / fit.std[key]
        print(
            f"  {key:10} {fit.x[key]:.4g} +- {fit.std[key]:.2g}, published {other:.4g}: {apart:.2f}"
        )
    return fit


def main() -> None:
    if len(sys.argv) < 2:
        raise SystemExit(__doc__)
    fit = compared("theophylline", *theophylline(sys.argv[1]), THEOPHYLLINE)
    published = THEOPHYLLINE_LIKELIHOOD
    print(f"  log-likelihood {fit.log_likelihood:.4f}, published {published}")
    if len(sys.argv) > 2:
        compared("warfarin", *warfarin(sys.argv[2]), WARFARIN)


if __name__ == "__main__":
    main()
