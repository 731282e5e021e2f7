"""Isolation of the tests of experiments from each other."""

from collections.abc import Iterator
from unittest.mock import patch

import pytest

from stereoweave.learn.models import MODELS


@pytest.fixture(autouse=True)
def restored_models() -> Iterator[None]:
    """Restore the networks after each test, because some experiments add their own."""
    with patch.dict(MODELS):
        yield
