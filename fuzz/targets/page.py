"""Requests to the page's access control, in front of an application that accepts everything."""

import json
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.responses import JSONResponse
from starlette.routing import Mount, Route, Router
from starlette.types import ASGIApp, Receive, Scope, Send

from fuzz.requests import repair_length, request_bytes, send
from fuzz.targets import Target
from stereoweave.app.access import ContentPolicy, OwnFiles
from stereoweave.errors import StereoweaveError

_OWN, _FOREIGN = "/page/a/own.png", "/page/b/foreign.png"
_VISITOR, _OTHER = ({"Cookie": f"stereoweave-visitor={letter * 43}"} for letter in "ab")
_UPLOAD, _JOIN, _FILE = "/gradio_api/upload", "/gradio_api/queue/join", "/gradio_api/file="


class LeakError(Exception):
    """Error raised if a visitor can reach a file that the page has not named to them."""


class _Page:
    """Stand-in for Gradio that names files in its responses and records the files named in requests.

    Attributes:
        named: Files to name in responses.
        asked: Files named in requests so far.
    """

    def __init__(self) -> None:
        self.named: list[str] = []
        self.asked: list[Any] = []
        file = Route(f"{_FILE}{{path:path}}", self._show)
        self._routes = Router([Mount("/", Router([file, Mount("/", self._read)]))])

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        await self._routes(scope, receive, send)

    async def _show(self, request: Request) -> JSONResponse:
        self.asked.append(request.path_params["path"])
        return JSONResponse(self.named)

    async def _read(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["method"] not in ("GET", "HEAD") and scope["path"] != _UPLOAD:
            body = await Request(scope, receive).body()
            with suppress(ValueError, RecursionError):  # Gradio would refuse such a body
                json.loads(body, object_pairs_hook=self._keep)
        await JSONResponse(self.named)(scope, receive, send)

    def _keep(self, entries: list[tuple[str, Any]]) -> dict[str, Any]:
        """Record all paths in a JSON object, including those under repeated keys."""
        self.asked += [value for key, value in entries if key == "path"]
        return dict(entries)


def visit(content: bytes, gate: Callable[[ASGIApp], ASGIApp] = OwnFiles) -> int | None:
    """Give one file to each of two visitors, send a request, and return the status of its response.

    Raises:
        LeakError: The gate let a request pass that names a file not given to its sender.
        Exception: Any error raised by the gate.
    """
    page = _Page()
    server = ContentPolicy(gate(page))
    for cookie, path in ((_VISITOR, _OWN), (_OTHER, _FOREIGN)):
        page.named = [path]
        send(server, request_bytes("POST", _UPLOAD, headers=cookie))
    page.named = []
    status = send(server, content)
    given = [_OWN] if _VISITOR["Cookie"].encode() in content else []
    for path in page.asked:
        if path not in given:
            raise LeakError(f"a request for {path!r} reached the page, which answered with status {status}")
    return status


def _starts() -> dict[str, bytes]:
    file, foreign = ({"path": path, "meta": {"_type": "gradio.FileData"}} for path in (_OWN, _FOREIGN))
    escaped = json.dumps(file).replace("path", r"\u0070ath").replace("own", r"\u006fwn").encode()
    nested = {"data": [{"value": [[file], {"left": file, "path": _OWN}]}], "event_data": None, "fn_index": 0}
    twice = f'{{"path": "{_FOREIGN}", "path": "{_OWN}", "data": [NaN, 1e999, -0.0]}}'.encode()
    bodies = {
        "nested": json.dumps(nested).encode(),
        "twice": twice,
        "escaped": escaped,
        "utf-16": escaped.decode().encode("utf-16"),
        "foreign": json.dumps({"data": [file, foreign]}).encode(),
    }
    upload = {"files": ("own.png", b"\x89PNG")}
    return {
        **{
            f"{name}.http": request_bytes("POST", _JOIN, content=body, headers=_VISITOR)
            for name, body in bodies.items()
        },
        "stranger.http": request_bytes("POST", _JOIN, json=file),
        "cancel.http": request_bytes("POST", "/gradio_api/cancel", json={"session_hash": "x"}),
        "upload.http": request_bytes("POST", f"{_UPLOAD}?upload_id=x", files=upload, headers=_VISITOR),
        "events.http": request_bytes("GET", "/gradio_api/queue/data?session_hash=x", headers=_VISITOR),
        "file.http": request_bytes("GET", f"{_FILE}{_OWN}", headers=_VISITOR),
        "coded.http": request_bytes("HEAD", f"{_FILE}%2Fpage/a%2fown%2Epng?x=1", headers=_VISITOR),
        "cookies.http": request_bytes(
            "GET", f"{_FILE}{_OWN}", headers={"Cookie": rf'b="\a\054"; {_VISITOR["Cookie"]}'}
        ),
        "other.http": request_bytes("GET", f"{_FILE}{_FOREIGN}", headers=_VISITOR),
        "page.http": request_bytes("GET", "/"),
        "static.http": request_bytes("GET", "/static/fonts/a.woff2"),
    }


def _read(path: Path) -> None:
    if visit(path.read_bytes()) is None:
        raise StereoweaveError("expected an HTTP request")


TARGET = Target(
    starts=_starts,
    read=_read,
    tokens=(
        *b"/ // /.. /./ % %25 %2F %2f %2E %00 %0A %ff ? # ; \0 \xff \xed\xa0\x80 \xef\xbb\xbf".split(),
        *b"NaN 1e999 \\a \\054".split(),
        *b"path \\u0070 \\ud800 [ { } ] , : null /gradio_api /gradio_api/file= file= /queue/join".split(),
        *(b"\n", b"\r\n", b'"', b'"path": ', b'{"path": ', b'{"a": {"path": ', b"Cookie: "),
        *(
            _FOREIGN.encode(),
            _OWN.encode(),
            f'"path": "{_FOREIGN}", '.encode(),
            "path".encode("utf-16-le"),
            "path".encode("utf-32-le"),
        ),
        *(f"Cookie: {cookie['Cookie']}\r\n".encode() for cookie in (_VISITOR, {"Cookie": "a=1; b"})),
        *(b"GET ", b"HEAD ", b"POST ", b"PUT ", b"PATCH ", b"DELETE ", b"OPTIONS "),
        *(
            b"Content-Encoding: gzip\r\n",
            b"Transfer-Encoding: chunked\r\n",
            b"X-HTTP-Method-Override: GET\r\n",
        ),
        *(b"Content-Type: application/json; charset=utf-7\r\n", b"X-Forwarded-Prefix: /gradio_api\r\n"),
    ),
    repair=repair_length,
)
