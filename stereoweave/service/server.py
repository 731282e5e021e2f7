"""HTTP server of `stereoweave serve`: uvicorn with limits on slow clients and large request headers.

Ray Serve's own proxy has no such limits, and keeps request headers of any length in memory.
"""

import asyncio
import math
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import h11
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

_MOST_HEAD_BYTES = 16 * 1024
# Number of bytes to parse at a time. Other connections wait meanwhile; h11 takes 40 us per chunk, even of one
# byte.
_PARSED_BYTES = 4096
# Each connection takes a file descriptor, and a process usually has 1024. All waiting connections are
# accepted at once, before any is closed.
_MOST_CONNECTIONS, _WAITING_CONNECTIONS = 500, 100


@dataclass(frozen=True)
class ClientTimeouts:
    """Time limits of the HTTP server.

    Attributes:
        head_s: Time for all headers of the next request to arrive.
        reader_s: Time for a client to read a response, which stays in memory until then.
        end_s: Time to finish the requests in progress when the server shuts down.
    """

    head_s: float = 10
    reader_s: float = 60
    end_s: float = 60


class _Connection(H11Protocol, asyncio.BufferedProtocol):
    """A connection that is closed if the client is too slow to send request headers or to read a response.

    If there are too many connections, the one that has waited longest for request headers is closed.
    """

    def __init__(self, timeouts: ClientTimeouts, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._timeouts = timeouts
        self._buffer = bytearray(_PARSED_BYTES)
        self._deadline: asyncio.TimerHandle | None = None

    def get_buffer(self, sizehint: int) -> bytearray:
        return self._buffer

    def buffer_updated(self, nbytes: int) -> None:
        self.data_received(bytes(self._buffer[:nbytes]))

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        transport.set_write_buffer_limits(high=0)  # pause writing until the client has read everything
        self._expect_head()
        if len(self.connections) > _MOST_CONNECTIONS:
            waiting = [each for each in self.connections if isinstance(each, _Connection) and each._is_idle()]
            longest = min(waiting, key=_Connection._deadline_s)
            self.connections.remove(longest)
            longest.transport.abort()

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        if self._is_busy() and not self._is_unread():
            self._close_within(None)

    def send_400_response(self, msg: str) -> None:
        can_respond = self.conn.our_state in (h11.IDLE, h11.SEND_RESPONSE)
        if self._is_busy():
            can_respond = can_respond and self.scope["method"] != "HEAD"  # no body allowed
            self.cycle.disconnected = True  # drop further output of the application
            self.cycle.message_event.set()
        if can_respond:
            super().send_400_response(msg)
        else:
            self.transport.close()

    def connection_lost(self, error: Exception | None) -> None:
        self._close_within(None)
        super().connection_lost(error)

    def pause_writing(self) -> None:
        super().pause_writing()
        self._close_within(self._timeouts.reader_s)

    def resume_writing(self) -> None:
        super().resume_writing()
        self._close_within(None)
        self._expect_head()

    def on_response_complete(self) -> None:
        super().on_response_complete()
        self._expect_head()

    def _is_busy(self) -> bool:
        return self.cycle is not None and not self.cycle.response_complete

    def _is_unread(self) -> bool:
        return self.transport.get_write_buffer_size() > 0

    def _is_idle(self) -> bool:
        return not self._is_busy() and not self._is_unread()

    def _deadline_s(self) -> float:
        return math.inf if self._deadline is None else self._deadline.when()

    def _expect_head(self) -> None:
        """Limit the wait for the next request's headers, unless a request or a response is in progress."""
        if self._is_idle():
            self._close_within(self._timeouts.head_s)

    def _close_within(self, seconds: float | None) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
        self._deadline = None if seconds is None else self.loop.call_later(seconds, self.transport.abort)


@contextmanager
def run_http_server(app: Any, listener: socket.socket, timeouts: ClientTimeouts) -> Iterator[None]:
    """Serve an ASGI application on a socket, in a separate thread, until the block ends."""
    config = uvicorn.Config(
        app,
        http=partial(_Connection, timeouts),  # type: ignore[arg-type]
        h11_max_incomplete_event_size=_MOST_HEAD_BYTES,
        ws="none",
        loop="asyncio",  # uvloop fails on exit if a connection was aborted
        proxy_headers=False,
        server_header=False,
        access_log=False,
        log_config=None,
        log_level="critical",
        backlog=_WAITING_CONNECTIONS,
        timeout_keep_alive=math.ceil(timeouts.head_s),
        timeout_graceful_shutdown=math.ceil(timeouts.end_s),
    )
    server = uvicorn.Server(config)
    thread = threading.Thread(target=partial(server.run, sockets=[listener]))
    thread.start()
    try:
        yield
    finally:
        server.should_exit = True
        thread.join()
