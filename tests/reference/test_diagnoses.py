"""Each diagnosis is given where its cause is, and not where it is not."""

import pytest

from tests.benchmarks.diagnoses import outcome
from tests.reference.diagnoses import diagnoses
from tests.reference.further_diagnoses import further_diagnoses

DIAGNOSES = {diagnosis.key: diagnosis for diagnosis in [*diagnoses(), *further_diagnoses()]}
CHEAP = (
    *("event inside", "outlier", "misfit", "at an end", "growing", "too few values"),
    *("covariate constant", "one subject", "search", "other side"),
)


def check(key, seed, capfd):
    """Both cases of a diagnosis; numerical libraries write nothing on the screen."""
    diagnosis = DIAGNOSES[key]
    wrong = {}
    for cause, case in ((True, diagnosis.present), (False, diagnosis.absent)):
        found, text = outcome(case, seed, diagnosis.pattern)
        if found is not cause:
            wrong[cause] = text
    assert not wrong
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("key", CHEAP)
def test_a_pair_of_cases(key, capfd):
    check(key, 5, capfd)


@pytest.mark.slow
@pytest.mark.parametrize("key", [key for key in DIAGNOSES if key not in CHEAP])
def test_a_further_pair_of_cases(key, capfd):
    """How often each is right is measured: tests/benchmarks/diagnoses.py."""
    check(key, 0, capfd)
