"""How the service speaks HTTP: what its requests say, and the guard before them, who refuses some."""

import asyncio
import secrets
import time
from collections.abc import Awaitable, Callable, Coroutine, Mapping, MutableMapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

from fastapi import FastAPI, Form, HTTPException, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from prometheus_client import CollectorRegistry, Counter, Histogram, generate_latest
from pydantic import BaseModel, ConfigDict, Field, PositiveFloat, SecretStr
from starlette.datastructures import Headers
from starlette.middleware.trustedhost import TrustedHostMiddleware

from stereoweave import __version__
from stereoweave.errors import FormatError, MatcherError, StereoweaveError, worded
from stereoweave.service.admission import BusyError
from stereoweave.service.answers import (
    MEDIA_TYPES,
    MOST_MEGAPIXELS,
    Answer,
    ServiceJob,
    TooLargeError,
    field_name,
    without_paths,
)
from stereoweave.service.forms import MapForm, PairForm, ViewForm, stored
from stereoweave.system.child_process import ProcessDiedError

# In so long some of those that wait are done.
_RETRY_AFTER_S = 1
_LATENCIES_S = [0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 60]
_PATHS = ("/disparity", "/depth", "/view")
_HEALTH = "/health"
# As nginx has it: the client went away, and nobody was answered.
_CLIENT_GONE = 499
_DESCRIPTION = """Depth, and any view between the two cameras, of a rectified stereo pair: POST a form with
the files `left` and `right`, or with one `picture` of both views. The header `X-Stereoweave-Report` of a
response has numbers and notes in JSON; every error is `{"detail": "..."}`."""


class Refusal(BaseModel):
    """What is wrong with a request, in one line."""

    detail: str


_REFUSALS: dict[int | str, dict[str, Any]] = {
    status: {"model": Refusal, "description": description}
    for status, description in {
        400: "A picture or a calibration that cannot be read, or a form that is none.",
        401: "The service has a token, and the request has none, or another one.",
        408: "The request did not arrive in time.",
        413: "Too many bytes or pixels, or more work than the time limit allows.",
        415: "No multipart/form-data.",
        422: "A field that is unknown, missing, or says what cannot be.",
        503: "As many requests, or as much work, wait as are accepted: the header Retry-After says when to "
        "come again. Or the disk, the memory or what the network runs on failed, or the process that worked "
        "on the request crashed.",
        504: "No answer in time.",
    }.items()
}

_Message = MutableMapping[str, Any]
_Receive = Callable[[], Awaitable[_Message]]
_Send = Callable[[_Message], Awaitable[None]]
_Server = Callable[[_Message, _Receive, _Send], Coroutine[Any, Any, None]]
# Errors whose message is sent to the client. TimeoutError is an OSError.
FAILURES = (StereoweaveError, OSError, MemoryError)
# Of a job, and the seconds that are left for it.
Answering = Callable[[ServiceJob, float], Awaitable[Answer]]


class Limits(BaseModel):
    """What a replica accepts.

    Attributes:
        megabytes: Of a request, all of it.
        megapixels: Of a view.
        timeout_s: From the head of a request to that of its response.
        waiting: Requests that are accepted and not answered yet; more are refused.
        hosts: The names that the header Host may have; any where None.
        token: What a request has to show (`Authorization: Bearer`), except for /health; nothing where None.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    megabytes: PositiveFloat = 64
    megapixels: Annotated[float, Field(gt=0, le=MOST_MEGAPIXELS)] = 25
    timeout_s: PositiveFloat = 60
    waiting: Annotated[int, Field(ge=1)] = 8
    hosts: tuple[str, ...] | None = None
    token: SecretStr | None = None


_MapForm = Annotated[MapForm, Form(media_type="multipart/form-data")]
_ViewForm = Annotated[ViewForm, Form(media_type="multipart/form-data")]


def make_app(
    answering: Answering, limits: Limits, folder: Path, registry: CollectorRegistry | None = None
) -> FastAPI:
    """The application: `answering` does the work, and uploads lie in the folder until it is done.

    The metrics of the registry are at /metrics; without a registry there is no such path.
    """
    app = FastAPI(
        title="Stereoweave",
        version=__version__,
        description=_DESCRIPTION,
        # Their pages would load scripts from elsewhere.
        docs_url=None,
        redoc_url=None,
    )
    if limits.hosts is not None:
        app.add_middleware(TrustedHostMiddleware, allowed_hosts=limits.hosts, www_redirect=False)

    @app.exception_handler(RequestValidationError)
    async def _refuse(_: Request, error: RequestValidationError) -> Response:
        return JSONResponse({"detail": _in_one_line(error)}, 422)

    answered = _Answers(answering, limits.megapixels, folder)

    @app.post("/disparity", responses=_responses(".png", ".pfm", ".npy", ".tiff"), response_class=Response)
    async def disparity(request: Request, form: _MapForm) -> Response:
        """The left view's disparity in pixels."""
        return await answered(request, form, f"disparity.{form.file}")

    @app.post("/depth", responses=_responses(".png", ".pfm", ".npy", ".tiff"), response_class=Response)
    async def depth(request: Request, form: _MapForm) -> Response:
        """Its depth along the optical axis; needs a camera: calib, focal_px and baseline_m, or EXIF."""
        return await answered(request, form, f"depth.{form.file}")

    @app.post("/view", responses=_responses(".png", ".jpg"), response_class=Response)
    async def view(request: Request, form: _ViewForm) -> Response:
        """What a camera elsewhere on the line through the two would have seen."""
        return await answered(request, form, f"view.{form.file}")

    @app.get(_HEALTH)
    async def health() -> dict[str, str]:
        """That the network is loaded, and requests are taken."""
        return {"status": "ok", "version": __version__}

    if registry is not None:

        @app.get("/metrics", response_class=Response)
        async def metrics() -> Response:
            """The counts of requests, in Prometheus' text format."""
            return Response(generate_latest(registry), media_type="text/plain; version=0.0.4")

    return app


def _responses(*endings: str) -> dict[int | str, dict[str, Any]]:
    files = {MEDIA_TYPES[ending]: {"schema": {"type": "string", "format": "binary"}} for ending in endings}
    report = {
        "X-Stereoweave-Report": {"description": "Numbers and notes, in JSON.", "schema": {"type": "string"}}
    }
    return {200: {"content": files, "description": "The file.", "headers": report}, **_REFUSALS}


def _in_one_line(error: RequestValidationError) -> str:
    return "; ".join(
        f"{each['loc'][-1]}: {each['msg'].removeprefix('Value error, ')}" for each in error.errors()
    )


@dataclass(frozen=True)
class _Answers:
    """Makes the response to a form, whose files lie in a folder of their own until then."""

    answering: Answering
    most_megapixels: float
    folder: Path

    async def __call__(self, request: Request, form: PairForm, file: str) -> Response:
        with self._made() as name:
            try:
                job = await asyncio.to_thread(stored, form, Path(name), file, self.most_megapixels)
                answer = await self.answering(job, request.state.deadline_s - time.monotonic())
            except FAILURES as error:
                raise _refusal_of(error, Path(name)) from error
        return _file(answer, file)

    def _made(self) -> TemporaryDirectory[str]:
        """A folder for one request."""
        try:
            # What cleans /tmp removes what has not been used for days.
            self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            # Where the request is cancelled, a process may still work in it.
            return TemporaryDirectory(dir=self.folder, ignore_cleanup_errors=True)
        except OSError as error:
            raise _refusal_of(error, self.folder) from error


def _file(answer: Answer, name: str) -> Response:
    headers = {
        "Content-Disposition": f'attachment; filename="{name}"',
        "X-Stereoweave-Report": answer.report,
    }
    return Response(answer.content, media_type=MEDIA_TYPES[Path(name).suffix], headers=headers)


def _refusal_of(error: Exception, folder: Path) -> HTTPException:
    headers = {"Retry-After": str(error.retry_after_s)} if isinstance(error, BusyError) else None
    detail = without_paths(worded(error, field_name), folder)
    if not isinstance(error, StereoweaveError | TimeoutError):
        found = detail or "too little memory"
        detail = f"expected room for the request on the disk and in memory, found {found}; come again"
    return HTTPException(_status(error), detail, headers)


def _status(error: Exception) -> int:
    match error:
        case TooLargeError():
            return 413
        case FormatError():
            return 400
        case MatcherError() | ProcessDiedError() | BusyError():
            return 503
        case TimeoutError():
            return 504
        case OSError() | MemoryError():
            return 503
    return 422


class Guard:
    """Before an application: refuses what is posted and too much, too large or no form, and counts all."""

    def __init__(self, app: _Server, limits: Limits, registry: CollectorRegistry | None = None) -> None:
        self._app, self._limits, self._accepted = app, limits, 0
        self._requests = Counter(
            "stereoweave_requests", "Requests by path and status.", ["path", "status"], registry=registry
        )
        self._seconds = Histogram(
            "stereoweave_request_seconds",
            "From the head of a request to its response, of those accepted.",
            ["path"],
            buckets=_LATENCIES_S,
            registry=registry,
        )

    async def __call__(self, scope: _Message, receive: _Receive, send: _Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
        elif scope["method"] == "POST":
            await self._post(scope, receive, send)
        elif scope["path"] == _HEALTH or self._knows(Headers(scope=scope)):
            await self._app(scope, receive, send)
        else:
            await _stranger()(scope, receive, send)

    async def _post(self, scope: _Message, receive: _Receive, send: _Send) -> None:
        start_s = time.perf_counter()
        exchange = _Exchange(receive, send, self._limits)
        # Not every path that a client may think of.
        path = scope["path"] if scope["path"] in _PATHS else "none"
        refusal = self._refusal(Headers(scope=scope))
        try:
            if refusal is None:
                await self._accept(scope, exchange)
                self._seconds.labels(path).observe(time.perf_counter() - start_s)
            else:
                await refusal(scope, receive, exchange.send)
        finally:
            status = str(exchange.status or _CLIENT_GONE)
            self._requests.labels(path, status).inc()

    def _refusal(self, headers: Headers) -> Response | None:
        """The response to a request of which the head says that it is not accepted."""
        if not self._knows(headers):
            return _stranger()
        if self._accepted >= self._limits.waiting:
            detail = f"expected at most {self._limits.waiting} requests at a time, found as many; come again"
            return _refused(503, detail, {"Retry-After": str(_RETRY_AFTER_S)})
        length = headers.get("content-length", "0")
        if length.isdecimal() and int(length) > self._limits.megabytes * 1e6:
            return _refused(413, _too_large(self._limits))
        if not headers.get("content-type", "").lower().startswith("multipart/form-data"):
            return _refused(415, "expected multipart/form-data, a form with the pictures as its files")
        return None

    def _knows(self, headers: Headers) -> bool:
        """Whether a request shows the token, where there is one."""
        token = self._limits.token
        if token is None:
            return True
        expected = f"Bearer {token.get_secret_value()}"
        return secrets.compare_digest(headers.get("authorization", "").encode(), expected.encode())

    async def _accept(self, scope: _Message, exchange: "_Exchange") -> None:
        self._accepted += 1
        scope.setdefault("state", {})["deadline_s"] = time.monotonic() + self._limits.timeout_s
        try:
            async with asyncio.timeout(self._limits.timeout_s):
                await exchange.while_connected(self._app(scope, exchange.receive, exchange.send))
        except TimeoutError:
            if exchange.status is None:
                await exchange.late()(scope, exchange.receive, exchange.send)
        finally:
            self._accepted -= 1


class _Exchange:
    """A request whose bytes are counted, and the status of its response, None before it."""

    def __init__(self, receive: _Receive, send: _Send, limits: Limits) -> None:
        self._receive, self._send, self._limits = receive, send, limits
        self._bytes, self._arrived = 0, asyncio.Event()
        self.status: int | None = None

    async def receive(self) -> _Message:
        message = await self._receive()
        self._bytes += len(message.get("body", b""))
        if self._bytes > self._limits.megabytes * 1e6:
            raise HTTPException(413, _too_large(self._limits))
        if not message.get("more_body", False):
            self._arrived.set()
        return message

    async def send(self, message: _Message) -> None:
        await self._send(message)  # waits for the client to read; nothing is sent if it is cancelled then
        self.status = message.get("status", self.status)

    async def while_connected(self, work: Coroutine[Any, Any, None]) -> None:
        """Do the work, and cancel it where the client goes away."""
        working, watching = asyncio.create_task(work), asyncio.create_task(self._gone())
        watching.add_done_callback(lambda _: working.cancel())
        try:
            await working
        except asyncio.CancelledError:
            if not watching.done():
                raise
        finally:
            watching.cancel()

    async def _gone(self) -> None:
        """Return when the client has gone away, after all of its request arrived."""
        await self._arrived.wait()
        while (await self._receive())["type"] != "http.disconnect":
            pass

    def late(self) -> Response:
        """The response to a request that takes too long: to arrive, or to be answered."""
        seconds = f"within {self._limits.timeout_s:g} s"
        if self._arrived.is_set():
            return _refused(504, f"expected to be done {seconds}, and was not; send smaller pictures")
        return _refused(408, f"expected the whole request {seconds}, found a part of it")


def _refused(status: int, detail: str, headers: Mapping[str, str] | None = None) -> Response:
    return JSONResponse({"detail": detail}, status, headers)


def _stranger() -> Response:
    detail = (
        "expected the header Authorization: Bearer and the token of this service, found none or another one"
    )
    return _refused(401, detail, {"WWW-Authenticate": "Bearer"})


def _too_large(limits: Limits) -> str:
    return f"expected a request of at most {limits.megabytes:g} MB, found a larger one; send smaller pictures"
