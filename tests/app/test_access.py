"""A visitor of the page can read their own uploads and results and the sample, and no other file."""

import json
import os
import signal
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest
from other_processes import UNMEASURED
from page_examples import Visitor, file_data, start, stop
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse
from starlette.routing import Route
from starlette.testclient import TestClient

from stereoweave.app.access import OwnFiles
from stereoweave.io.images import read_image, write_image

pytestmark = pytest.mark.system

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
REFUSED = (403, "access is limited to your uploads and the files made from them; upload the pictures again")


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("page")


@pytest.fixture(scope="module")
def address(folder) -> Iterator[str]:
    server, address = start(folder)
    yield address
    assert stop(server) == ""
    assert list(folder.glob("stereoweave-page-*")) == []


@pytest.fixture
def visitor(address) -> Iterator[Visitor]:
    with Visitor(address) as visitor:
        yield visitor


@pytest.fixture(scope="module")
def small_pair(tmp_path_factory) -> list[Path]:
    """Write a pair that is small enough to be matched quickly. Returns its files."""
    files = [tmp_path_factory.mktemp("pair") / f"{side}.png" for side in ("left", "right")]
    for file in files:
        write_image(file, read_image(EXAMPLES / file.name)[200:264, 200:328])
    return files


@pytest.fixture(scope="module")
def resident(address, small_pair) -> Iterator[tuple[Visitor, list[str], str]]:
    """Yield another visitor, their uploads, and the page's answer to these."""
    with Visitor(address) as visitor:
        left, right = uploads = visitor.upload(*small_pair)
        status, said = visitor.answer(visitor.press(left=file_data(left), right=file_data(right)))
        assert status == 200
        yield visitor, uploads, said


def paths_in(said: str) -> list[str]:
    """Return the paths of all files that an answer of the page names."""
    found: list[str] = []
    json.loads(said, object_hook=lambda part: found.append(part.get("path")) or part)
    return [path for path in found if path]


def spellings(file: Path, uploaded: str, listener: socket.socket) -> list[str]:
    """Return different names for a file on the server's disk; some start from the visitor's own upload."""
    relative, url = os.path.relpath(file), f"http://127.0.0.1:{listener.getsockname()[1]}/left.png"
    link = file.with_name(f"link-to-{file.name}")
    link.symlink_to(file)
    return [
        str(file),
        str(link),
        relative,
        f"./{relative}",
        f"/{file}",
        f"{file.parent}/./{file.name}",
        f"{uploaded}/{os.path.relpath(file, uploaded)}",
        f"{Path(uploaded).parent}/{os.path.relpath(file, Path(uploaded).parent)}",
        quote(str(file), safe=""),
        f"file://{file}",
        f"/gradio_api/file={file}",
        f"{file}\0",
        f"{uploaded}\0{file}",
        url,
        url.replace("http", "https"),
    ]


def forged_bodies(visitor: Visitor, path: str, uploaded: str) -> Iterator[dict[str, Any]]:
    """Yield submissions of the form that name a file of somebody else."""
    for field in ("left", "right", "calibration"):
        yield visitor.press(**{"left": file_data(uploaded), field: file_data(path)})
    yield visitor.press(left=[file_data(path)])
    yield visitor.press(left=file_data(path, is_stream=True, url=path))
    yield visitor.press(left=file_data(uploaded), position={"value": file_data(path)})
    yield visitor.press(left=file_data(uploaded)) | {"event_data": file_data(path)}


def other_ways(path: str) -> Iterator[tuple[str, str]]:
    """Yield addresses under which Gradio has served files, or fetched them from other servers."""
    encoded = quote(path, safe="").replace(".", "%2E")
    for route in ("file=", "file/", "proxy=", "stream/", "custom_component/0/client/component/"):
        yield "GET", f"/gradio_api/{route}{encoded}"
    for route in ("static", "assets", "svelte"):
        yield "GET", f"/{route}/{encoded}"
    for route in ("run/_found", "api/_found", "call/_found", "call/v2/_found", "component_server"):
        yield "POST", f"/gradio_api/{route}"


def refusals(visitor: Visitor, path: str, uploaded: str) -> Iterator[tuple[int, str]]:
    """Yield the answers to all forged requests for a file under one of its names."""
    for body in forged_bodies(visitor, path, uploaded):
        yield visitor.answer(body)
    for method, url in other_ways(path):
        body = visitor.press(left=file_data(path)) if method == "POST" else None
        answer = visitor.http.request(method, url, json=body)
        yield answer.status_code, answer.text


def test_no_forged_request_reads_a_file_or_reveals_whether_it_exists(visitor, folder, small_pair, tmp_path):
    [uploaded] = visitor.upload(small_pair[0])
    before, count = sorted(folder.rglob("*")), 0
    there, missing = tmp_path / "there.png", tmp_path / "missing.png"
    there.write_bytes((EXAMPLES / "left.png").read_bytes())
    with socket.create_server(("127.0.0.1", 0)) as listener:
        for file in (there, missing):
            for path in spellings(file, uploaded, listener):
                for refusal in refusals(visitor, path, uploaded):
                    assert refusal == REFUSED, path
                    count += 1
        listener.setblocking(False)
        with pytest.raises(BlockingIOError):
            listener.accept()
    assert count == 2 * 15 * 20
    assert sorted(folder.rglob("*")) == before


def test_a_visitor_s_upload_is_matched_and_its_results_are_theirs(resident):
    visitor, uploads, said = resident
    assert r"128\u00d764 px, matched in" in said
    shown = paths_in(said)
    assert len(shown) == 4  # view, depth, confidence, photograph
    for path in (*shown, *uploads):
        answer = visitor.http.get(f"/gradio_api/file={quote(path)}")
        assert answer.status_code == 200
        assert len(answer.content) == Path(path).stat().st_size


def test_another_visitors_uploads_and_results_are_refused_though_their_paths_are_known(resident, visitor):
    _, uploads, said = resident
    for path in (*uploads, *paths_in(said)):
        assert visitor.answer(visitor.press(left=file_data(path))) == REFUSED
        answer = visitor.http.get(f"/gradio_api/file={quote(path)}")
        assert (answer.status_code, answer.text) == REFUSED


def test_a_visitor_without_a_cookie_has_no_files(resident, visitor):
    visitor.http.cookies.clear()
    [path] = visitor.upload(EXAMPLES / "right.png")
    for named in (path, resident[1][0]):
        assert visitor.answer(visitor.press(left=file_data(named))) == REFUSED


def test_the_sample_is_served_only_to_visitors_who_requested_it(visitor, resident, small_pair):
    status, said = visitor.answer(visitor.press("sample"))
    assert status == 200
    left, *_ = paths_in(said)
    [right] = visitor.upload(small_pair[1])
    body = visitor.press(left=file_data(left), right=file_data(right))
    assert "expected left and right pictures of the same size" in visitor.answer(body)[1]
    assert resident[0].answer(body) == REFUSED


def test_an_upload_with_blanks_and_accents_in_its_name_is_its_visitor_s(visitor, tmp_path):
    file = tmp_path / "été à gauche #1 100%.txt"
    file.write_text("no picture")
    [path] = visitor.upload(file)
    assert visitor.http.get(f"/gradio_api/file={quote(path)}").text == "no picture"
    status, said = visitor.answer(visitor.press(left=file_data(path), right=file_data(path)))
    assert status == 200
    assert ": expected a picture" in said


@pytest.mark.parametrize("content", ["[" * 100_000, "{", '"', " " * 2_000_000, "\xff", '{"path": 1}'])
def test_an_invalid_request_body_is_refused(visitor, content):
    answer = visitor.http.post("/gradio_api/queue/join", content=content.encode("latin-1"))
    assert (answer.status_code, answer.text) == REFUSED


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_uploads_are_removed_when_a_signal_ends_the_page(tmp_path, small_pair, number):
    server, address = start(tmp_path, **UNMEASURED)
    with Visitor(address) as visitor:
        [path] = visitor.upload(small_pair[0])
    assert Path(path).is_relative_to(tmp_path)
    stop(server, number)
    assert list(tmp_path.glob("stereoweave-page-*")) == []


async def name_again(request: Request) -> JSONResponse:
    return JSONResponse(await request.json())


async def show_file(request: Request) -> PlainTextResponse:
    assert request.cookies == {}  # as Gradio reads them
    return PlainTextResponse("content")


@pytest.fixture
def page() -> Iterator[TestClient]:
    """Return a client of a minimal page behind the access control; an upload names files to its visitor."""
    routes = [
        Route("/gradio_api/upload", name_again, methods=["POST"]),
        Route("/gradio_api/file={path:path}", show_file),
    ]
    with TestClient(OwnFiles(Starlette(routes=routes))) as page:
        yield page


def cookie_of(number: int) -> str:
    return f"stereoweave-visitor={number:043}"


def name_files(page: TestClient, cookie: str, *paths: str) -> None:
    answer = page.post("/gradio_api/upload", json=list(paths), headers={"cookie": cookie})
    assert answer.json() == list(paths)


def status_of(page: TestClient, cookie: str, path: str) -> int:
    return page.get(f"/gradio_api/file={path}", headers={"cookie": cookie}).status_code


@pytest.mark.parametrize(
    "others", ["theme=dark mode", "novalue", "path/x=1", 'x={"a":1}', "é=1"], ids=lambda text: ascii(text)
)
def test_a_visitor_keeps_their_files_beside_the_cookies_of_other_servers_on_the_host(page, others):
    name_files(page, cookie_of(1), "/own.png")
    for header in (f"{others}; {cookie_of(1)}", f"{cookie_of(1)}; {others}"):
        answer = page.get("/gradio_api/file=/own.png", headers={"cookie": header.encode("utf-8")})
        assert (answer.status_code, answer.text) == (200, "content")


@pytest.mark.parametrize("method", ["POST", "PUT", "PATCH", "DELETE", "OPTIONS", "BREW"])
def test_a_body_is_checked_for_every_method(page, method):
    answer = page.request(method, "/gradio_api/queue/join", json={"path": "/foreign.png"})
    assert (answer.status_code, answer.text) == REFUSED


@pytest.mark.usefixtures("untraced")
def test_a_long_cookie_of_another_server_does_not_delay_the_page(page):
    other = (
        'other="' + r"\a" * 30_000 + '"'
    )  # in some versions of Python, the time to parse it is quadratic in its length
    name_files(page, cookie_of(1), "/own.png")
    start_s = time.process_time()
    assert status_of(page, f"{other}; {cookie_of(1)}", "/own.png") == 200
    assert time.process_time() - start_s < 1


def test_many_files_of_one_visitor_do_not_displace_another_s(page):
    name_files(page, cookie_of(1), "/own.png")
    name_files(page, cookie_of(2), *(f"/{number}.png" for number in range(100_001)))
    assert status_of(page, cookie_of(1), "/own.png") == 200
    # The last 10,000 stay.
    assert status_of(page, cookie_of(2), "/90000.png") == 403
    assert status_of(page, cookie_of(2), "/90001.png") == 200


def test_of_more_than_1000_visitors_the_least_recently_active_is_forgotten(page):
    for number in range(1000):
        name_files(page, cookie_of(number), "/own.png")
    assert status_of(page, cookie_of(0), "/own.png") == 200  # now visitor 1 is the least recently active
    name_files(page, cookie_of(1000), "/own.png")
    kept = [status_of(page, cookie_of(number), "/own.png") for number in (0, 1, 2, 1000)]
    assert kept == [200, 403, 200, 200]
