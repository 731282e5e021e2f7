"""Middleware that keeps new events of the page apart from a stream of results that is about to end."""

import asyncio
from collections import defaultdict
from contextlib import suppress

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from stereoweave.app.access import API, find_visitor

_STREAM, _JOIN = f"{API}/queue/data", f"{API}/queue/join"
_END = b'"close_stream"'
# Far longer than messages travel. Behind a proxy that hides disconnections, every end takes this long.
_PATIENCE_S = 5.0


class EndedStreams:
    """Middleware that answers a new event only after the window has read the end of its earlier stream.

    Gradio streams the results of a window's events, and ends the stream when no event is left. A window that
    starts an event before it has read this end opens no new stream, so it would wait forever. A window that
    has read the end disconnects.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app
        # Of each visitor, the ends that are sent and not read yet.
        self._unread: defaultdict[str, set[asyncio.Event]] = defaultdict(set)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        path = scope.get("path")
        if path == _STREAM:
            await self._stream(scope, receive, send)
        elif path == _JOIN:
            await self._app(scope, receive, self._wait_for_ends(send, find_visitor(scope)))
        else:
            await self._app(scope, receive, send)

    async def _stream(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Stream results, and keep the connection after their end until the window disconnects."""
        visitor, is_read = find_visitor(scope), asyncio.Event()

        async def send_and_watch(message: Message) -> None:
            if _END in message.get("body", b""):
                self._unread[visitor].add(is_read)
            elif is_read in self._unread[visitor]:
                await _wait_for_disconnection(receive)
            await send(message)

        try:
            await self._app(scope, receive, send_and_watch)
        finally:
            is_read.set()
            self._unread[visitor].discard(is_read)
            if not self._unread[visitor]:
                del self._unread[visitor]

    def _wait_for_ends(self, send: Send, visitor: str) -> Send:
        """Return a `send` that first waits until the visitor's windows have read all ends."""

        async def wait_and_send(message: Message) -> None:
            for is_read in list(self._unread.get(visitor, ())):
                await is_read.wait()
            await send(message)

        return wait_and_send


async def _wait_for_disconnection(receive: Receive) -> None:
    with suppress(TimeoutError):
        async with asyncio.timeout(_PATIENCE_S):
            while (await receive())["type"] != "http.disconnect":
                pass
