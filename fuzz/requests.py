"""HTTP requests read from files and passed to an ASGI application as by a server."""

import asyncio
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any
from urllib.parse import unquote

import h11
import httpx

_Message = MutableMapping[str, Any]
Application = Callable[
    [_Message, Callable[[], Awaitable[_Message]], Callable[[_Message], Awaitable[None]]], Awaitable[None]
]


class ServerError(Exception):
    """Error raised for a response with status 500 or a missing response."""


def request_bytes(method: str, path: str, **form: Any) -> bytes:
    """Return a request as the bytes sent over the network; `form` is passed to httpx."""
    request = httpx.Request(method, f"http://127.0.0.1{path}", **form)
    body = request.read()
    headers = [name + b": " + value for name, value in request.headers.raw]
    head = [f"{method} {path} HTTP/1.1".encode(), *headers]
    return b"\r\n".join(head) + b"\r\n\r\n" + body


def repair_length(content: bytes) -> bytes:
    """Set the Content-Length of a request to the length of its body."""
    head, blank, body = content.partition(b"\r\n\r\n")
    lines = [line for line in head.split(b"\r\n") if not line.lower().startswith(b"content-length")]
    return b"\r\n".join([*lines, b"Content-Length: %d" % len(body)]) + blank + body


def send(application: Application, content: bytes) -> int | None:
    """Send a request. Return the status of the response, or None if the content is not an HTTP request.

    Raises:
        ServerError: The status is 500.
        Exception: Any error of the application.
    """
    events = _parse(content)
    if not events or not isinstance(events[0], h11.Request):
        return None
    return asyncio.run(_exchange(application, events[0], events[1:]))


def _parse(content: bytes) -> list[Any]:
    """Parse a request into h11 events: the head, parts of the body, and the end if the body is complete."""
    connection, events = h11.Connection(h11.SERVER), []
    try:
        connection.receive_data(content or b"\r\n")  # empty data would mean a closed connection
        while (event := connection.next_event()) not in (h11.NEED_DATA, h11.PAUSED):
            events.append(event)
    except h11.RemoteProtocolError:
        return events
    return events


async def _exchange(application: Application, head: h11.Request, body: list[Any]) -> int | None:
    messages: list[_Message] = [
        {"type": "http.request", "body": bytes(event.data), "more_body": True}
        if isinstance(event, h11.Data)
        else {"type": "http.request", "body": b"", "more_body": False}
        for event in body
        if isinstance(event, h11.Data | h11.EndOfMessage)
    ]
    is_whole = any(isinstance(event, h11.EndOfMessage) for event in body)
    status: list[int] = []

    async def receive() -> _Message:
        if messages:
            return messages.pop(0)
        if is_whole:
            await asyncio.Event().wait()  # the client waits for the response
        return {"type": "http.disconnect"}  # the client left before the body was complete

    async def respond(message: _Message) -> None:
        if message["type"] == "http.response.start":
            status.append(message["status"])

    await application(_scope(head), receive, respond)
    if status[:1] == [500]:
        raise ServerError("status 500")
    return status[0] if status else None


def _scope(head: h11.Request) -> _Message:
    path, _, query = head.target.partition(b"?")
    return {
        "type": "http",
        "asgi": {"version": "3.0", "spec_version": "2.3"},
        "http_version": head.http_version.decode(),
        "method": head.method.decode(),
        "scheme": "http",
        "path": unquote(path.decode()),
        "raw_path": path,
        "query_string": query,
        "root_path": "",
        "headers": list(head.headers),
        "client": ("127.0.0.1", 40_000),
        "server": ("127.0.0.1", 8000),
        "state": {},
    }
