"""The service's HTTP interface without a server, with simple functions that answer the jobs."""

import asyncio
import tempfile
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from prometheus_client import CollectorRegistry
from service_examples import BOTH

from stereoweave.errors import ProviderError
from stereoweave.service.admission import BusyError
from stereoweave.service.answers import ServiceAnswer, ServiceJob, TooLargeError
from stereoweave.system.child_process import NotStartedError, ProcessDiedError

# Pydantic warns about Ray Serve when that is imported.
pytestmark = pytest.mark.filterwarnings("ignore:Using extra keyword arguments on `Field`:DeprecationWarning")


def make_client(
    answer_job: Any, registry: CollectorRegistry | None = None, folder: Path | None = None, **limits: Any
) -> httpx.AsyncClient:
    """Return a client of the service without a server; a function answers its jobs."""
    from stereoweave.service.asgi import Guard, Limits, make_app

    allowed = Limits(**limits)
    app = make_app(answer_job, allowed, folder or Path(tempfile.gettempdir()), registry)
    app = Guard(app, allowed, registry)
    return httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://service")


FORM = {"Content-Type": "multipart/form-data; boundary=b"}


def ask_guard(
    answer_job: Any, content: AsyncIterator[bytes] | bytes | None = None, **limits: Any
) -> httpx.Response:
    """Return the response of a guard, whose limits are the service's own by default."""

    async def ask() -> httpx.Response:
        async with make_client(answer_job, **limits) as client:
            if content is None:
                return await client.post("/disparity", files=BOTH)
            return await client.post("/disparity", content=content, headers=FORM)

    return asyncio.run(ask())


async def wait_forever(job: ServiceJob, left_s: float) -> ServiceAnswer:
    await asyncio.Event().wait()


def test_a_failing_provider_is_a_server_error():
    async def fails(job: ServiceJob, left_s: float) -> ServiceAnswer:
        raise ProviderError(
            "provider cuda: expected to run /srv/net.onnx, found that it failed: out of memory"
        )

    response = ask_guard(fails)
    assert response.status_code == 503
    assert response.json()["detail"] == (
        "provider cuda: expected to run net.onnx, found that it failed: out of memory"
    )


def test_a_job_that_takes_too_long_is_cancelled():
    response = ask_guard(wait_forever, timeout_s=2)
    assert response.status_code == 504
    assert response.json()["detail"].startswith("expected a result within 2 s")


def test_a_request_that_does_not_arrive_in_time_is_refused():
    async def stalls() -> AsyncIterator[bytes]:
        yield b"--b\r\n"
        await asyncio.Event().wait()

    response = ask_guard(wait_forever, stalls(), timeout_s=0.2)
    assert response.status_code == 408
    assert "found only part of it" in response.json()["detail"]


def test_no_more_requests_are_accepted_at_once_than_the_limit_of_pending_ones():
    async def ask() -> list[int]:
        done, accepted = asyncio.Event(), []

        async def waits(job: ServiceJob, left_s: float) -> ServiceAnswer:
            accepted.append(job)
            await done.wait()
            return ServiceAnswer(content=b"", report="{}")

        async with make_client(waits, waiting=2) as client:
            first = [asyncio.create_task(client.post("/disparity", files=BOTH)) for _ in range(2)]
            while len(accepted) < 2:
                await asyncio.sleep(0)
            third = await client.post("/disparity", files=BOTH)
            done.set()
            answered = await asyncio.gather(*first)
            after = await client.post("/disparity", files=BOTH)
            return [response.status_code for response in (third, *answered, after)]

    assert asyncio.run(ask()) == [503, 200, 200, 200]


def test_a_request_without_a_length_is_refused_once_it_exceeds_the_size_limit():
    sent = []

    async def streams() -> AsyncIterator[bytes]:
        yield b'--b\r\nContent-Disposition: form-data; name="left"; filename="l"\r\n\r\n'
        for _ in range(30):
            sent.append(100_000)
            yield bytes(100_000)

    response = ask_guard(wait_forever, streams(), megabytes=1)
    assert response.status_code == 413
    assert "expected a request of at most 1 MB" in response.json()["detail"]
    assert sum(sent) == 1_000_000  # exceeds 1 MB together with the header of the part


@pytest.mark.parametrize(
    ("headers", "path", "status"),
    [
        ({"Authorization": "Bearer secret-1"}, "/openapi.json", 200),
        ({"Authorization": "Bearer secret-2"}, "/openapi.json", 401),
        ({"Authorization": "Bearer secret-1 "}, "/metrics", 401),
        ({"Authorization": "Basic secret-1"}, "/metrics", 401),
        ({"Authorization": "Bearer \xe4"}, "/metrics", 401),
        ({}, "/metrics", 401),
        ({}, "/nothing", 401),
        ({}, "/health/", 401),
        ({}, "/health", 200),
    ],
)
def test_if_a_token_is_set_every_path_but_health_requires_it(headers, path, status):
    async def get() -> httpx.Response:
        async with make_client(wait_forever, token="secret-1") as client:
            return await client.get(path, headers={k: v.encode("latin-1") for k, v in headers.items()})

    response = asyncio.run(get())
    assert response.status_code == status
    if status == 401:
        assert response.headers["WWW-Authenticate"] == "Bearer"
        assert "secret" not in response.text
        assert response.json()["detail"].startswith("expected the header Authorization: Bearer")


def test_a_form_without_the_token_is_refused_before_its_body_is_read():
    async def never_sent() -> AsyncIterator[bytes]:
        await asyncio.Event().wait()
        yield b""

    assert ask_guard(wait_forever, never_sent(), token="secret").status_code == 401


def test_work_for_a_client_that_disconnects_is_cancelled():
    from stereoweave.service.asgi import Guard, Limits, make_app

    async def leave() -> bool:
        begun, cancelled = asyncio.Event(), asyncio.Event()

        async def waits(job: ServiceJob, left_s: float) -> ServiceAnswer:
            begun.set()
            try:
                await asyncio.Event().wait()
            finally:
                cancelled.set()

        request = httpx.Request("POST", "http://service/disparity", files=BOTH)
        messages = [{"type": "http.request", "body": request.read()}]

        async def receive() -> dict[str, Any]:
            if messages:
                return messages.pop()
            await begun.wait()
            return {"type": "http.disconnect"}

        async def send(message: Any) -> None:
            raise AssertionError("nobody listens")

        scope = {
            "type": "http",
            "method": "POST",
            "path": "/disparity",
            "query_string": b"",
            "headers": [(name.lower(), value) for name, value in request.headers.raw],
        }
        app = Guard(make_app(waits, Limits(), Path(tempfile.gettempdir())), Limits())
        await asyncio.wait_for(app(scope, receive, send), 10)
        return cancelled.is_set()

    assert asyncio.run(leave())


@pytest.mark.parametrize(
    ("error", "status", "header"),
    [
        (TooLargeError("too large"), 413, None),
        (BusyError("busy", retry_after_s=7), 503, "7"),
        (ProcessDiedError("it crashed"), 503, None),
        (TimeoutError("late"), 504, None),
        (NotStartedError("the process is still starting; try again later"), 503, "1"),
    ],
)
def test_each_kind_of_error_has_its_status(error, status, header):
    async def fails(job: ServiceJob, left_s: float) -> ServiceAnswer:
        raise error

    response = ask_guard(fails)
    assert response.status_code == status
    assert response.json() == {"detail": str(error)}
    assert response.headers.get("Retry-After") == header


async def answer_at_once(job: ServiceJob, left_s: float) -> ServiceAnswer:
    return ServiceAnswer(content=job.pictures[0].read_bytes(), report="{}")


def test_a_removed_upload_folder_is_made_again(tmp_path):
    folder = tmp_path / "emptied" / "own"
    response = ask_guard(answer_at_once, folder=folder)
    assert (response.status_code, response.content) == (200, BOTH["left"])
    assert folder.stat().st_mode & 0o777 == 0o700


@pytest.mark.parametrize(
    ("error", "found"),
    [
        (OSError(28, "No space left on device", "/srv/files/left"), "No space left on device: 'left'"),
        (MemoryError("Unable to allocate\n4 GiB"), "Unable to allocate 4 GiB"),
        (MemoryError(), "too little memory"),
    ],
)
def test_a_full_disk_or_memory_is_a_server_error(error, found):
    async def fails(job: ServiceJob, left_s: float) -> ServiceAnswer:
        raise error

    response = ask_guard(fails)
    assert response.status_code == 503
    detail = response.json()["detail"]
    assert detail.startswith("the service could not store or process the request (")
    assert found in detail
    assert "\n" not in detail


def test_a_flood_of_metrics_requests_does_not_delay_other_requests():
    async def flood() -> tuple[int, set[int], str]:
        async with make_client(answer_at_once, CollectorRegistry()) as client:
            asked = [asyncio.create_task(client.get("/metrics")) for _ in range(50)]
            posted = await client.post("/disparity", files=BOTH)
            statuses = {each.status_code for each in await asyncio.gather(*asked)}
            return posted.status_code, statuses, (await client.get("/metrics")).text

    posted, asked, text = asyncio.run(flood())
    assert (posted, asked) == (200, {200})
    assert 'stereoweave_requests_total{path="/disparity",status="200"} 1.0\n' in text
    assert 'stereoweave_request_seconds_count{path="/disparity"} 1.0\n' in text


def test_without_a_registry_there_are_no_metrics(monkeypatch):
    async def get() -> httpx.Response:
        async with make_client(answer_at_once) as client:
            assert (await client.post("/disparity", files=BOTH)).status_code == 200
            return await client.get("/metrics")

    monkeypatch.delattr("stereoweave.service.asgi.Counter")
    monkeypatch.delattr("stereoweave.service.asgi.Histogram")
    assert asyncio.run(get()).status_code == 404


def test_a_response_that_cannot_start_in_time_is_replaced_by_a_timeout_error():
    from stereoweave.service.asgi import Guard, Limits, make_app

    async def answers(job: ServiceJob, left_s: float) -> ServiceAnswer:
        return ServiceAnswer(content=b"done", report="{}")

    async def ask() -> httpx.Response:
        limits, unread = Limits(timeout_s=2), [asyncio.Event()]
        guard = Guard(make_app(answers, limits, Path(tempfile.gettempdir())), limits)

        async def to_a_slow_reader(scope: Any, receive: Any, send: Any) -> None:
            async def send_when_read(message: Any) -> None:
                if unread:  # the first time: an earlier response is still unread
                    await unread.pop().wait()
                await send(message)

            await guard(scope, receive, send_when_read)

        transport = httpx.ASGITransport(to_a_slow_reader)
        async with httpx.AsyncClient(transport=transport, base_url="http://service") as client:
            return await client.post("/disparity", files=BOTH)

    assert asyncio.run(ask()).status_code == 504
