import numpy as np
import pytest

from stereoweave.matching.medians import find_median


@pytest.mark.parametrize("count", [1, 3, 5, 7, 11])
def test_the_median_of_an_odd_number_of_values_is_numpy_s(rng, count):
    values = rng.integers(0, 9, (count, 40, 30)).astype(np.float32)
    values[rng.random(values.shape) < 0.1] = np.inf
    given = values.copy()
    np.testing.assert_array_equal(find_median(list(values)), np.median(given, axis=0))
    np.testing.assert_array_equal(values, given)
