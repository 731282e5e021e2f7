"""The middleware between Gradio's streams of results and the events that a window starts meanwhile."""

import asyncio
import json
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import pytest
import uvicorn
from browsers import chromium

from stereoweave.app import streams
from stereoweave.app.streams import EndedStreams

STREAM, JOIN = "/gradio_api/queue/data", "/gradio_api/queue/join"
RESULT = b'data: {"msg":"process_completed","output":"close_stream"}\n\n'
END = b'data: {"msg":"close_stream","event_id":null}\n\n'
# Leaves a stream and opens the next one 100 times, as the page does at the end of each stream.
REOPEN = """async path => {
    for (let count = 0; count < 100; count++) {
        const leaving = new AbortController();
        const stream = await fetch(path, { signal: leaving.signal });
        await stream.body.getReader().read();
        await new Promise(resolve => setTimeout(resolve, count % 10));
        leaving.abort();
    }
}"""
COOKIES = ["a" * 43, "b" * 43]


async def answer(scope, receive, send):
    """Stream a result and its end, or answer that an event has joined the queue."""
    parts = [RESULT, END] if scope["path"] == STREAM else [b'{"event_id":"1"}']
    await send({"type": "http.response.start", "status": 200, "headers": []})
    for part in parts:
        await send({"type": "http.response.body", "body": part, "more_body": True})
    await send({"type": "http.response.body", "body": b"", "more_body": False})


class Request:
    """A request of a window to the application; `sent` are the bodies that it has received."""

    def __init__(self, app, path, cookie=None):
        headers = [] if cookie is None else [(b"cookie", f"stereoweave-visitor={cookie}".encode())]
        self.sent, self._left = [], asyncio.Event()
        scope = {"type": "http", "path": path, "headers": headers}
        self.task = asyncio.create_task(app(scope, self._receive, self._send))

    def leave(self):
        """Disconnect."""
        self._left.set()

    async def _receive(self):
        await self._left.wait()
        return {"type": "http.disconnect"}

    async def _send(self, message):
        if message.get("body"):
            self.sent.append(message["body"])


def run(scenario):
    """Run a scenario with an application that it shares with nothing."""

    async def run_in_time():
        async with asyncio.timeout(10):
            await scenario(EndedStreams(answer))

    asyncio.run(run_in_time())


@contextmanager
def serving(app: Callable) -> Iterator[str]:
    """Serve an application in a thread; yield its address."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        server = uvicorn.Server(uvicorn.Config(app, log_level="critical", lifespan="off"))
        thread = threading.Thread(target=server.run, args=([listener],))
        thread.start()
        try:
            yield f"http://127.0.0.1:{listener.getsockname()[1]}"
        finally:
            server.should_exit = True
            thread.join()


async def settle():
    for _ in range(20):
        await asyncio.sleep(0)


def test_an_event_is_answered_once_the_end_of_the_stream_before_it_is_read():
    async def scenario(app):
        stream = Request(app, STREAM, COOKIES[0])
        await settle()
        assert stream.sent == [RESULT, END]
        join = Request(app, JOIN, COOKIES[0])
        await settle()
        assert join.sent == []
        stream.leave()
        await asyncio.gather(stream.task, join.task)
        assert json.loads(join.sent[0]) == {"event_id": "1"}

    run(scenario)


@pytest.mark.parametrize("cookie", [COOKIES[1], None])
def test_the_events_of_others_and_of_browsers_without_cookies_do_not_wait(cookie):
    async def scenario(app):
        stream = Request(app, STREAM, COOKIES[0])
        await settle()
        join = Request(app, JOIN, cookie)
        await settle()
        assert join.sent
        stream.leave()
        await stream.task

    run(scenario)


def test_a_second_window_waits_for_the_ends_of_both():
    async def scenario(app):
        first, second = (Request(app, STREAM, COOKIES[0]) for _ in range(2))
        await settle()
        join = Request(app, JOIN, COOKIES[0])
        first.leave()
        await settle()
        assert join.sent == []
        second.leave()
        await join.task
        assert join.sent

    run(scenario)


def test_an_end_that_is_never_read_delays_an_event_for_a_limited_time(monkeypatch):
    monkeypatch.setattr(streams, "_PATIENCE_S", 0.05)

    async def scenario(app):
        stream = Request(app, STREAM, COOKIES[0])
        await settle()
        join = Request(app, JOIN, COOKIES[0])
        await asyncio.gather(join.task, stream.task)
        assert join.sent

    run(scenario)


def test_a_stream_that_breaks_off_after_its_end_delays_nothing():
    async def scenario(app):
        stream = Request(app, STREAM, COOKIES[0])
        await settle()
        stream.task.cancel()
        with suppress(asyncio.CancelledError):
            await stream.task
        join = Request(app, JOIN, COOKIES[0])
        await settle()
        assert join.sent

    run(scenario)


def test_other_requests_pass_through():
    async def scenario(app):
        other = Request(app, "/config")
        await other.task
        assert json.loads(other.sent[0]) == {"event_id": "1"}

    run(scenario)


@pytest.mark.system
@pytest.mark.needs_chromium
def test_a_browser_requests_each_stream_once():
    requested = 0

    async def stream(scope, receive, send):
        nonlocal requested
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body", "body": RESULT, "more_body": True})
        if scope["path"] == STREAM:
            requested += 1
            while (await receive())["type"] != "http.disconnect":
                pass
        await send({"type": "http.response.body", "body": b""})

    with serving(EndedStreams(stream)) as address, chromium() as browser:
        page = browser.new_page()
        page.goto(address)
        page.evaluate(REOPEN, STREAM)
    assert requested == 100
