"""Populations of published data sets, beside the estimates that other tools publish for them.

    python -m tests.benchmarks.published_populations NAME=FILE.csv ...

The names are theophylline, phenobarbital and warfarin; the tables are not shipped. Theophylline is
the data set Theoph of R (Boeckmann, Sheiner & Beal, NONMEM Users Guide V, 1994), with the columns
Subject, Wt, Dose (mg/kg), Time and conc. Phenobarbital (Grasela & Donn, Dev. Pharmacol. Ther. 8,
1985) and warfarin (O'Reilly & Aggeler, Circulation 38, 1968) are phenobarbital_data.csv and
warfarin_data.csv among the demonstrations of Monolix, also in the R package monolix2rx
(inst/cov/data), with rows of doses.

Theophylline is beside the estimates of nlmixr2 by FOCEI, in its documentation. The others are
beside those of Monolix 2023R1 by stochastic approximation, in the summaries of monolix2rx
(inst/cov/pb and inst/cov/w1): phenobarbital with classes of the Apgar score, warfarin with a lag
and its concentrations alone. Their -2 log L is by importance sampling, ours by Laplace's method.
Printed is each estimate with its standard error, the published one, and their distance in standard
errors.
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
PHENOBARBITAL = {
    "V": 1.25,
    "V~high": 0.261,
    "V~low": 0.128,
    "k": 0.0048,
    "omega_V": 0.401,
    "omega_k": 0.187,
    "relative_C": 0.109,
}
WARFARIN = {
    "lag": 0.764,
    "ka": 1.46,
    "V": 7.96,
    "CL": 0.132,
    "omega_lag": 0.605,
    "omega_ka": 1.08,
    "omega_V": 0.223,
    "omega_CL": 0.286,
    "least_C": 0.247,
    "share_C": 0.0503,
}
DEVIANCES = {"theophylline": 2 * 179.7021, "phenobarbital": 971.43, "warfarin": 657.36}


def columns(path, delimiter=","):
    """The columns of a CSV file by name, NaN where a cell is empty."""
    with open(path, newline="", encoding="utf-8-sig") as file:
        rows = list(csv.DictReader(file, delimiter=delimiter))
    cells = {name: [row[name] for row in rows] for name in rows[0] if name}
    return {
        name: np.array([np.nan if cell == "." else float(cell) for cell in column])
        for name, column in cells.items()
    }


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


def phenobarbital(path):
    """One compartment, many doses; the volume by classes of the Apgar score."""
    table = columns(path, ";")
    problem = ro.Problem.from_strings(
        {"C": "-k*C"},
        {"C": "dose/V"},
        {"k": (0.0015, 0.016, "log"), "V": (0.3, 9, "log"), "dose": (1, 2)},
        (0, 400),
    )
    data = {
        "subject": table["ID"],
        "t": table["TIME"],
        "amount": table["DOSE"],
        "C": table["CONC"],
        "high": np.where(table["APGAR"] >= 8, 1.0, 0.0),
        "low": np.where(table["APGAR"] <= 3, 1.0, 0.0),
    }
    options = {"random": ["k", "V"], "noise": "proportional", "doses": {"dose": "amount"}}
    return problem, data, {**options, "covariates": {"V": ["high", "low"]}}


def warfarin(path):
    """One compartment with absorption of first order after a lag; concentrations alone."""
    table = columns(path)
    problem = ro.Problem.from_strings(
        {"A": "-ka*A", "C": "ka*A/V - CL/V*C"},
        {"A": "0", "C": "0"},
        {
            "ka": (0.08, 20, "log"),
            "CL": (0.04, 0.5),
            "V": (3, 20),
            "lag": (0.1, 6, "log"),
            "dose": (1, 2),
        },
        (0, 125),
        jumps={"lag": {"A": "A + dose"}},
    )
    data = {
        "subject": table["id"],
        "t": table["time"],
        "amount": table["amt"],
        "C": np.where(table["dvid"] == 2, np.nan, table["dv"]),
    }
    options = {"random": ["ka", "CL", "V", "lag"], "doses": {"dose": "amount"}}
    return problem, data, {**options, "sigma": {"C": "least_C + share_C*C"}}


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
    print(f"  -2 log L {-2 * fit.log_likelihood:.2f}, published {DEVIANCES[name]:.2f}")


STUDIES = {
    "theophylline": (theophylline, THEOPHYLLINE),
    "phenobarbital": (phenobarbital, PHENOBARBITAL),
    "warfarin": (warfarin, WARFARIN),
}


def main() -> None:
    if len(sys.argv) < 2:
        raise SystemExit(__doc__)
    for argument in sys.argv[1:]:
        name, path = argument.split("=", 1)
        study, published = STUDIES[name]
        compared(name, *study(path), published)


if __name__ == "__main__":
    main()
