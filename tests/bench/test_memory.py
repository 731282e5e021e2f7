import operator
from functools import partial

import numpy as np
import pytest

from stereoweave.bench.memory import peak_memory_mb

# Makes a function that gives as many bytes as it is asked for, all written to.
BYTES = partial(partial, operator.mul, b"x")


def test_what_a_call_takes_is_counted_and_what_the_parent_holds_is_not():
    held = np.ones(30_000_000)  # 240 MB
    assert peak_memory_mb(BYTES, 100_000_000) == pytest.approx(100, abs=5)
    assert peak_memory_mb(BYTES, 1_000) < 5
    assert held.any()
