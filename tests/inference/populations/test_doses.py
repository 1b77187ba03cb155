"""Several doses of each subject: sums of the curve of one dose, against closed forms."""

from __future__ import annotations

import functools

import numpy as np
import pytest

import rankone as ro

RATES = np.array([0.2, 0.3, 0.25, 0.4, 0.22, 0.33])
DOSES = [[(0.0, 5.0), (3.0 + 0.1 * i, 2.0 + i), (6.0, 4.0)][: 2 + i % 2] for i in range(6)]
SAMPLES = np.array([1.0, 2.0, 3.05, 6.0, 6.5, 9.0])


@functools.cache
def bolus():
    """u' = -k u after a dose at the start."""
    problem = ro.Problem.from_strings(
        {"u": "-k*u"}, {"u": "dose"}, {"k": (0.05, 1), "dose": (1, 2)}, (0, 10)
    )
    return ro.solve(problem, 1e-6)


def exact(times, k, doses):
    """The sum of exponentials; a datum at the time of a dose is after it."""
    each = [amount * np.exp(-k * (times - at)) * (times >= at) for at, amount in doses]
    return np.sum(each, axis=0)


def rows():
    """Doses and data of six subjects, without noise, in the order of time."""
    table = []
    for i, (k, doses) in enumerate(zip(RATES, DOSES, strict=True)):
        own = [(i, at, amount, np.nan) for at, amount in doses]
        own += [(i, t, np.nan, u) for t, u in zip(SAMPLES, exact(SAMPLES, k, doses), strict=True)]
        table += sorted(own, key=lambda row: row[1])
    return np.array(table)


def columns():
    return dict(zip(("subject", "t", "amt", "u"), rows().T, strict=True))


def fitted(table, **options):
    options = {"random": ["k"], "doses": {"dose": "amt"}, "sigma": 0.01, **options}
    return bolus().fit_population(table, **options)


def test_curves_of_doses_add_up():
    fit = fitted(columns())
    assert fit.success, fit.message
    np.testing.assert_allclose(fit.individuals["k"], RATES, rtol=1e-4)
    assert np.abs(fit.standardised["u"]).max() < 0.01
    times = np.linspace(0, 10, 7)
    curve = exact(times, fit.individuals["k"][3], DOSES[3])
    np.testing.assert_allclose(fit.curve(3, times), curve, rtol=1e-6)


def test_a_datum_before_a_dose_at_the_same_time():
    """The order of rows tells which is first."""
    table = columns()
    table["u"] = np.where(table["t"] == 6.0, np.nan, table["u"])
    first = {name: np.insert(column, 0, column[0]) for name, column in table.items()}
    first["amt"][0], first["u"][0] = np.nan, 0.0
    fit = fitted(first)
    assert fit.size == table["u"].size - np.isnan(table["u"]).sum() + 1
    assert abs(fit.standardised["u"][0, 0]) < 1e-12


def test_columns_of_nonmem():
    """`evid`, `mdv`, `addl` and `ii` say the same as rows without them."""
    table = {"subject": [1, 1, 1, 1, 2, 2, 2, 2], "t": [0, 1, 5, 9] * 2, "AMT": [3, ".", 0, ""] * 2}
    table |= {"EVID": [1, 0, 2, 0] * 2, "MDV": [1, 0, 0, 0] * 2, "ADDL": [2, 0, 0, 0] * 2}
    table |= {"II": [4, 0, 0, 0] * 2, "CMT": [1] * 8}
    doses = [(0.0, 3.0), (4.0, 3.0), (8.0, 3.0)]
    data = np.array([exact(np.array([0, 1, 5, 9.0]), k, doses) for k in (0.2, 0.3)])
    data[:, [0, 2]] = 7.0  # what a dose says it measured, and what is neither
    fit = fitted({**table, "u": data.ravel()}, doses={"dose": "AMT"})
    assert fit.size == 4
    np.testing.assert_allclose(fit.individuals["k"], [0.2, 0.3], rtol=1e-3)


def changed(row=None, **cells):
    """The table with other columns, or with other cells in a row."""
    table = columns()
    for name, cell in cells.items():
        if row is None:
            table[name] = np.broadcast_to(cell, table["t"].shape)
        else:
            table[name] = table.get(name, np.zeros(table["t"].size)).astype(object)
            table[name][row] = cell
    return table


WRONG = [
    (changed(1, amt=3.0), {}, "row 2 of the table has a dose and data"),
    (changed(0, amt=-3.0), {}, "row 1 of the table, subject `0`: the dose -3 is negative"),
    (changed(0, t=-1.0), {}, "row 1 of the table, subject `0`: the dose is at -1"),
    (changed(0, t=np.nan), {}, "subject `0`: the dose has no time"),
    (changed(0, amt="five"), {}, "row 1 of the table: `amt` is 'five', not a number"),
    (changed(slice(0, 8), amt=np.nan), {}, "subject `0` has data and no dose"),
    (changed(slice(4, 8), condition="b"), {}, "subject `0` is under several conditions"),
    (changed(0, evid=1), {}, "row 4 of the table: evid is 0, and `amt` is"),
    (changed(1, evid=1), {}, "row 1 of the table: evid is 0, and `amt` is 5"),
    (changed(1, evid=4), {}, "row 2 of the table: evid is 4"),
    (changed(0, addl=2), {}, r"repeated 2 times \(addl\) every 0 \(ii\)"),
    (changed(0, rate=2), {}, "column `rate` is not supported"),
    (changed(0, ss=1), {}, "column `ss` is not supported"),
    (columns(), {"doses": {"dose": "amount"}}, "no column `amount`"),
    (columns(), {"doses": {"dosis": "amt"}}, "did you mean `dose`"),
    (columns(), {"doses": {"k": "amt"}, "random": ["dose"]}, "`k` do not add up"),
    (columns(), {"doses": {}}, "doses names no parameter"),
    (columns(), {"doses": "amt"}, "is not a mapping"),
    (columns(), {"fixed": {"dose": 1}}, "`dose` is the amount of doses"),
    (columns(), {"observe": {"u": "u/dose"}}, "`u` depends on `dose` itself"),
]


@pytest.mark.parametrize(("table", "options", "message"), WRONG, ids=[str(m) for *_, m in WRONG])
def test_what_is_refused(table, options, message):
    with pytest.raises(ro.OptionError, match=message):
        fitted(table, **options)
