"""Run functions in child processes that can be killed in mid-call and replaced."""

import os
import pickle
import queue
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import suppress
from pathlib import Path
from typing import Any

from stereoweave.errors import StereoweaveError

# Part of a call's time that may pass before its process has started. The rest is left to the call itself.
_STARTING_SHARE = 0.5

Function = Callable[[Any], Any]
_Reply = tuple[Any, Exception | None]


class ProcessDiedError(StereoweaveError):
    """Error for a process that exited in the middle of a call, because it crashed or memory ran out."""


class NotStartedError(TimeoutError):
    """Error for a call that was not begun because its process was still starting."""


class ChildProcess:
    """A function that runs in a child process, one call at a time.

    Args:
        make: Function that is called once in the child, and returns the function to run. `make` is
            pickled, as are arguments and results.
        folder: Folder for the child's temporary files; removed when the child exits.
    """

    def __init__(self, make: Callable[[], Function], folder: Path) -> None:
        self._make, self._folder = pickle.dumps(make), folder
        self._exchanges = ThreadPoolExecutor(1)
        self._start()

    def __call__(self, argument: Any, timeout_s: float | None) -> Any:
        """Call the function for at most `timeout_s` seconds, and return its result.

        Raises:
            NotStartedError: If the process has not started within half of this time.
            TimeoutError: If the call takes too long; the process is then replaced. Also if no time is left.
            ProcessDiedError: If the process exits on its own; it is then replaced.
            Exception: Any error that the function or `make` raises.
        """
        late = f"expected a result within {timeout_s or 0:.3g} s, found none"
        start_s = time.monotonic()
        if timeout_s is not None and timeout_s <= 0:
            raise TimeoutError(late)
        self.wait_for_start(timeout_s)
        left_s = None if timeout_s is None else start_s + timeout_s - time.monotonic()
        self._open(self._started)
        self._make_folder()
        reply = self._exchanges.submit(_exchange, self._process, pickle.dumps(argument))
        wait([reply], left_s)
        if not reply.done():
            self._replace()
            raise TimeoutError(late)
        return self._open(reply)

    @property
    def starting(self) -> bool:
        """Whether the process is still starting."""
        return not self._started.done()

    def wait_for_start(self, timeout_s: float | None) -> None:
        """Wait for the process to start for at most half of `timeout_s` seconds; the rest is for the call.

        Raises:
            NotStartedError: If the process is still starting then.
        """
        wait([self._started], None if timeout_s is None else _STARTING_SHARE * timeout_s)
        if self.starting:
            raise NotStartedError("a process that the request needs is still starting; try again later")

    @property
    def pid(self) -> int:
        """The process ID of the child."""
        return self._process.pid

    @property
    def has_ended(self) -> bool:
        """Whether the process exited while no call was under way, or `make` raised an error."""
        return self._process.poll() is not None

    def renew(self) -> None:
        """Start another process if this one has ended, so that the next call does not fail."""
        if self.has_ended:
            self._replace()

    def kill(self) -> None:
        """Kill the process. A call that is under way replaces it and raises ProcessDiedError."""
        # A call that is under way may replace the process meanwhile.
        process = self._process
        process.kill()
        process.wait()

    def close(self) -> None:
        """Stop the child process."""
        self._end()
        self._exchanges.shutdown()

    def _start(self) -> None:
        self._make_folder()
        environment = {"TMPDIR": str(self._folder), "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        # -P: otherwise a file in the current folder could shadow a library.
        command, pipe = [sys.executable, "-P", "-m", __name__], subprocess.PIPE
        self._process = subprocess.Popen(command, stdin=pipe, stdout=pipe, env=os.environ | environment)
        self._started = self._exchanges.submit(_exchange, self._process, self._make)

    def _make_folder(self) -> None:
        """Make the folder if it is missing: clean-up jobs delete folders in /tmp that are unused for days."""
        self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)

    def _open(self, reply: Future[_Reply]) -> Any:
        """Return the result of a reply that has arrived, or raise its error."""
        try:
            result, error = reply.result()
        # ValueError: the pipes are closed, because the process exited and could not be replaced.
        except (OSError, EOFError, ValueError, pickle.UnpicklingError):
            status = self._replace()
            raise ProcessDiedError(
                f"the process that handled the request exited early ({status}); "
                "either a file in the request made it crash, or memory ran out"
            ) from None
        if error is not None:
            if reply is self._started:  # without a function, the process is of no use
                self._end()
            raise error
        return result

    def _replace(self) -> str:
        """Replace the process, and return the exit code or signal of the old process."""
        status = self._end()
        self._start()
        return f"exit code {status}" if status >= 0 else signal.Signals(-status).name

    def _end(self) -> int:
        # If the process has exited on its own, this does not change its status.
        self._process.kill()
        status = self._process.wait()
        for pipe in filter(None, (self._process.stdin, self._process.stdout)):
            with suppress(BrokenPipeError):  # the process had not read its whole argument
                pipe.close()
        shutil.rmtree(self._folder, ignore_errors=True)
        return status


def _exchange(process: Any, message: bytes) -> _Reply:
    """Send a message to a process and return its reply."""
    pickle.dump(message, process.stdin)  # the pickle marks the end of the message
    process.stdin.flush()
    return pickle.load(process.stdout)


def _work() -> None:
    """Make the function, then call it with each message from standard input; never return."""
    replies = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # keep libraries' output out of the replies
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the process group; the parent handles it
    messages: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=_receive, args=(messages,), daemon=True).start()
    made: list[Function] = []
    replies.write(_reply(lambda make: made.append(make()), messages.get()))
    while True:
        replies.flush()
        replies.write(_reply(made[0], messages.get()))


def _receive(messages: "queue.SimpleQueue[bytes]") -> None:
    """Receive messages until the parent exits; then exit this process, even in the middle of a call."""
    try:
        while True:
            messages.put(pickle.load(sys.stdin.buffer))
    finally:
        os._exit(0)


def _reply(function: Function, argument: bytes) -> bytes:
    """Call a function with a pickled argument, and return its pickled result or error."""
    try:
        return pickle.dumps((function(pickle.loads(argument)), None))
    except Exception as error:
        try:
            return pickle.dumps((None, error))
        except Exception:  # the error cannot be pickled: it may hold an open file
            return pickle.dumps((None, RuntimeError(repr(error))))


if __name__ == "__main__":
    _work()
