"""What is wrong with data, parameters and options is said."""

import inspect

import numpy as np
import pytest

from rankone.support.errors import EvaluationError, OptionError
from tests.inference.estimation.systems import DOSE_TIMES, PERSON, decay, drug

TIMES = np.linspace(0.1, 2, 8)
DATA = np.exp(-TIMES)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"data": DATA[:5]}, "5 values of `u` at 8 times"),
        ({"data": np.stack([DATA, DATA])}, r"shape \(2, 8\) for 1 output, `u`"),
        ({"data": [*DATA[:7], np.nan]}, "1 of 8 data are NaN; remedy"),
        ({"data": [*DATA[:7], np.inf]}, "infinite"),
        ({"data": ["a"] * 8}, "are not real numbers"),
        ({"data": DATA[:1], "times": [1.0], "sigma": 1}, "1 value for 2 parameters: `k` and `a`"),
        ({"data": DATA[:2], "times": [1, 2]}, "2 values for 2 parameters and sigma"),
        ({"times": None}, "no times are given"),
        ({"times": TIMES.reshape(2, 4)}, "times have the shape"),
        ({"observe": "v"}, "there is no unknown `v`"),
        ({"observe": ["u", "u"]}, "twice"),
        ({"observe": []}, "nothing is observed"),
        ({"data": {"u": DATA}, "observe": "w"}, "there is no unknown `w`"),
        ({"sigma": 0.0}, "sigma = 0 is not a positive number"),
        ({"sigma": -1}, "sigma = -1 is not a positive number"),
        ({"sigma": np.nan}, "sigma = nan"),
        ({"sigma": [1, 2, 3]}, r"sigma has the shape \(3,\)"),
        ({"sigma": [None] * 8}, "sigma = nan"),
        ({"sigma": "a +"}, "`a \\+` is not an expression"),
        ({"sigma": "K"}, "`K` is unknown .did you mean `k`"),
        ({"noise": "propotional"}, "noise='propotional' is unknown .did you mean `proportional`"),
        ({"noise": "combined", "sigma": 0.1}, "has two levels"),
        ({"noise": "proportional", "sigma": "k"}, "sigma is an expression"),
        ({"noise": "constant", "weights": 1}, "noise and weights are both given"),
        ({"observe": "log(w)"}, "`log.w.` depends on no unknown"),
        ({"observe": "scale*u + K"}, "an observable has `K`.*did you mean `k`"),
        ({"observe": "u**power"}, "`power` of an observable enters it nonlinearly.*bounds"),
        ({"observe": "u(3)"}, "`u.3.` is not understood"),
        ({"observe": "log(u)", "noise": "log-normal", "data": -DATA}, "is not positive"),
        ({"bounds": {"k": (1, 2, "lin")}}, "not a pair"),
        ({"prior": {"k": 3}}, "not a frozen continuous distribution"),
        ({"sigma": 1, "weights": 1}, "sigma and weights are both given"),
        ({"weights": 0}, "weights = 0 is not"),
        ({"fixed": {"k": 1, "a": 1}}, "all parameters are fixed"),
        ({"fixed": {"q": 1}}, "fixed: there is no parameter `q`"),
        ({"fixed": [1]}, "not a mapping"),
        ({"fixed": {"k": [1, 2]}}, "not a number"),
        ({"start": {"k": 1}, "fixed": {"k": 1}}, "is fixed, and has a start"),
        (
            {"start": {"k": 1}, "bounds": {"k": (2, 3)}},
            r"`k` = 1 is outside its bounds \[2, 3\]",
        ),
        ({"bounds": {"k": (3, 2)}}, "do not ascend"),
        ({"bounds": {"k": 3}}, "not a pair"),
        ({"bounds": {"k": (1, 2)}, "fixed": {"k": 1}}, "is fixed, and has bounds"),
        ({"starts": 0}, "starts=0"),
        ({"level": 1.0}, "level=1 is not between"),
        ({"missing": "keep"}, "missing='keep'"),
    ],
)
def test_options(given, message):
    with pytest.raises(OptionError, match=message):
        decay().fit(**{"times": TIMES, "data": DATA, **given})


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"times": TIMES + 1}, r"`t` = 3 is outside its horizon \[0, 2\]"),
        ({"fixed": {"k": 9}}, "`k` = 9 is outside its range"),
        ({"start": {"k": 0.1}}, "`k` = 0.1 is outside its range"),
        ({"bounds": {"k": (0, 1)}}, "`k` = 0 is outside its range"),
    ],
)
def test_outside(given, message):
    with pytest.raises(EvaluationError, match=message):
        decay().fit(**{"times": TIMES, "data": DATA, **given})


@pytest.mark.slow
def test_several_outputs():
    data = drug()["c"](DOSE_TIMES, PERSON)
    with pytest.raises(OptionError, match=r"shape \(24,\) for 2 outputs.*observe"):
        drug().fit(DOSE_TIMES, data)
    with pytest.raises(OptionError, match="there are no times of `p`"):
        drug().fit({"c": DOSE_TIMES}, {"c": data, "p": data})
    with pytest.raises(OptionError, match="sigma is given for `q`, observed are"):
        drug().fit(DOSE_TIMES, {"c": data, "p": data}, sigma={"q": 1})


def test_of_a_fit():
    fit = decay().fit(TIMES, DATA, sigma=0.01)
    with pytest.raises(OptionError, match="there is no parameter `q`"):
        fit.interval_of("q*k")
    with pytest.raises(OptionError, match="not understood"):
        fit.interval_of("k // 2")
    with pytest.raises(OptionError, match=r"`__import__.k.` is not understood"):
        fit.interval_of("__import__(k)")
    with pytest.raises(OptionError, match="is not an expression"):
        fit.interval_of("k +")
    with pytest.raises(OptionError, match="not a quantity"):
        fit.interval_of(3.0)
    with pytest.raises(OptionError, match="has no value at the fit"):
        fit.interval_of("log(-k)")
    with pytest.raises(OptionError, match="method='exact'"):
        fit.interval(method="exact")
    with pytest.raises(OptionError, match="not a free parameter"):
        fit.profile("u")


def test_signatures_can_be_inspected():
    of_data = "observe sigma noise weights doses missing name"
    of_search = "fixed start bounds starts effort level"
    names = {
        "fit": f"times data {of_search} prior {of_data}",
        "posterior": f"times data prior seed steps chains executor {of_search} {of_data}",
        "minimize": "objective t sense fixed start bounds constraints starts effort",
    }
    for method, wanted in names.items():
        parameters = inspect.signature(getattr(decay(), method)).parameters
        assert set(parameters) == set(wanted.split())
        assert not any(each.kind is each.VAR_KEYWORD for each in parameters.values())
    assert inspect.signature(decay().fit).parameters["level"].default == 0.95
