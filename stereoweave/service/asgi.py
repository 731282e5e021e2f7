"""HTTP interface of the service: paths, responses, and a guard that limits requests."""

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
from stereoweave.errors import FormatError, MatcherError, StereoweaveError, format_error
from stereoweave.service.admission import BusyError
from stereoweave.service.answers import (
    MEDIA_TYPES,
    MOST_MEGAPIXELS,
    ServiceAnswer,
    ServiceJob,
    TooLargeError,
    field_name,
    strip_paths,
)
from stereoweave.service.forms import MapForm, PairForm, ViewForm, store_uploads
from stereoweave.system.child_process import NotStartedError, ProcessDiedError

# Some pending requests will have finished by then, or a process will have started.
_RETRY_AFTER_S = 1
_LATENCIES_S = [0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 60]
_PATHS = ("/disparity", "/depth", "/view")
_HEALTH = "/health"
# nginx's status for a client that disconnected before the response.
_CLIENT_GONE = 499
_DESCRIPTION = """Depth, and any view between the two cameras, from a stereo pair: POST a form with the files
`left` and `right`, or with one `picture` that holds both views. The response header `X-Stereoweave-Report`
has statistics and notes in JSON; every error is `{"detail": "..."}`."""


class Refusal(BaseModel):
    """An error response: one line with what was expected, what was found, and a remedy."""

    detail: str


_REFUSALS: dict[int | str, dict[str, Any]] = {
    status: {"model": Refusal, "description": description}
    for status, description in {
        400: "Unreadable picture or calibration, or malformed form.",
        401: "Missing or wrong token.",
        408: "The request did not arrive in time.",
        413: "More bytes or pixels than accepted, or more work than the time limit allows.",
        415: "Content type other than multipart/form-data.",
        422: "Unknown, missing or invalid field.",
        503: "Busy, or a worker process is starting: retry after the number of seconds in the header "
        "Retry-After. Also returned if the disk, the memory, the provider or a worker process fails.",
        504: "No response within the time limit.",
    }.items()
}

_Message = MutableMapping[str, Any]
_Receive = Callable[[], Awaitable[_Message]]
_Send = Callable[[_Message], Awaitable[None]]
_Server = Callable[[_Message, _Receive, _Send], Coroutine[Any, Any, None]]
# Errors whose message is sent to the client. TimeoutError is an OSError.
FAILURES = (StereoweaveError, OSError, MemoryError)
# Answers a job within the given number of seconds.
JobAnswerer = Callable[[ServiceJob, float], Awaitable[ServiceAnswer]]


class Limits(BaseModel):
    """Limits of a replica.

    Attributes:
        megabytes: Maximum size of a whole request.
        megapixels: Maximum size of each view of a pair.
        timeout_s: Maximum time from the arrival of a request's header to the start of the response.
        waiting: Maximum number of pending requests; further requests are refused.
        hosts: Allowed values of the Host header; None allows all values.
        token: Bearer token that every request except those to /health must contain; None for no token.
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
    answer_job: JobAnswerer, limits: Limits, folder: Path, registry: CollectorRegistry | None = None
) -> FastAPI:
    """Make the ASGI application of the service.

    Args:
        answer_job: Function that answers a job within a given number of seconds.
        limits: Limits on requests.
        folder: Folder that holds uploads until they are processed.
        registry: Metrics to serve at /metrics; if None, there is no such path.
    """
    app = FastAPI(
        title="Stereoweave",
        version=__version__,
        description=_DESCRIPTION,
        # These pages would load scripts from other hosts.
        docs_url=None,
        redoc_url=None,
    )
    if limits.hosts is not None:
        app.add_middleware(TrustedHostMiddleware, allowed_hosts=limits.hosts, www_redirect=False)

    app.add_exception_handler(RequestValidationError, _refuse)
    respond = _Responder(answer_job, limits.megapixels, folder)

    @app.post(
        "/disparity", responses=_list_responses(".png", ".pfm", ".npy", ".tiff"), response_class=Response
    )
    async def disparity(request: Request, form: _MapForm) -> Response:
        """Estimate the left view's disparity in pixels."""
        return await respond(request, form, f"disparity.{form.file}")

    @app.post("/depth", responses=_list_responses(".png", ".pfm", ".npy", ".tiff"), response_class=Response)
    async def depth(request: Request, form: _MapForm) -> Response:
        """Estimate the left view's metric depth.

        The camera is given by `calib`, by `focal_px` and `baseline_m`, or by EXIF data.
        """
        return await respond(request, form, f"depth.{form.file}")

    @app.post("/view", responses=_list_responses(".png", ".jpg"), response_class=Response)
    async def view(request: Request, form: _ViewForm) -> Response:
        """Render the view from another position on the line through the two cameras."""
        return await respond(request, form, f"view.{form.file}")

    @app.get(_HEALTH)
    async def health() -> dict[str, str]:
        """Confirm that the network is loaded and requests are accepted."""
        return {"status": "ok", "version": __version__}

    if registry is not None:

        @app.get("/metrics", response_class=Response)
        async def metrics() -> Response:
            """Return request metrics in the Prometheus text format."""
            return Response(generate_latest(registry), media_type="text/plain; version=0.0.4")

    return app


# What is expected of a form's field, by the type of Pydantic's error.
_EXPECTED = {
    "literal_error": "{expected}",
    "greater_than": "a number above {gt:g}",
    "greater_than_equal": "a number of at least {ge:g}",
    "less_than_equal": "a number of at most {le:g}",
    "finite_number": "a finite number",
    "float_parsing": "a number",
    "bool_parsing": "true or false",
}
_LONGEST_FOUND = 40


async def _refuse(_: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    return JSONResponse({"detail": _join_errors(error)}, 422)


def _list_responses(*endings: str) -> dict[int | str, dict[str, Any]]:
    files = {MEDIA_TYPES[ending]: {"schema": {"type": "string", "format": "binary"}} for ending in endings}
    report = {
        "X-Stereoweave-Report": {"description": "Statistics and notes in JSON.", "schema": {"type": "string"}}
    }
    return {200: {"content": files, "description": "The file.", "headers": report}, **_REFUSALS}


def _join_errors(error: RequestValidationError) -> str:
    return "; ".join(f"{each['loc'][-1]}: {_describe_mistake(each)}" for each in error.errors())


def _describe_mistake(mistake: Mapping[str, Any]) -> str:
    """Return what was expected of a form's field, and what was found."""
    kind, context, found = mistake["type"], mistake.get("ctx", {}), str(mistake.get("input"))[:_LONGEST_FOUND]
    match kind:
        case "value_error":
            # Our own text, or that of a file's field.
            text = str(context["error"])
            return "expected a file, found text" if text.startswith("Expected UploadFile") else text
        case "extra_forbidden":
            return "expected no such field; /openapi.json describes the fields"
    expected = _EXPECTED.get(kind, mistake["msg"].removeprefix("Input should be ")).format(**context)
    return f"expected {expected}, found {found!r}"


@dataclass(frozen=True)
class _Responder:
    """Callable that responds to a form.

    A temporary folder holds the form's files until the response is ready.
    """

    answer_job: JobAnswerer
    most_megapixels: float
    folder: Path

    async def __call__(self, request: Request, form: PairForm, file: str) -> Response:
        with self._make_folder() as name:
            try:
                job = await asyncio.to_thread(store_uploads, form, Path(name), file, self.most_megapixels)
                answer = await self.answer_job(job, request.state.deadline_s - time.monotonic())
            except FAILURES as error:
                raise _make_http_exception(error, Path(name)) from error
        return _make_response(answer, file)

    def _make_folder(self) -> TemporaryDirectory[str]:
        """Make a temporary folder for one request."""
        try:
            # Cleaners of /tmp remove folders that have not been used for days.
            self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            # A process may still use the folder after the request is cancelled.
            return TemporaryDirectory(dir=self.folder, ignore_cleanup_errors=True)
        except OSError as error:
            raise _make_http_exception(error, self.folder) from error


def _make_response(answer: ServiceAnswer, name: str) -> Response:
    headers = {
        "Content-Disposition": f'attachment; filename="{name}"',
        "X-Stereoweave-Report": answer.report,
    }
    return Response(answer.content, media_type=MEDIA_TYPES[Path(name).suffix], headers=headers)


def _make_http_exception(error: Exception, folder: Path) -> HTTPException:
    detail = strip_paths(format_error(error, field_name), folder)
    if not isinstance(error, StereoweaveError | TimeoutError):
        found = detail or "too little memory"
        detail = f"the service could not store or process the request ({found}); try again later"
    return HTTPException(_find_status(error), detail, _find_retry(error))


def _find_retry(error: Exception) -> dict[str, str] | None:
    """Return the header that tells when to retry; None if there is no such time."""
    match error:
        case BusyError():
            return {"Retry-After": str(error.retry_after_s)}
        case NotStartedError():
            return {"Retry-After": str(_RETRY_AFTER_S)}
    return None


def _find_status(error: Exception) -> int:
    match error:
        case TooLargeError():
            return 413
        case FormatError():
            return 400
        case MatcherError() | ProcessDiedError() | BusyError() | NotStartedError():
            return 503
        case TimeoutError():
            return 504
        case OSError() | MemoryError():
            return 503
    return 422


class _Metrics:
    """Request metrics in a Prometheus registry."""

    def __init__(self, registry: CollectorRegistry) -> None:
        self.requests = Counter(
            "stereoweave_requests", "Requests by path and status.", ["path", "status"], registry=registry
        )
        self.seconds = Histogram(
            "stereoweave_request_seconds",
            "Time from the header of an accepted request to its response.",
            ["path"],
            buckets=_LATENCIES_S,
            registry=registry,
        )


class Guard:
    """Middleware that checks tokens, and limits the number, size, content type and duration of POST requests.

    If there is a registry for metrics, the guard also counts and times POST requests.
    """

    def __init__(self, app: _Server, limits: Limits, registry: CollectorRegistry | None = None) -> None:
        self._app, self._limits, self._accepted = app, limits, 0
        self._metrics = _Metrics(registry) if registry is not None else None

    async def __call__(self, scope: _Message, receive: _Receive, send: _Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
        elif scope["method"] == "POST":
            await self._post(scope, receive, send)
        elif scope["path"] == _HEALTH or self._has_token(Headers(scope=scope)):
            await self._app(scope, receive, send)
        else:
            await _refuse_token()(scope, receive, send)

    async def _post(self, scope: _Message, receive: _Receive, send: _Send) -> None:
        start_s = time.perf_counter()
        exchange = _Exchange(receive, send, self._limits)
        # All unknown paths share one label, because clients must not be able to add labels.
        path = scope["path"] if scope["path"] in _PATHS else "none"
        refusal = self._find_refusal(Headers(scope=scope))
        try:
            if refusal is None:
                await self._accept(scope, exchange)
                if self._metrics:
                    self._metrics.seconds.labels(path).observe(time.perf_counter() - start_s)
            else:
                await refusal(scope, receive, exchange.send)
        finally:
            if self._metrics:
                self._metrics.requests.labels(path, str(exchange.status or _CLIENT_GONE)).inc()

    def _find_refusal(self, headers: Headers) -> Response | None:
        """Return an error response if the header shows that the request must be refused; None otherwise."""
        if not self._has_token(headers):
            return _refuse_token()
        if self._accepted >= self._limits.waiting:
            detail = (
                f"expected fewer than {self._limits.waiting} pending requests, found {self._accepted}; "
                "try again later"
            )
            return _make_refusal(503, detail, {"Retry-After": str(_RETRY_AFTER_S)})
        length = headers.get("content-length", "0")
        if length.isdecimal() and int(length) > self._limits.megabytes * 1e6:
            return _make_refusal(413, _describe_size_limit(self._limits))
        if not headers.get("content-type", "").lower().startswith("multipart/form-data"):
            return _make_refusal(415, "expected a multipart/form-data form, found another content type")
        return None

    def _has_token(self, headers: Headers) -> bool:
        """Return whether a request has the required token; True if no token is required."""
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
                await exchange.run_while_connected(self._app(scope, exchange.receive, exchange.send))
        except TimeoutError:
            if exchange.status is None:
                await exchange.refuse_late()(scope, exchange.receive, exchange.send)
        finally:
            self._accepted -= 1


class _Exchange:
    """A request of limited size, and the response to it.

    The attribute `status` is None until the response has begun.
    """

    def __init__(self, receive: _Receive, send: _Send, limits: Limits) -> None:
        self._receive, self._send, self._limits = receive, send, limits
        self._bytes, self._arrived = 0, asyncio.Event()
        self.status: int | None = None

    async def receive(self) -> _Message:
        message = await self._receive()
        self._bytes += len(message.get("body", b""))
        if self._bytes > self._limits.megabytes * 1e6:
            raise HTTPException(413, _describe_size_limit(self._limits))
        if not message.get("more_body", False):
            self._arrived.set()
        return message

    async def send(self, message: _Message) -> None:
        await self._send(message)  # waits for the client to read; if cancelled before that, nothing was sent
        self.status = message.get("status", self.status)

    async def run_while_connected(self, work: Coroutine[Any, Any, None]) -> None:
        """Run a coroutine; cancel it if the client disconnects."""
        working, watching = asyncio.create_task(work), asyncio.create_task(self._wait_for_disconnect())
        watching.add_done_callback(lambda _: working.cancel())
        try:
            await working
        except asyncio.CancelledError:
            if not watching.done():
                raise
        finally:
            watching.cancel()

    async def _wait_for_disconnect(self) -> None:
        """Wait until the whole request has arrived, then until the client disconnects."""
        await self._arrived.wait()
        while (await self._receive())["type"] != "http.disconnect":
            pass

    def refuse_late(self) -> Response:
        """Return the error response for a request that exceeded the time limit."""
        seconds = f"within {self._limits.timeout_s:g} s"
        if self._arrived.is_set():
            return _make_refusal(504, f"expected a result {seconds}, found none; send smaller pictures")
        return _make_refusal(408, f"expected the whole request {seconds}, found only part of it")


def _make_refusal(status: int, detail: str, headers: Mapping[str, str] | None = None) -> Response:
    return JSONResponse({"detail": detail}, status, headers)


def _refuse_token() -> Response:
    detail = "expected the header Authorization: Bearer with this service's token, found no valid token"
    return _make_refusal(401, detail, {"WWW-Authenticate": "Bearer"})


def _describe_size_limit(limits: Limits) -> str:
    return f"expected a request of at most {limits.megabytes:g} MB, found a larger one; send smaller pictures"
