"""Access control for the page: visitors can reach only the routes they need and their own files."""

import json
import re
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from secrets import token_urlsafe
from typing import Any

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import ClientDisconnect, Request
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

# A browser may load nothing from other servers, whatever the page requests.
_POLICY = "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:"
_REFUSED = "access is limited to your uploads and the files made from them; upload the pictures again"
_COOKIE = "stereoweave-visitor"
_VISITOR = re.compile(r"[\w-]{43}", re.ASCII)
API = "/gradio_api"
_FILE = f"{API}/file="
# Gradio's other routes stay closed: unqueued calls, a proxy, recordings, streams and component functions.
_ROUTES = re.compile(
    r"/|/(config|theme\.css|favicon\.ico|manifest\.json|robots\.txt)|/(static|assets|svelte)(/[\w-][\w.-]*)+"
    rf"|{API}/(info|app_id|startup-events|upload|upload_progress|queue/join|queue/data|reset|cancel)/?"
    rf"|{API}/heartbeat/\w+|{_FILE}.+",
    re.DOTALL,
)
# Routes whose responses contain paths of files for the visitor.
_NAMING = (f"{API}/upload", f"{API}/queue/data")
_MOST_BODY_BYTES = 1_000_000
# A path takes about 200 bytes; a visitor who studies a pair for an hour receives hundreds of paths.
_MOST_NAMED = 10_000
_MOST_VISITORS = 1_000


class ContentPolicy:
    """Middleware whose content security policy lets browsers load files only from this server."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        await self._app(scope, receive, _add_header(send, "content-security-policy", _POLICY))


class OwnFiles:
    """Middleware that gives each visitor access only to files whose paths the page has sent to that visitor.

    These are the visitor's uploads, the results and the sample. A requested path is compared as text with the
    paths in earlier responses to the same cookie, so other paths are never looked up on disk. Gradio checks
    paths only in servers that it starts itself, and does not distinguish visitors.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app
        self._named = _Named()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        visitor = find_visitor(scope)
        try:
            receive = await self._checked(scope, receive, visitor)
        except PermissionError:
            await PlainTextResponse(_REFUSED, 403)(scope, receive, send)
            return
        if scope["path"] == "/" and not visitor:
            cookie = f"{_COOKIE}={token_urlsafe(32)}; HttpOnly; SameSite=Lax; Path=/"
            send = _add_header(send, "set-cookie", cookie)
        elif scope["path"] in _NAMING and visitor:
            send = self._watch_response(send, visitor)
        await self._app(_remove_cookies(scope), receive, send)

    async def _checked(self, scope: Scope, receive: Receive, visitor: str) -> Receive:
        """Check a request, and return the channel from which to read it.

        Raises:
            PermissionError: If the route is closed, the request is invalid, or one of its files belongs to
                another visitor.
        """
        path, method = scope["path"], scope.get("method")
        if scope["type"] != "http" or not _ROUTES.fullmatch(path):
            raise PermissionError
        if path.startswith(_FILE):
            self._check([path.removeprefix(_FILE)], visitor)
        elif method not in ("GET", "HEAD") and path != f"{API}/upload":
            value, text = await _read_json(Request(scope, receive))
            self._check(list(_find_paths(value)), visitor)
            return _replay(text, receive)
        return receive

    def _check(self, paths: Sequence[Any], visitor: str) -> None:
        if not all(isinstance(path, str) and self._named.knows(visitor, path) for path in paths):
            raise PermissionError

    def _watch_response(self, send: Send, visitor: str) -> Send:
        """Return a `send` that also remembers the paths of the files in a response.

        The response is either a list of uploads or a stream with one event per line.
        """
        kept = b""

        async def send_and_remember(message: Message) -> None:
            nonlocal kept
            if message["type"] == "http.response.body":
                *whole, kept = (kept + message.get("body", b"")).split(b"\n")
                if not message.get("more_body"):
                    whole.append(kept)
                for line in whole:
                    self._remember_line(line.removeprefix(b"data: "), visitor)
            await send(message)

        return send_and_remember

    def _remember_line(self, line: bytes, visitor: str) -> None:
        try:
            value = json.loads(line)
        except ValueError:
            return
        uploads = value if isinstance(value, list) else []
        for path in (*uploads, *_find_paths(value)):
            self._named.add(visitor, path)


class _Named:
    """Paths sent to each visitor, with a limit per visitor so that no visitor displaces another's paths."""

    def __init__(self) -> None:
        self._visitors: OrderedDict[str, OrderedDict[str, None]] = OrderedDict()

    def add(self, visitor: str, path: str) -> None:
        paths = self._visitors.setdefault(visitor, OrderedDict())
        paths[path] = None
        _use(paths, path, _MOST_NAMED)
        _use(self._visitors, visitor, _MOST_VISITORS)

    def knows(self, visitor: str, path: str) -> bool:
        if visitor not in self._visitors:
            return False
        _use(self._visitors, visitor, _MOST_VISITORS)
        return path in self._visitors[visitor]


def _use(entries: OrderedDict[str, Any], key: str, most: int) -> None:
    """Move an entry to the end; if there are more than `most` entries, remove the first one."""
    entries.move_to_end(key)
    if len(entries) > most:
        entries.popitem(last=False)


def find_visitor(scope: Scope) -> str:
    """Return the visitor's cookie, or an empty string if there is none."""
    # Parsed by hand, because some versions of Python take quadratic time to unquote a cookie.
    for header in Headers(scope=scope).getlist("cookie"):
        for cookie in header.split(";"):
            name, _, value = (part.strip() for part in cookie.partition("="))
            if name == _COOKIE and _VISITOR.fullmatch(value):
                return value
    return ""


def _remove_cookies(scope: Scope) -> Scope:
    """Return the request without cookies, because Gradio would unquote even cookies set by other servers."""
    return {**scope, "headers": [(name, value) for name, value in scope["headers"] if name != b"cookie"]}


def _add_header(send: Send, name: str, value: str) -> Send:
    async def send_with_header(message: Message) -> None:
        if message["type"] == "http.response.start":
            MutableHeaders(scope=message).append(name, value)
        await send(message)

    return send_with_header


async def _read_json(request: Request) -> tuple[Any, bytes]:
    """Return the value of a request's JSON body, and a new body that encodes this value.

    Gradio reads the new body, and thus exactly the value that was checked.

    Raises:
        PermissionError: If the body is not JSON, or is too large.
    """
    body = b""
    try:
        async for part in request.stream():
            body += part
            if len(body) > _MOST_BODY_BYTES:
                raise PermissionError
        value = json.loads(body or b"null")
        return value, json.dumps(value).encode()
    except (ValueError, RecursionError, ClientDisconnect) as error:
        raise PermissionError from error


def _find_paths(value: Any) -> Iterator[Any]:
    """Yield the value of each `path` key in a nested value.

    Gradio treats any mapping with this key as a file.
    """
    waiting = [value]
    while waiting:
        match waiting.pop():
            case dict(part):
                if "path" in part:
                    yield part["path"]
                waiting += part.values()
            case list(parts):
                waiting += parts


def _replay(body: bytes, receive: Receive) -> Receive:
    """Return a channel that delivers a body that was already read, then any further messages."""
    messages = [{"type": "http.request", "body": body, "more_body": False}]

    async def receive_again() -> Message:
        return messages.pop() if messages else await receive()

    return receive_again
