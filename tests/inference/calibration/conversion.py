"""The conversion of the examples with other tables: Laplace's noise, times at rest, scales."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

FILES = Path(__file__).parents[3] / "examples" / "conversion"
MODEL = (FILES / "model.xml").read_text(encoding="utf-8")
YAML = (FILES / "conversion.yaml").read_text(encoding="utf-8")
CONDITIONS = (FILES / "conditions.tsv").read_text(encoding="utf-8")
NOMINAL = {"k1": 0.8, "k2": 0.6, "a0": 1.5, "scale": 2.0, "sd_B": 0.1, "sd_share": 0.05}
DOSES = {"low": 0.5, "high": 3.0}
TIMES = (0.0, 0.5, 1.0, 2.0)
PARAMETERS = """parameterId	parameterScale	lowerBound	upperBound	nominalValue	estimate
k1	log10	0.001	1000	0.8	1
k2	log	0.001	1000	0.6	1
a0	lin	0.1	10	1.5	1
scale	log10	0.01	100	2	1
sd_B	log10	0.001	10	0.1	1
sd_share	lin	0.001	1	0.05	0
"""
OBSERVABLES = """observableId	observableFormula	noiseFormula	observableTransformation\
	noiseDistribution
obs_B	observableParameter1_obs_B * B + 0.1	noiseParameter1_obs_B	log10	normal
obs_share	A / (A + B)	sd_share + 0.01 * A	lin	laplace
obs_A	A	0.2	log	normal
"""


def skip_without_petab():
    """Skip a module; petab takes a second to import, which collecting the module does not need."""
    if find_spec("petab") is None:
        pytest.skip("petab is not installed (pip install petab)", allow_module_level=True)


def simulated(condition, before, times, values=NOMINAL):
    """A and B (2, T) in closed form; at infinite times those at rest."""

    def path(dose, start, at):
        k1, k2, total = values["k1"] + dose, values["k2"], sum(start)
        rest = total * k2 / (k1 + k2)
        a = rest + (start[0] - rest) * np.exp(-(k1 + k2) * np.asarray(at))
        return np.stack([a, total - a])

    start = [values["a0"], 0.2]
    return path(DOSES[condition], path(0.0, start, np.inf) if before else start, times)


def rows():
    """The measurement table: experiments from a start and from rest, one measured at rest."""
    rng = np.random.default_rng(7)
    lines = []
    for before, condition in (("", "low"), ("rest", "high")):
        times = [*TIMES, *([np.inf] if before else [])]
        for at, (a, b) in zip(times, simulated(condition, before, times).T):
            outputs = {"obs_B": 2.0 * b + 0.1, "obs_share": a / (a + b), "obs_A": a}
            for name, output in outputs.items():
                measured = float(output * np.exp(rng.normal(scale=0.1)))
                placed = ("scale", "sd_B") if name == "obs_B" else ("", "")
                lines.append((name, before, condition, repr(measured), str(at), *placed))
    return lines


HEADER = (
    *("observableId", "preequilibrationConditionId", "simulationConditionId", "measurement"),
    *("time", "observableParameters", "noiseParameters"),
)


def table(lines):
    """The text of a measurement table."""
    return "\n".join("\t".join(line) for line in [HEADER, *lines]) + "\n"


def write(folder, **files):
    """Write the problem to a folder, with other texts of some files, and return its YAML file."""
    texts = {
        "model.xml": MODEL,
        "parameters.tsv": PARAMETERS,
        "conditions.tsv": CONDITIONS,
        "observables.tsv": OBSERVABLES,
        "measurements.tsv": table(rows()),
        "conversion.yaml": YAML,
    }
    for name, text in texts.items():
        stem = name.partition(".")[0]
        (folder / name).write_text(files.get(stem, text))
    return folder / "conversion.yaml"
