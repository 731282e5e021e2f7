import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import httpx
import numpy as np
import psutil
import pytest
import watching
from hostile_calibrations import HOSTILE
from hostile_requests import make_hostile_requests
from other_processes import MEASURED_ALONE, UNMEASURED, list_listeners, list_processes
from prometheus_client import Metric
from prometheus_client.parser import text_string_to_metric_families
from ray.exceptions import RayActorError
from service_examples import BOTH, CALIB, TEXTURED, Sender, make_malformed_requests

import stereoweave as sw
from stereoweave.cameras.calibration_files import add_camera
from stereoweave.cli.root import main
from stereoweave.errors import StereoweaveError
from stereoweave.io.images import read_image, read_pair, write_image
from stereoweave.io.maps import read_disparity_png, read_pfm

WAITING, MEGABYTES = 3, 4

# Pydantic warns about Ray Serve when that is imported.
pytestmark = [
    pytest.mark.system,
    pytest.mark.filterwarnings("ignore:Using extra keyword arguments on `Field`:DeprecationWarning"),
]


class Running(NamedTuple):
    client: httpx.Client
    pid: int
    uploads: Path


@pytest.fixture(scope="module")
def service(running) -> httpx.Client:
    return running.client


@pytest.fixture(scope="module")
def running(tmp_path_factory) -> Iterator[Running]:
    limits = ["--waiting", WAITING, "--max-megabytes", MEGABYTES, "--max-megapixels", 1, "--timeout-s", 20]
    words = ["--address", "local", "--batch", 2, *limits]
    # local must not join the cluster in RAY_ADDRESS; there is none at this one.
    with run_serve_command(tmp_path_factory.mktemp("uploads"), *words, RAY_ADDRESS="127.0.0.1:9") as running:
        yield running


@contextmanager
def run_serve_command(uploads: Path, *words: object, **environment: str) -> Iterator[Running]:
    """Run the command in another process, and check that it ends by itself and leaves no child process."""
    # Ray reports metrics every ten seconds by default. The paths of its sockets must be short.
    ray = {"RAY_metrics_report_interval_ms": "1000", "RAY_TMPDIR": "/tmp"}
    process = subprocess.Popen(
        [sys.executable, *MEASURED_ALONE, "serve", "--port", "0", *map(str, words)],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, **ray, **environment, "TMPDIR": str(uploads)},
    )
    try:
        with process.stdout:
            url = re.search(r"http://[\d.:]+", process.stdout.readline())[0]
            started = set(list_processes(process.pid))
            # Each request has its own connection, like requests of different clients.
            alone = httpx.Limits(max_keepalive_connections=0)
            with httpx.Client(base_url=url, timeout=60, limits=alone) as client:
                yield Running(client, process.pid, uploads)
            started |= set(list_processes(process.pid))
            process.send_signal(signal.SIGTERM)
            assert process.wait(30) == 0
            assert not wait_for_end(started, within_s=10)
            assert not list(uploads.glob("stereoweave-*"))
    finally:
        process.kill()
        process.wait()


def wait_for_end(pids: set[int], within_s: float) -> list[int]:
    """Wait for processes to end, and return those that have not ended in time."""
    deadline_s = time.monotonic() + within_s
    while (left := [pid for pid in pids if Path(f"/proc/{pid}").exists()]) and time.monotonic() < deadline_s:
        time.sleep(0.05)
    return left


def post(service: httpx.Client, path: str, files: Any = BOTH, **data: Any) -> httpx.Response:
    return service.post(path, files=files, data=data)


def save_content(response: httpx.Response, path: Path) -> Path:
    assert response.status_code == 200, response.text
    path.write_bytes(response.content)
    return path


@pytest.fixture(scope="module")
def photos() -> tuple[np.ndarray, np.ndarray]:
    pair = read_pair(TEXTURED / "left.png", TEXTURED / "right.png")
    return pair.left, pair.right


@pytest.fixture(scope="module")
def estimate(photos) -> sw.Estimate:
    return sw.estimate(*photos, model="small")


def test_the_service_gives_the_same_disparity_as_the_library(service, estimate, tmp_path):
    pfm = save_content(post(service, "/disparity", file="pfm"), tmp_path / "disparity.pfm")
    np.testing.assert_allclose(read_pfm(pfm), estimate.disparity_px, atol=1e-3)
    png = save_content(post(service, "/disparity"), tmp_path / "disparity.png")
    np.testing.assert_allclose(read_disparity_png(png), estimate.disparity_px, atol=1 / 256)


def test_a_pair_with_a_calibration_gives_depth_in_metres(service, estimate, photos, tmp_path):
    camera = add_camera(sw.StereoPair(left=photos[0], right=photos[1]), TEXTURED / "calib.txt").camera
    response = post(service, "/depth", {**BOTH, "calib": CALIB}, file="npy")
    depth_m = np.load(save_content(response, tmp_path / "depth.npy"), allow_pickle=False)
    np.testing.assert_allclose(depth_m, camera.depth_m(estimate.disparity_px), rtol=1e-3)
    report = json.loads(response.headers["X-Stereoweave-Report"])
    assert report["width_px"] == 640
    assert report["camera"]["focal_px"] == 600


def test_the_service_renders_the_same_view_as_the_library(service, photos, tmp_path):
    view = save_content(post(service, "/view", position=0.3), tmp_path / "view.png")
    expected = sw.synthesize(*photos, 0.3, model="small").image.astype(int)
    assert np.abs(read_image(view) - expected).mean() < 0.01


def test_one_picture_of_both_views_gives_the_same_result_as_two_pictures(service, photos, tmp_path):
    write_image(tmp_path / "both.png", np.hstack(photos))
    picture = {"picture": (tmp_path / "both.png").read_bytes()}
    response = post(service, "/disparity", picture, format="side_by_side", file="tiff")
    whole = post(service, "/disparity", file="tiff")
    assert response.content == whole.content


def test_a_given_range_limits_the_disparity(service, tmp_path):
    pfm = save_content(post(service, "/disparity", range="8,16", file="pfm"), tmp_path / "disparity.pfm")
    assert read_pfm(pfm).min() == 8
    assert read_pfm(pfm).max() == 16


def test_no_malformed_request_is_answered_with_a_server_error(service):
    requests = make_malformed_requests(MEGABYTES)
    assert len(requests) >= 100
    with ThreadPoolExecutor(WAITING - 1) as pool:
        answers = dict(zip(requests, pool.map(lambda send: send(service), requests.values()), strict=True))
    wrong = {name: answer for name, answer in answers.items() if not 400 <= answer[0] < 500}
    assert not wrong
    details = {
        name: json.loads(text)["detail"] for name, (_, text) in answers.items() if text.startswith("{")
    }
    assert len(details) > len(requests) - 5  # the server itself answers invalid HTTP
    for name, detail in details.items():
        assert "\n" not in detail, name
        assert "/tmp" not in detail, name
    assert post(service, "/disparity").status_code == 200


def test_a_full_service_refuses_requests_and_answers_the_accepted_ones(service):
    with ThreadPoolExecutor(16) as pool:
        responses = list(pool.map(lambda _: post(service, "/disparity", refined=True), range(16)))
        health = service.get("/health")
    assert health.json()["status"] == "ok"
    done, refused = ([each for each in responses if each.status_code == status] for status in (200, 503))
    others = [each.text for each in responses if each.status_code not in (200, 503)]
    assert not others
    full = [each for each in refused if f"fewer than {WAITING} pending requests" in each.text]
    late = [each for each in refused if "would make this request" in each.text]  # on a busy machine
    assert len(full) + len(late) == len(refused)
    assert full
    assert done
    assert len(done) + len(late) >= WAITING
    assert {response.headers["Retry-After"] for response in full} == {"1"}
    assert all("try again later" in response.json()["detail"] for response in refused)


def test_no_process_of_the_service_has_a_lower_priority_than_the_command(running):
    priorities = set()
    for pid in list_processes(running.pid):
        with suppress(psutil.NoSuchProcess):
            process = psutil.Process(pid)
            priorities.add((process.name(), process.nice()))
    assert len(priorities) > 3
    assert {nice for _, nice in priorities} == {psutil.Process().nice()}, priorities


def test_hostile_requests_and_calibrations_neither_delay_health_checks_nor_fill_memory(running):
    calibrations = dict(list(HOSTILE.items())[:: max(1, len(HOSTILE) // 60)])
    requests = {name: partial(post_calibration, content) for name, content in calibrations.items()}
    requests |= make_hostile_requests() | make_malformed_requests(MEGABYTES)
    assert len(calibrations) >= 60
    assert len(requests) >= 260
    watcher = [sys.executable, watching.__file__, str(running.client.base_url), str(running.pid)]
    with (
        subprocess.Popen(
            watcher,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | UNMEASURED,
        ) as watch,
        ThreadPoolExecutor(12) as pool,
    ):
        sent = {
            name: pool.submit(send_until_accepted, send, running.client) for name, send in requests.items()
        }
        statuses = {name: status.result() for name, status in sent.items()}
        seen = json.loads(watch.communicate()[0])
    assert not {name: status for name, status in statuses.items() if status >= 500}
    assert not {name for name in calibrations if statuses[name] == 200}
    assert len(seen["health_s"]) > 20
    # A single check may wait for the processor of a busy machine.
    assert np.quantile(seen["health_s"], 0.99) < 1
    assert max(seen["health_s"]) < 5
    assert max(seen["megabytes"]) < 2000
    assert post(running.client, "/disparity").status_code == 200


def post_calibration(content: bytes, client: httpx.Client) -> tuple[int, str]:
    try:
        response = post(client, "/depth", {**BOTH, "calib": content})
    except (httpx.ReadError, httpx.WriteError):  # refused and closed while the request was still being sent
        return 503, ""
    return response.status_code, response.text


def send_until_accepted(send: Sender, client: httpx.Client) -> int:
    """Send a request until it is accepted, and return its status; 503 if this takes over five minutes.

    Each slow request of the others takes the whole time limit of the service, one after another.
    """
    deadline_s = time.monotonic() + 300
    while (status := send(client)[0]) == 503 and time.monotonic() < deadline_s:
        time.sleep(0.5)
    return status


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("localhost", 200),
        ("LOCALHOST:1", 200),
        ("127.0.0.1:99", 200),
        ("evil.example", 400),
        ("127.0.0.1.evil", 400),
    ],
)
def test_only_requests_to_a_name_of_this_machine_are_answered(service, host, status):
    for path in ("/health", "/openapi.json"):
        assert service.get(path, headers={"Host": host}).status_code == status


def test_removed_temporary_folders_are_made_again_and_a_failure_to_make_one_is_reported(running):
    for folder in running.uploads.glob("stereoweave-service-*/"):
        shutil.rmtree(folder)
    assert post(running.client, "/disparity").status_code == 200
    with without_a_folder(running):
        refused = post(running.client, "/disparity")
    assert refused.status_code == 503
    assert refused.json()["detail"].startswith("the service could not store or process the request (")
    assert post(running.client, "/disparity").status_code == 200


@contextmanager
def without_a_folder(running: Running) -> Iterator[None]:
    """Let the service lack a temporary folder during the block, so that it refuses each pair."""
    [measuring] = running.uploads.glob("stereoweave-service-*/measuring")
    measuring.rmdir()
    measuring.touch()
    try:
        yield
    finally:
        measuring.unlink()


def test_the_openapi_description_names_every_path_and_field(service):
    description = service.get("/openapi.json").json()
    assert description["openapi"].startswith("3.1")
    assert set(description["paths"]) == {"/disparity", "/depth", "/view", "/health", "/metrics"}
    for what, form in {"disparity": "MapForm", "depth": "MapForm", "view": "ViewForm"}.items():
        said = description["paths"][f"/{what}"]["post"]
        schema = said["requestBody"]["content"]["multipart/form-data"]["schema"]
        assert schema == {"$ref": f"#/components/schemas/{form}"}
        responses = said["responses"]
        assert set(responses) == {"200", "400", "401", "408", "413", "415", "422", "503", "504"}
        assert "X-Stereoweave-Report" in responses.pop("200")["headers"]
        for refusal in responses.values():
            assert refusal["content"]["application/json"]["schema"] == {
                "$ref": "#/components/schemas/Refusal"
            }
    fields = description["components"]["schemas"]["ViewForm"]["properties"]
    assert {"left", "right", "picture", "position", "file", "range", "calib"} <= set(fields)


def parse_metrics(text: str) -> dict[str, Metric]:
    return {family.name: family for family in text_string_to_metric_families(text)}


def test_the_metrics_count_requests_by_status(running):
    service = running.client
    assert post(service, "/disparity").status_code == 200
    with without_a_folder(running):
        assert post(service, "/disparity").status_code == 503
    assert post(service, "/depth").status_code == 422  # no camera
    with pytest.raises(httpx.ReadTimeout):  # the client disconnects
        service.post("/view", files=BOTH, timeout=httpx.Timeout(60, read=0.05))
    expected = {("/depth", "422"), ("/view", "499"), ("/disparity", "200"), ("/disparity", "503")}
    deadline_s = time.monotonic() + 30
    while time.monotonic() < deadline_s:
        families = parse_metrics(service.get("/metrics").text)
        seen = {(s.labels["path"], s.labels["status"]) for s in families["stereoweave_requests"].samples}
        if expected <= seen:
            break
        time.sleep(0.2)
    assert expected <= seen
    assert families["stereoweave_request_seconds"].type == "histogram"


def test_rays_own_exporter_has_the_metrics_of_the_replicas(running):
    deadline_s = time.monotonic() + 30
    while not (several := count_batches_of_two(running.pid)) and time.monotonic() < deadline_s:
        with ThreadPoolExecutor(2) as pool:
            list(pool.map(lambda _: post(running.client, "/disparity"), range(2)))
    assert several


def count_batches_of_two(pid: int) -> float:
    """Return how many batches held two pairs, by Ray's exporter; 0 if it does not know of any batch yet."""
    sizes = read_ray_metrics(pid).get("ray_serve_actual_batch_size")
    if sizes is None:
        return 0
    batches = {sample.labels.get("le"): sample.value for sample in sizes.samples}
    return batches["+Inf"] - batches["1.0"]


def read_ray_metrics(pid: int) -> dict[str, Metric]:
    """Return the metrics of Ray's exporter, which listens on one of the ports that the service opens."""
    for _, port in list_listeners(pid):
        with suppress(httpx.HTTPError):
            text = httpx.get(f"http://127.0.0.1:{port}/metrics", timeout=2).text
            if "ray_serve_actual_batch_size" in text:
                return parse_metrics(text)
    return {}


def test_a_port_in_use_is_reported_in_one_line(capsys):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert main(["serve", "--port", str(port)]) == 2
    printed = capsys.readouterr().err
    assert printed == (
        f"stereoweave: --host 127.0.0.1 --port {port}: expected a free address, found none "
        "(address already in use); --port 0 takes any free port\n"
    )


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--model", "none.onnx"], "none.onnx: expected an ONNX matcher file"),
        (["--timeout-s", "inf"], "--timeout-s: expected a finite number, found inf"),
        (["--provider", "abacus"], "abacus"),
        (["--address", "127.0.0.1:1"], "127.0.0.1:1: expected the head of a Ray cluster"),
        (["--replicas", "999"], "--replicas: expected at most"),
        (
            ["--host", "0.0.0.0", "--address", "127.0.0.1:1"],
            "put a proxy in front of the service (deploy/nginx.conf)",
        ),
        (["--host", "0.0.0.0", "--behind-proxy", "--replicas", "999"], "--replicas: expected at most"),
        (["--token-file", os.devnull], "expected a token of letters, digits and -._~+/=, found nothing"),
        (["--token-file", str(TEXTURED / "left.png")], "left.png: expected a file with a token, found"),
        (
            ["--token-file", str(TEXTURED / "calib.txt")],
            "found other characters; make one with",
        ),
    ],
)
def test_invalid_settings_are_reported_before_ray_starts(words, expected, capsys):
    assert main(["serve", "--port", "0", *words]) == 2
    printed = capsys.readouterr().err
    assert expected in printed
    assert printed.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "found"),
    [
        (["--threads", "3"], "at most 0, because each takes 3 cores, found 1"),
        (["--threads", "1", "--replicas", "9"], "at most 2, because each takes 1 core, found 9"),
    ],
    ids=["large", "many"],
)
def test_a_cluster_without_room_is_reported_at_once(ray_address, capsys, words, found):
    assert main(["serve", "--port", "0", "--address", ray_address, *words]) == 2
    printed = capsys.readouterr().err
    assert printed == (
        f"stereoweave: --replicas: expected {found}; use lower values (--replicas, --threads)\n"
    )


def test_a_network_missing_on_the_cluster_is_named(ray_address, capsys):
    words = ["--address", ray_address, "--threads", "1", "--model", "none.onnx"]
    assert main(["serve", "--port", "0", *words]) == 2
    printed = capsys.readouterr().err
    assert (
        "a replica could not load the network: none.onnx: expected an ONNX matcher file, found no such file; "
        "is the model available on every machine of the service?" in printed
    )
    assert printed.count("\n") == 1


def test_a_replicas_error_names_its_setting_as_an_option(ray_address, capsys):
    words = ["--address", ray_address, "--threads", "1", "--provider", "abacus"]
    assert main(["serve", "--port", "0", *words]) == 2
    assert capsys.readouterr().err.startswith(
        "stereoweave: --provider: a replica could not load the network: expected one"
    )


def test_the_command_passes_hosts_and_token_to_the_service(tmp_path, monkeypatch):
    kept = []

    def run_service(settings: Any, listener: socket.socket, address: str | None) -> None:
        kept.append(settings.limits)
        raise StereoweaveError("not now")

    monkeypatch.setattr("stereoweave.service.deployment.run_service", run_service)
    (tmp_path / "token").write_text(" se-cret\n")
    hosts = {
        (): ("127.0.0.1", "localhost"),
        ("--host", "::1"): ("[::1]", "localhost"),
        ("--host", "127.1"): ("127.0.0.1", "localhost", "127.1"),
        ("--host", "0.0.0.0", "--behind-proxy"): None,
        ("--behind-proxy",): None,
    }
    for words in hosts:
        assert main(["serve", "--port", "0", "--token-file", str(tmp_path / "token"), *words]) == 2
    assert [limits.hosts for limits in kept] == list(hosts.values())
    assert {limits.token.get_secret_value() for limits in kept} == {"se-cret"}
    assert "se-cret" not in repr(kept)


def test_on_a_cluster_rays_proxies_answer_the_same_requests(ray_address, tmp_path):
    with run_serve_command(tmp_path, "--address", ray_address, "--threads", 1) as running:
        assert post(running.client, "/disparity").status_code == 200
        assert running.client.get("/health", headers={"Host": "evil.example"}).status_code == 400
        assert running.client.get("/health").status_code == 200


def test_proxies_that_do_not_start_are_reported_in_one_line_and_end_ray_serve(monkeypatch):
    from stereoweave.service import deployment  # its import warns

    ended = []
    monkeypatch.setattr(deployment.serve, "start", raise_actor_died)
    monkeypatch.setattr(deployment.serve, "status", lambda: SimpleNamespace(applications={}))
    monkeypatch.setattr(deployment.serve, "shutdown", lambda: ended.append(True))
    listener = socket.create_server(("127.0.0.1", 0))
    with (
        pytest.raises(StereoweaveError) as caught,
        deployment._serve_at_proxies(deployment.Settings(), listener),
    ):
        pass
    assert str(caught.value) == (
        "Ray Serve: expected HTTP proxies that are ready within 60 s, found: The actor died; "
        "is a machine of the cluster overloaded?"
    )
    assert ended == [True]


def raise_actor_died(**_: object) -> None:
    raise RayActorError(error_msg="The actor died.\nIt never ran.")


def test_accepted_requests_are_answered_before_the_service_ends(running):
    """Keep this test the last one, because it ends the service."""
    with ThreadPoolExecutor(1) as pool:
        answer = pool.submit(post, running.client, "/view")
        while not answer.done() and not list(running.uploads.glob("stereoweave-service-*/tmp*")):
            time.sleep(0.01)
        os.kill(running.pid, signal.SIGTERM)
        assert answer.result().status_code == 200
