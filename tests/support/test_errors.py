"""Errors keep message and remedy apart, also in copies."""

from __future__ import annotations

import pickle
import re
from pathlib import Path

import pytest

import rankone as ro
from rankone.support import errors
from rankone.support.errors import OptionError, ProblemError, optional_module, warn
from tests.problems import REFERENCE


def test_str_joins_message_and_remedy() -> None:
    error = ProblemError("`x` is missing", equation=2, term="x", remedy="give its equation")
    assert error.message == "equation 2: `x` is missing"
    assert str(error) == "equation 2: `x` is missing; remedy: give its equation"
    assert str(OptionError("no such option")) == "no such option"


def test_str_leaves_out_the_middle_of_a_long_message() -> None:
    error = OptionError(f"begin {'and on ' * 1000}end", remedy="write less")
    assert len(str(error)) < 1100
    assert str(error).startswith("begin and on")
    assert " … (see `.message`) … " in str(error)
    assert str(error).endswith("on end; remedy: write less")
    assert len(error.message) > 7000
    named = str(OptionError(f"the file `{'a' * 5000}` is missing"))
    assert named.startswith("the file `aaa")
    assert named.endswith("aaa` is missing (see `.message`)")


def test_a_warning_joins_message_and_remedy() -> None:
    with pytest.warns(ro.RankoneWarning, match="^the tea is cold; remedy: heat it$"):
        warn("the tea is cold", remedy="heat it")


def test_copies_are_equal() -> None:
    error = ProblemError("`x` is missing", equation=2, term="x", remedy="give its equation")
    copy = pickle.loads(pickle.dumps(error))
    assert (str(copy), copy.message) == (str(error), error.message)
    assert (copy.equation, copy.term, copy.remedy) == (2, "x", "give its equation")


def test_a_failure_has_its_remedy_as_data() -> None:
    with pytest.raises(ro.ConvergenceError) as caught:
        ro.solve(REFERENCE["decay"](), rtol=1e-9, method="cross", effort=1e-5, on_failure="raise")
    assert caught.value.remedy == "raise effort"
    assert "raise effort" not in caught.value.message
    assert caught.value.message in caught.value.solution.message


def test_a_missing_package_is_named() -> None:
    with pytest.raises(OptionError, match="tea needs leaves, which is not installed; remedy: pick"):
        optional_module("no_such_package", "tea needs leaves", "pick some", OptionError)


def test_the_reference_names_all_errors_that_users_may_see():
    """Classes of errors by their bases, whatever module they are in."""
    source = Path(errors.__file__).parents[1]
    texts = (path.read_text() for path in source.rglob("*.py"))
    classes = [each for text in texts for each in re.findall(r"^class (\w+)\((.*?)\):", text, re.M)]
    bases = {name: set(re.findall(r"\w+", own)) for name, own in classes}
    assert len(bases) > 100
    known = {"RankoneError"}
    while more := {name for name, own in bases.items() if own & known} - known:
        known |= more
    docs = source.parents[1] / "docs"
    reference, api = (docs / name for name in ("reference.md", "api/errors.rst"))
    for name in known:
        assert f"`{name}`" in reference.read_text()
        assert name in errors.__all__ or f".{name}\n" in api.read_text()
