"""Setup of worker processes."""

import multiprocessing
import os
import signal
import threading


def begin_work(threads: int) -> None:
    """Set up a worker process: limit OpenCV's threads, ignore Ctrl-C, and exit when the parent exits."""
    import cv2

    cv2.setNumThreads(threads)
    # Ctrl-C reaches the whole process group; only the parent handles it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_the_parent, daemon=True).start()


def _end_with_the_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
