import os

import pytest

from stereoweave.errors import StereoweaveError
from stereoweave.system.threads import thread_count, usable_cores


def test_the_default_number_of_threads_is_the_number_of_usable_cores():
    assert thread_count(3) == 3
    assert thread_count(None) == usable_cores()
    assert 1 <= usable_cores() <= (os.cpu_count() or 1)


@pytest.mark.parametrize("threads", [0, -2])
def test_less_than_one_thread_is_refused(threads):
    with pytest.raises(StereoweaveError, match=f"threads: expected a number from 1 to 1024, got {threads}"):
        thread_count(threads)
