"""Fits of tables: which column is what, experiments in rows, and what is wrong with a table."""

import numpy as np
import pytest

from rankone.support.errors import EvaluationError, OptionError
from tests.inference.estimation.experiments import DOSES, HOURS, TRUE, bateman, oral
from tests.inference.estimation.systems import decay

TIMES = np.linspace(0.1, 2.0, 12)
DATA = 2.0 * np.exp(-1.3 * TIMES)
NOISY = DATA + 0.02 * np.random.default_rng(0).standard_normal(12)


def test_a_data_frame_is_the_same_as_arrays():
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame({"t": TIMES, "u": NOISY, "sigma": 0.02, "remark": "good"})
    frame.loc[3, "u"] = None
    fit = decay().fit(frame)
    plain = decay().fit(np.delete(TIMES, 3), np.delete(NOISY, 3), sigma=0.02)
    assert fit.x == pytest.approx(plain.x, rel=1e-9)
    np.testing.assert_allclose(fit.residuals["u"], plain.residuals, atol=1e-12)
    assert fit.noise_given


def oral_table():
    """Three doses in the rows of one table."""
    times = np.tile(HOURS, 3)
    doses = np.repeat(DOSES, HOURS.size)
    noise = 0.1 * np.random.default_rng(3).standard_normal(times.size)
    levels = np.concatenate([bateman(HOURS, dose) for dose in DOSES])
    return {"time": times, "C": levels * (1.0 + noise), "dose": doses}


@pytest.mark.slow
def test_rows_are_told_apart_by_parameters_conditions_and_subjects():
    table = oral_table()
    by_dose = oral().fit(table, noise="proportional")
    assert [trial.name for trial in by_dose.trials] == ["dose=50", "dose=100", "dose=200"]
    assert by_dose.values_in("dose=200")["dose"] == 200.0
    doses = table.pop("dose")
    table["condition"] = [f"{dose:g} mg" for dose in doses]
    fixed = {f"{dose:g} mg": {"dose": dose} for dose in DOSES}
    named = oral().fit(table, noise="proportional", fixed=fixed)
    assert named.x == pytest.approx(by_dose.x, rel=1e-9)
    assert [trial.name for trial in named.trials] == list(fixed)
    assert set(named.residuals) == set(fixed)
    for name in ("ka", "ke", "V"):
        low, high = named.interval(0.999)[name]
        assert low < TRUE[name] < high
    with pytest.raises(
        OptionError, match=r"has no condition or subject `50mg`.*did you mean `50 mg`"
    ):
        oral().fit(table, fixed={"50mg": {"dose": 50}})
    table["subject"] = table.pop("condition")
    by_subject = oral().fit(table, noise="proportional", fixed=fixed)
    assert by_subject.x == pytest.approx(by_dose.x, rel=1e-9)


@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        ({"t": None}, {}, "no column `t` for time"),
        (
            {"t": None, "Time": TIMES},
            {},
            r"\(did you mean `Time`\?\); remedy: name it `t`",
        ),
        ({"u": None}, {}, "no column of an unknown"),
        ({"u": None, "U": DATA}, {}, "no column of an unknown"),
        ({"kk": DATA}, {}, r"column `kk` of the table is unknown \(did you mean `k`"),
        ({"u": [np.nan] * 12}, {}, "no measurements"),
        ({"u": ["high", *DATA[1:]]}, {}, "row 1 of the table: `u` is 'high', not a number"),
        ({"u": [np.inf, *DATA[1:]]}, {}, "infinite"),
        ({"u": DATA[:5]}, {}, "differ in length"),
        ({"t": [None, *TIMES[1:]]}, {}, "`u` is measured where `t` is empty"),
        ({"k": [None, *DATA[1:]]}, {}, "the parameter `k` is empty"),
        ({"k": 12 * [1.0]}, {"fixed": {"a": {}, "k": 1}}, "has no condition or subject `a`"),
        ({"sigma_u": [0.1, None, *DATA[2:]]}, {}, "row 2 of the table: sigma of `u` is empty"),
        ({"sigma_u": -DATA}, {}, "is not a positive number"),
        ({"sigma": DATA}, {"sigma": 0.1}, "the table has a column of it"),
        ({}, {"weights": 1.0}, "no weights"),
        ({}, {"observe": {"signal": "3*u"}}, "the table has no column `signal`"),
        ({}, {"observe": "v"}, "there is no unknown `v`"),
    ],
)
def test_bad_tables(change, options, message):
    table = {"t": TIMES, "u": DATA, **change}
    table = {name: column for name, column in table.items() if column is not None}
    with pytest.raises(OptionError, match=message):
        decay().fit(table, **options)


def test_no_table_and_no_data():
    with pytest.raises(OptionError, match=r"data are missing; remedy: give fit\(times, data\)"):
        decay().fit(TIMES)
    with pytest.raises(EvaluationError, match="outside its horizon"):
        decay().fit({"t": TIMES + 1, "u": DATA})
    with pytest.raises(EvaluationError, match="`k` = 9 is outside its range"):
        decay().fit({"t": TIMES, "u": DATA, "k": 12 * [9.0]})
