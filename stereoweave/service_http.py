"""How the service speaks HTTP: what its requests say, and the guard before them, who refuses some."""

import asyncio
import time
from collections.abc import Awaitable, Callable, Mapping, MutableMapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

from fastapi import FastAPI, Form, HTTPException, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel, ConfigDict, Field, PositiveFloat
from ray.serve.metrics import Counter, Histogram
from starlette.datastructures import Headers

from stereoweave import __version__
from stereoweave.errors import FormatError, MatcherError, StereoweaveError
from stereoweave.service_forms import MapForm, PairForm, ViewForm, stored
from stereoweave.service_requests import (
    MEDIA_TYPES,
    MOST_MEGAPIXELS,
    Answer,
    Order,
    TooLargeError,
    check_pixels,
    told,
)

# In so long some of those that wait are done.
_RETRY_AFTER_S = 1
_LATENCIES_S = [0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 60]
_PATHS = ("/disparity", "/depth", "/view")
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
        408: "The request did not arrive in time.",
        413: "Too many bytes, or pixels.",
        415: "No multipart/form-data.",
        422: "A field that is unknown, missing, or says what cannot be.",
        503: "As many requests wait as are accepted: the header Retry-After says when to come again. Or what "
        "the network runs on failed.",
        504: "No answer in time.",
    }.items()
}

_Message = MutableMapping[str, Any]
_Receive = Callable[[], Awaitable[_Message]]
_Send = Callable[[_Message], Awaitable[None]]
_Server = Callable[[_Message, _Receive, _Send], Awaitable[None]]
Answering = Callable[[Order, float], Awaitable[Answer]]


class Limits(BaseModel):
    """What a replica accepts.

    Attributes:
        megabytes: Of a request, all of it.
        megapixels: Of a view.
        timeout_s: From the head of a request to that of its response.
        waiting: Requests that are accepted and not answered yet; more are refused.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    megabytes: PositiveFloat = 64
    megapixels: Annotated[float, Field(gt=0, le=MOST_MEGAPIXELS)] = 25
    timeout_s: PositiveFloat = 60
    waiting: Annotated[int, Field(ge=1)] = 8


_MapForm = Annotated[MapForm, Form(media_type="multipart/form-data")]
_ViewForm = Annotated[ViewForm, Form(media_type="multipart/form-data")]


def make_app(answering: Answering, limits: Limits, metrics: Callable[[], bytes]) -> FastAPI:
    """The application. `answering` does the work, of an order and its megapixels."""
    app = FastAPI(
        title="Stereoweave",
        version=__version__,
        description=_DESCRIPTION,
        # Their pages would load scripts from elsewhere.
        docs_url=None,
        redoc_url=None,
    )

    @app.exception_handler(RequestValidationError)
    async def _refuse(_: Request, error: RequestValidationError) -> Response:
        return JSONResponse({"detail": _in_one_line(error)}, 422)

    @app.post("/disparity", responses=_responses(".png", ".pfm", ".npy", ".tiff"), response_class=Response)
    async def disparity(form: _MapForm) -> Response:
        """The left view's disparity in pixels."""
        return await _answered(form, f"disparity.{form.file}", answering, limits)

    @app.post("/depth", responses=_responses(".png", ".pfm", ".npy", ".tiff"), response_class=Response)
    async def depth(form: _MapForm) -> Response:
        """Its depth along the optical axis; needs a camera: calib, focal_px and baseline_m, or EXIF."""
        return await _answered(form, f"depth.{form.file}", answering, limits)

    @app.post("/view", responses=_responses(".png", ".jpg"), response_class=Response)
    async def view(form: _ViewForm) -> Response:
        """What a camera elsewhere on the line through the two would have seen."""
        return await _answered(form, f"view.{form.file}", answering, limits)

    @app.get("/health")
    async def health() -> dict[str, str]:
        """That the network is loaded, and requests are taken."""
        return {"status": "ok", "version": __version__}

    @app.get("/metrics", response_class=Response)
    async def prometheus() -> Response:
        """What is counted, in Prometheus' text format."""
        try:
            text = await asyncio.to_thread(metrics)
        except OSError as error:
            raise HTTPException(503, f"expected Ray's exporters of metrics, found {error}") from error
        return Response(text, media_type="text/plain; version=0.0.4")

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


async def _answered(form: PairForm, file: str, answering: Answering, limits: Limits) -> Response:
    # Where it is cancelled, a thread may still work in the folder.
    with TemporaryDirectory(prefix="stereoweave-", ignore_cleanup_errors=True) as name:
        try:
            order = await asyncio.to_thread(stored, form, Path(name), file, limits.megapixels)
            megapixels = await asyncio.to_thread(check_pixels, order)
            answer = await answering(order, megapixels)
        except StereoweaveError as error:
            raise HTTPException(_status(error), told(error, Path(name))) from error
    return Response(
        answer.content,
        media_type=MEDIA_TYPES[Path(file).suffix],
        headers={
            "Content-Disposition": f'attachment; filename="{file}"',
            "X-Stereoweave-Report": answer.report,
        },
    )


def _status(error: StereoweaveError) -> int:
    match error:
        case TooLargeError():
            return 413
        case FormatError():
            return 400
        case MatcherError():
            return 503
    return 422


class Guard:
    """Before an application: refuses what is posted and too much, too large or no form, and counts all."""

    def __init__(self, app: _Server, limits: Limits) -> None:
        self._app, self._limits, self._accepted = app, limits, 0
        self._requests = Counter(
            "stereoweave_requests",
            "Requests by path and status.",
            tag_keys=("path", "status"),  # type: ignore[arg-type]
        )
        self._seconds = Histogram(
            "stereoweave_request_seconds",
            "From the head of a request to its response, of those accepted.",
            boundaries=_LATENCIES_S,
            tag_keys=("path",),
        )

    async def __call__(self, scope: _Message, receive: _Receive, send: _Send) -> None:
        if scope["type"] != "http" or scope["method"] != "POST":
            await self._app(scope, receive, send)
            return
        start_s = time.perf_counter()
        exchange = _Exchange(receive, send, self._limits)
        # Not every path that a client may think of.
        path = scope["path"] if scope["path"] in _PATHS else "none"
        refusal = self._refusal(Headers(scope=scope))
        try:
            if refusal is None:
                await self._accept(scope, exchange)
                self._seconds.observe(time.perf_counter() - start_s, tags={"path": path})
            else:
                await refusal(scope, receive, exchange.send)
        finally:
            status = str(exchange.status or _CLIENT_GONE)
            self._requests.inc(tags={"path": path, "status": status})

    def _refusal(self, headers: Headers) -> Response | None:
        """The response to a request of which the head says that it is not accepted."""
        if self._accepted >= self._limits.waiting:
            detail = f"expected at most {self._limits.waiting} requests at a time, found as many; come again"
            return _refused(503, detail, {"Retry-After": str(_RETRY_AFTER_S)})
        length = headers.get("content-length", "0")
        if length.isdecimal() and int(length) > self._limits.megabytes * 1e6:
            return _refused(413, _too_large(self._limits))
        if not headers.get("content-type", "").lower().startswith("multipart/form-data"):
            return _refused(415, "expected multipart/form-data, a form with the pictures as its files")
        return None

    async def _accept(self, scope: _Message, exchange: "_Exchange") -> None:
        self._accepted += 1
        try:
            async with asyncio.timeout(self._limits.timeout_s):
                await self._app(scope, exchange.receive, exchange.send)
        except TimeoutError:
            if exchange.status is None:
                await exchange.late()(scope, exchange.receive, exchange.send)
        finally:
            self._accepted -= 1


class _Exchange:
    """A request whose bytes are counted, and the status of its response, None before it."""

    def __init__(self, receive: _Receive, send: _Send, limits: Limits) -> None:
        self._receive, self._send, self._limits = receive, send, limits
        self._bytes, self._arrived = 0, False
        self.status: int | None = None

    async def receive(self) -> _Message:
        message = await self._receive()
        self._bytes += len(message.get("body", b""))
        if self._bytes > self._limits.megabytes * 1e6:
            raise HTTPException(413, _too_large(self._limits))
        self._arrived = not message.get("more_body", False)
        return message

    async def send(self, message: _Message) -> None:
        self.status = message.get("status", self.status)
        await self._send(message)

    def late(self) -> Response:
        """The response to a request that takes too long: to arrive, or to be answered."""
        seconds = f"within {self._limits.timeout_s:g} s"
        if self._arrived:
            return _refused(504, f"expected to be done {seconds}, and was not; send smaller pictures")
        return _refused(408, f"expected the whole request {seconds}, found a part of it")


def _refused(status: int, detail: str, headers: Mapping[str, str] | None = None) -> Response:
    return JSONResponse({"detail": detail}, status, headers)


def _too_large(limits: Limits) -> str:
    return f"expected a request of at most {limits.megabytes:g} MB, found a larger one; send smaller pictures"
