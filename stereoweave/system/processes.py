"""What a process of its own does before it works for another one."""

import multiprocessing
import os
import signal
import threading


def begin_work(threads: int) -> None:
    """Called first in a worker: so many threads for OpenCV, and an end when the parent ends."""
    import cv2

    cv2.setNumThreads(threads)
    # Ctrl-C reaches the whole group, and the parent alone is to answer it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_the_parent, daemon=True).start()


def _end_with_the_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
