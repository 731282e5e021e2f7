import operator
from functools import partial

import numpy as np
import pytest

from stereoweave.system.memory import peak_memory_mb

# Makes a function that returns as many bytes as requested, all of them written.
BYTES = partial(partial, operator.mul, b"x")


def test_memory_of_the_call_is_counted_and_that_of_the_parent_is_not():
    held = np.ones(30_000_000)  # 240 MB
    assert peak_memory_mb(BYTES, 100_000_000) == pytest.approx(100, abs=5)
    assert peak_memory_mb(BYTES, 1_000) < 5
    assert held.any()
