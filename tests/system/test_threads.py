import os
import threading
from contextvars import ContextVar

import pytest

from stereoweave.errors import StereoweaveError
from stereoweave.system.threads import beyond_ctrl_c, thread_count, usable_cores


def test_the_default_number_of_threads_is_the_number_of_usable_cores():
    assert thread_count(3) == 3
    assert thread_count(None) == usable_cores()
    assert 1 <= usable_cores() <= (os.cpu_count() or 1)


@pytest.mark.parametrize("threads", [0, -2])
def test_less_than_one_thread_is_refused(threads):
    with pytest.raises(StereoweaveError, match=f"threads: expected a number from 1 to 1024, got {threads}"):
        thread_count(threads)


def test_work_beyond_ctrl_c_has_a_thread_and_the_caller_s_context():
    chosen = ContextVar("chosen")
    chosen.set(7)
    assert beyond_ctrl_c(lambda: (chosen.get(), threading.current_thread() is threading.main_thread())) == (
        7,
        False,
    )
    with pytest.raises(ZeroDivisionError):
        beyond_ctrl_c(lambda: 1 / 0)
