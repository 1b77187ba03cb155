"""The models that tests of conformance share."""

from __future__ import annotations

import pytest

from tests.share.conformance.languages import Models


@pytest.fixture(scope="session")
def models(tmp_path_factory):
    return Models(tmp_path_factory.mktemp("models"))
