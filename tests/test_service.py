import asyncio
import io
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families
from service_examples import BOTH, CALIB, EXAMPLES, malformed

import stereoweave as sw
from stereoweave.calibration_files import calibrated
from stereoweave.cli import main
from stereoweave.errors import ProviderError
from stereoweave.io import read_disparity_png, read_image, read_pair, read_pfm, write_image
from stereoweave.matcher import Matcher
from stereoweave.preparing import Request
from stereoweave.service_requests import Answer, Order, TooLargeError, answer_many, check_pixels

WAITING, MEGABYTES = 3, 4

# What Ray Serve is warned of by Pydantic when it is imported.
pytestmark = pytest.mark.filterwarnings("ignore:Using extra keyword arguments on `Field`:DeprecationWarning")


@pytest.fixture(scope="module")
def service(tmp_path_factory) -> Iterator[httpx.Client]:
    """The command, in a process of its own, which has to end by itself, and all that it started with it."""
    limits = ["--waiting", WAITING, "--max-megabytes", MEGABYTES, "--max-megapixels", 1]
    words = ["--port", 0, "--batch", 2, *limits]
    uploads = tmp_path_factory.mktemp("uploads")
    process = subprocess.Popen(
        [sys.executable, "-m", "stereoweave", "serve", *map(str, words)],
        stdout=subprocess.PIPE,
        text=True,
        # Metrics each second, and not each ten. The names of the sockets of Ray may not be long.
        env={
            **os.environ,
            "RAY_metrics_report_interval_ms": "1000",
            "RAY_TMPDIR": "/tmp",
            "TMPDIR": str(uploads),
        },
    )
    try:
        with process.stdout:
            url = re.search(r"http://[\d.:]+", process.stdout.readline())[0]
            # Each request has a connection of its own, as those of many clients.
            with httpx.Client(
                base_url=url, timeout=60, limits=httpx.Limits(max_keepalive_connections=0)
            ) as client:
                yield client
            started = children(process.pid)
            process.send_signal(signal.SIGTERM)
            assert process.wait(30) == 0
            assert not [pid for pid in started if Path(f"/proc/{pid}").exists()]
            assert not list(uploads.glob("stereoweave-*"))
    finally:
        process.kill()
        process.wait()


def children(pid: int) -> list[int]:
    """The processes that a process has started, and those that these have."""
    tasks = Path(f"/proc/{pid}/task").glob("*/children")
    direct = [int(child) for task in tasks for child in task.read_text().split()]
    return direct + [child for each in direct for child in children(each)]


def post(service: httpx.Client, path: str, files: Any = BOTH, **data: Any) -> httpx.Response:
    return service.post(path, files=files, data=data)


def saved(response: httpx.Response, path: Path) -> Path:
    assert response.status_code == 200, response.text
    path.write_bytes(response.content)
    return path


@pytest.fixture(scope="module")
def photos() -> tuple[np.ndarray, np.ndarray]:
    pair = read_pair(EXAMPLES / "left.png", EXAMPLES / "right.png")
    return pair.left, pair.right


@pytest.fixture(scope="module")
def estimate(photos) -> sw.Estimate:
    return sw.estimate(*photos, model="small")


def test_a_pair_gets_the_disparity_that_the_library_finds(service, estimate, tmp_path):
    pfm = saved(post(service, "/disparity", file="pfm"), tmp_path / "disparity.pfm")
    np.testing.assert_allclose(read_pfm(pfm), estimate.disparity_px, atol=1e-3)
    png = saved(post(service, "/disparity"), tmp_path / "disparity.png")
    np.testing.assert_allclose(read_disparity_png(png), estimate.disparity_px, atol=1 / 256)


def test_a_pair_and_its_calibration_get_depth_in_metres(service, estimate, photos, tmp_path):
    camera = calibrated(sw.StereoPair(left=photos[0], right=photos[1]), EXAMPLES / "calib.txt").camera
    response = post(service, "/depth", {**BOTH, "calib": CALIB}, file="npy")
    depth_m = np.load(saved(response, tmp_path / "depth.npy"), allow_pickle=False)
    np.testing.assert_allclose(depth_m, camera.depth_m(estimate.disparity_px), rtol=1e-3)
    report = json.loads(response.headers["X-Stereoweave-Report"])
    assert report["width_px"] == 640
    assert report["camera"]["focal_px"] == 600


def test_a_view_is_the_one_of_the_library(service, photos, tmp_path):
    view = saved(post(service, "/view", position=0.3), tmp_path / "view.png")
    expected = sw.synthesize(*photos, 0.3, model="small").image.astype(int)
    assert np.abs(read_image(view) - expected).mean() < 0.01


def test_one_picture_of_both_views_is_as_good_as_two(service, photos, tmp_path):
    write_image(tmp_path / "both.png", np.hstack(photos))
    picture = {"picture": (tmp_path / "both.png").read_bytes()}
    response = post(service, "/disparity", picture, format="side_by_side", file="tiff")
    whole = post(service, "/disparity", file="tiff")
    assert response.content == whole.content


def test_a_range_that_is_given_is_kept(service, tmp_path):
    pfm = saved(post(service, "/disparity", range="8,16", file="pfm"), tmp_path / "disparity.pfm")
    assert read_pfm(pfm).min() == 8
    assert read_pfm(pfm).max() == 16


def test_no_malformed_request_is_answered_with_a_server_error(service):
    requests = malformed(MEGABYTES)
    assert len(requests) >= 100
    with ThreadPoolExecutor(WAITING - 1) as pool:
        answers = dict(zip(requests, pool.map(lambda send: send(service), requests.values()), strict=True))
    wrong = {name: answer for name, answer in answers.items() if not 400 <= answer[0] < 500}
    assert not wrong
    details = {
        name: json.loads(text)["detail"] for name, (_, text) in answers.items() if text.startswith("{")
    }
    assert len(details) > len(requests) - 5  # to HTTP that is none, the server itself speaks
    for name, detail in details.items():
        assert "\n" not in detail, name
        assert "/tmp" not in detail, name
    assert post(service, "/disparity").status_code == 200


def test_a_service_that_is_full_refuses_and_does_what_it_accepted(service):
    with ThreadPoolExecutor(16) as pool:
        responses = list(pool.map(lambda _: post(service, "/disparity", refined=True), range(16)))
        health = service.get("/health")
    assert health.json()["status"] == "ok"
    done, refused = ([each for each in responses if each.status_code == status] for status in (200, 503))
    assert len(done) >= WAITING
    assert len(done) + len(refused) == 16
    assert {response.headers["Retry-After"] for response in refused} == {"1"}
    assert "come again" in refused[0].json()["detail"]


def test_its_description_names_every_path_and_field(service):
    description = service.get("/openapi.json").json()
    assert description["openapi"].startswith("3.1")
    assert set(description["paths"]) == {"/disparity", "/depth", "/view", "/health", "/metrics"}
    for what, form in {"disparity": "MapForm", "depth": "MapForm", "view": "ViewForm"}.items():
        said = description["paths"][f"/{what}"]["post"]
        schema = said["requestBody"]["content"]["multipart/form-data"]["schema"]
        assert schema == {"$ref": f"#/components/schemas/{form}"}
        responses = said["responses"]
        assert set(responses) == {"200", "400", "408", "413", "415", "422", "503", "504"}
        assert "X-Stereoweave-Report" in responses.pop("200")["headers"]
        for refusal in responses.values():
            assert refusal["content"]["application/json"]["schema"] == {
                "$ref": "#/components/schemas/Refusal"
            }
    fields = description["components"]["schemas"]["ViewForm"]["properties"]
    assert {"left", "right", "picture", "position", "file", "range", "calib"} <= set(fields)


def test_its_metrics_count_requests_by_status(service):
    assert post(service, "/depth").status_code == 422  # no camera
    with pytest.raises(httpx.ReadTimeout):  # the client goes away
        service.post("/view", files=BOTH, timeout=httpx.Timeout(60, read=0.05))
    expected = {("/depth", "422"), ("/view", "499"), ("/disparity", "200"), ("/disparity", "503")}
    deadline_s = time.monotonic() + 30
    while time.monotonic() < deadline_s:
        families = {
            family.name: family for family in text_string_to_metric_families(service.get("/metrics").text)
        }
        counted = families.get("ray_stereoweave_requests")
        seen = {(s.labels["path"], s.labels["status"]) for s in counted.samples} if counted else set()
        if expected <= seen:
            break
        time.sleep(0.2)
    assert expected <= seen
    assert families["ray_stereoweave_request_seconds"].type == "histogram"
    batches = {s.labels.get("le"): s.value for s in families["ray_serve_actual_batch_size"].samples}
    assert batches["+Inf"] > batches["1.0"]  # some were of two


def order(folder: Path, left: bytes = BOTH["left"], **said: Any) -> Order:
    """For disparity.npy of a pair, in a folder that is made."""
    folder.mkdir()
    (folder / "left").write_bytes(left)
    (folder / "right").write_bytes(BOTH["right"])
    return Order(folder=folder, pictures=(folder / "left", folder / "right"), file="disparity.npy", **said)


def test_those_that_are_matched_together_get_what_each_gets_alone(estimate, tmp_path):
    orders = [
        order(tmp_path / "first"),
        order(tmp_path / "damaged", left=b"no picture"),
        order(tmp_path / "second"),
        order(tmp_path / "with a range", range_px=(8, 16)),
        order(tmp_path / "with a range that is none", range_px=(5000, 6000)),
    ]
    first, damaged, second, within, beyond = answer_many(Matcher("small"), orders)
    for answer in (first, second):
        np.testing.assert_allclose(np.load(io.BytesIO(answer.content)), estimate.disparity_px, atol=1e-3)
    assert np.load(io.BytesIO(within.content)).max() == 16
    assert "expected a picture" in str(damaged)
    assert "range_px" in str(beyond)


def test_nothing_is_left_of_a_request_whose_client_goes_away_while_it_is_matched(tmp_path):
    folder = tmp_path / "pictures"

    class MatcherAtThatMoment(Matcher):
        def estimate_many(self, pairs: Sequence[sw.StereoPair], **how: bool) -> list[sw.Estimate]:
            shutil.rmtree(folder)
            return super().estimate_many(pairs, **how)

    answer_many(MatcherAtThatMoment("small"), [order(folder)])
    assert not folder.exists()


def test_a_view_is_measured_again_where_the_head_of_its_file_does_not_say_its_size(photos, tmp_path):
    write_image(tmp_path / "both.png", np.hstack(photos))
    halves = Order(
        folder=tmp_path,
        pictures=(tmp_path / "both.png",),
        file="disparity.npy",
        request=Request(arrangement="side_by_side_half"),
        most_megapixels=0.5,
    )
    assert check_pixels(halves) == 1280 * 480 / 1e6  # as two views of 640x480 px would have
    (refusal,) = answer_many(Matcher("small"), [halves])
    assert isinstance(refusal, TooLargeError)
    assert "expected at most 0.5 megapixels, found 1280x480" in str(refusal)


def ask_guarded(answering: Any, content: AsyncIterator[bytes] | bytes | None = None) -> httpx.Response:
    """The response of a guard that allows a fifth of a second."""
    from stereoweave.service_http import Guard, Limits, make_app

    limits = Limits(timeout_s=0.2)
    transport = httpx.ASGITransport(Guard(make_app(answering, limits, bytes), limits))
    headers = {"Content-Type": "multipart/form-data; boundary=b"} if content else {}

    async def ask() -> httpx.Response:
        async with httpx.AsyncClient(transport=transport, base_url="http://service") as client:
            files = None if content else BOTH
            return await client.post("/disparity", content=content, files=files, headers=headers)

    return asyncio.run(ask())


async def never(order: Order, megapixels: float) -> Answer:
    await asyncio.Event().wait()


def test_a_provider_that_fails_is_no_fault_of_the_request():
    async def fails(order: Order, megapixels: float) -> Answer:
        raise ProviderError(
            "provider cuda: expected to run /srv/net.onnx, found that it failed: out of memory"
        )

    response = ask_guarded(fails)
    assert response.status_code == 503
    assert response.json()["detail"] == (
        "provider cuda: expected to run net.onnx, found that it failed: out of memory"
    )


def test_what_takes_too_long_is_cancelled():
    response = ask_guarded(never)
    assert response.status_code == 504
    assert response.json()["detail"].startswith("expected to be done within 0.2 s")


def test_a_request_that_does_not_arrive_is_not_waited_for():
    async def stalls() -> AsyncIterator[bytes]:
        yield b"--b\r\n"
        await asyncio.Event().wait()

    response = ask_guarded(never, stalls())
    assert response.status_code == 408
    assert "found a part of it" in response.json()["detail"]


def test_a_port_that_is_taken_is_one_line(capsys):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert main(["serve", "--port", str(port)]) == 2
    told = capsys.readouterr().err
    assert told.startswith(f"stereoweave: --host 127.0.0.1 --port {port}: expected an address that is free")
    assert told.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--model", "none.onnx"], "none.onnx: expected an ONNX matcher"),
        (["--timeout-s", "inf"], "--timeout-s: expected a finite number, found inf"),
        (["--provider", "abacus"], "abacus"),
        (["--address", "127.0.0.1:1"], "127.0.0.1:1: expected the head of a Ray cluster"),
        (["--replicas", "999"], "--replicas 999 --threads 1: expected at most"),
    ],
)
def test_what_cannot_be_served_is_said_before_ray_starts(words, expected, capsys):
    assert main(["serve", "--port", "0", *words]) == 2
    told = capsys.readouterr().err
    assert expected in told
    assert told.count("\n") == 1


def test_a_cluster_without_room_is_said_and_not_waited_for(ray_address, capsys):
    assert main(["serve", "--port", "0", "--address", ray_address, "--threads", "3"]) == 2
    told = capsys.readouterr().err
    assert told == (
        "stereoweave: --replicas 1 --threads 3: expected at most 0, for which there is room, found 1; "
        "each takes 3 cores\n"
    )


def test_a_network_that_the_cluster_does_not_have_is_named(ray_address, capsys):
    words = ["--address", ray_address, "--threads", "1", "--model", "none.onnx"]
    assert main(["serve", "--port", "0", *words]) == 2
    told = capsys.readouterr().err
    assert "found none.onnx: expected an ONNX matcher, found no such file; is the model there too?" in told
    assert told.count("\n") == 1
