"""Middleware that makes each stream of results reach its window whole."""

import asyncio
from collections import defaultdict
from contextlib import suppress

from starlette.datastructures import MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from stereoweave.app.access import API, find_visitor

_STREAM, _JOIN = f"{API}/queue/data", f"{API}/queue/join"
_END = b'data: {"msg":"close_stream"'
# Longer than any message takes. Behind a proxy that hides disconnections, each stream stays open this long
# after its end.
_PATIENCE_S = 5.0


class EndedStreams:
    """Middleware that answers a visitor's new event only after the end of the stream before it is read.

    Gradio streams the results of a window's events, and ends the stream when no event is left. A window that
    starts an event before it has read this end opens no new stream, so it would wait forever. A window that
    has read the end disconnects. Visitors are told apart by the cookie of `OwnFiles`. Without a cookie,
    nothing is delayed.

    No stream is cached. Chromium lets a request wait for an unfinished one for the same URL, and sometimes
    sends it twice; what the server sends on the one that nobody reads would be lost.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app
        # Unread ends of streams, by visitor.
        self._unread: defaultdict[str, set[asyncio.Event]] = defaultdict(set)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        path = scope.get("path")
        if path == _STREAM:
            send = _forbid_caching(send)
        visitor = find_visitor(scope) if path in (_STREAM, _JOIN) else ""
        if visitor and path == _STREAM:
            await self._stream(visitor, scope, receive, send)
        elif visitor:
            await self._app(scope, receive, self._wait_for_ends(send, visitor))
        else:
            await self._app(scope, receive, send)

    async def _stream(self, visitor: str, scope: Scope, receive: Receive, send: Send) -> None:
        """Stream results, and keep the connection after their end until the window disconnects."""
        is_read = asyncio.Event()

        async def send_and_watch(message: Message) -> None:
            if message.get("body", b"").startswith(_END):
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
            if unread := self._unread.get(visitor):
                with suppress(TimeoutError):
                    async with asyncio.timeout(_PATIENCE_S):
                        await asyncio.gather(*(is_read.wait() for is_read in unread))
            await send(message)

        return wait_and_send


def _forbid_caching(send: Send) -> Send:
    async def send_uncached(message: Message) -> None:
        if message["type"] == "http.response.start":
            MutableHeaders(scope=message)["Cache-Control"] = "no-store"
        await send(message)

    return send_uncached


async def _wait_for_disconnection(receive: Receive) -> None:
    with suppress(TimeoutError):
        async with asyncio.timeout(_PATIENCE_S):
            while (await receive())["type"] != "http.disconnect":
                pass
