"""The reference problems, as the tests of the front end need them."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from rankone.problem.problem import Problem
from tests.problems import REFERENCE


@pytest.fixture(params=REFERENCE, ids=str)
def reference_problem(request: pytest.FixtureRequest) -> Problem:
    return REFERENCE[request.param]()


@pytest.fixture
def reference() -> dict[str, Callable[[], Problem]]:
    return REFERENCE
