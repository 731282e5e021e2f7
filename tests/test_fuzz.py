"""The fuzzer finds planted faults, its start files are valid, and earlier findings stay fixed."""

import asyncio
import csv
import lzma
import os
import shutil
import subprocess
import sys
import threading
import warnings
from contextlib import suppress
from pathlib import Path
from random import Random

import pytest

from fuzz.findings import list_findings
from fuzz.mutations import MOST_BYTES, mutate
from fuzz.repairs import repair_png, repair_shard
from fuzz.requests import ServerError, request_bytes, send
from fuzz.running import fuzz
from fuzz.targets import NAMES, connections, load, page
from stereoweave.errors import StereoweaveError

REPOSITORY = Path(__file__).resolve().parent.parent
CORPUS = REPOSITORY / "tests" / "corpus"
FOUND = [path for name in NAMES for path in list_findings(CORPUS / name)]

# Ray's own code warns on import.
pytestmark = pytest.mark.filterwarnings("ignore:Using extra keyword arguments on `Field`:DeprecationWarning")

# The finding that each word of `broken_target` causes.
PLANTED = {
    "raise": "IndexError in its target",
    "warn": "UserWarning in its target",
    "exhaust": "MemoryError in its target",
    "crash": "SIGSEGV in its target",
    "hang": "hang in its target",
}


@pytest.fixture
def planted(tmp_path) -> Path:
    """Return a corpus with one file for each word."""
    folder = tmp_path / "corpus" / "broken_target"
    folder.mkdir(parents=True)
    for word in [*PLANTED, "refuse"]:
        (folder / f"{word}-file.txt").write_text(f"some text, {word}, more text")
    return folder


def test_errors_warnings_crashes_hangs_and_memory_exhaustion_are_found_and_refusals_are_not(planted):
    outcome = fuzz("broken_target", seed=1, seconds=1.5, corpus=planted, case_s=0.3)
    assert set(outcome.findings) == set(PLANTED.values())
    assert outcome.cases >= 1 + len(PLANTED)
    contents = {key: finding.content for key, finding in outcome.findings.items()}
    assert contents["IndexError in its target"] == b"raise"  # reduced as far as possible
    assert b"crash" in contents["SIGSEGV in its target"]
    assert b"hang" in contents["hang in its target"]


def test_the_command_stores_its_findings_and_fails(tmp_path):
    def run(target: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "fuzz", "--seconds", "0.5", "--seed", "3", "--target", target]
        command += ["--corpus", str(tmp_path / "corpus"), "--out", str(tmp_path / "fuzz.csv")]
        paths = os.pathsep.join([str(REPOSITORY), str(REPOSITORY / "tests" / "helpers")])
        environment = os.environ | {"PYTHONPATH": paths}
        return subprocess.run(command, capture_output=True, text=True, env=environment, check=False)

    done = run("broken_target")
    assert done.returncode == 1, done.stderr
    (path,) = (tmp_path / "corpus" / "broken_target").iterdir()
    assert path.read_bytes() == b"raise"  # a token of the target
    assert f"IndexError in its target: out of range  -> {path}" in done.stdout
    done = run("maps")
    assert done.returncode == 0, done.stdout
    first, second = csv.DictReader((tmp_path / "fuzz.csv").read_text().splitlines())
    assert (first["target"], first["seed"], first["findings"]) == ("broken_target", "3", "1")
    assert (second["target"], second["findings"]) == ("maps", "0")
    assert int(second["cases"]) > 0


@pytest.mark.parametrize("name", NAMES)
def test_every_start_file_is_valid(tmp_path, monkeypatch, without_shape_checks, name):
    monkeypatch.setattr("fuzz.targets.connections.QUIET_S", 0.5)
    target = load(name)
    for file, content in target.starts().items():
        path = tmp_path / file
        path.write_bytes(content)
        target.read(path)
        assert target.repair(content)
        path.unlink()


def test_a_case_depends_only_on_its_seed_and_has_a_limited_length():
    start, others, tokens = b"width = 3\n" * 20, [b"other\n" * 9], [b"token"]
    cases = [mutate(start, others, tokens, Random(number)) for number in range(2000)]
    assert cases == [mutate(start, others, tokens, Random(number)) for number in range(2000)]
    assert len(set(cases)) > 1500
    assert max(map(len, cases)) <= MOST_BYTES
    for trace in (b"token" * 1000, b"other", b"1e999", b"\xff\xff\xff\xff"):
        assert any(trace in case for case in cases), trace


def test_a_repaired_png_and_a_repaired_shard_pass_their_checks(tmp_path, without_shape_checks):
    png = load("pictures").starts()["colour.png"]
    damaged = png.replace(b"IHDR\0\0\0\x90", b"IHDR\0\0\0\x40")  # 64 columns instead of 144
    assert damaged != png
    assert repair_png(png) == png
    assert repair_png(damaged)[:16] == damaged[:16]
    assert repair_png(damaged)[29:33] != damaged[29:33]  # checksum of the header
    shards = load("shards")
    ((name, shard),) = shards.starts().items()
    other = shard.replace(b'"focal_px": 60.0', b'"focal_px": 70.0')
    path = tmp_path / name
    path.write_bytes(other)
    with pytest.raises(StereoweaveError, match="camera.json to be intact"):
        shards.read(path)
    path.write_bytes(repair_shard(other))
    shards.read(path)
    # The reader refuses compressed shards, which may expand to gigabytes. The repair does not unpack them.
    assert repair_shard(lzma.compress(shard)) == repair_shard(b"")


def test_a_request_that_ends_in_500_is_a_finding():
    async def fails(scope, receive, send):
        assert (await receive())["body"] == b"x=1"
        await send({"type": "http.response.start", "status": int(scope["path"][1:]), "headers": []})

    assert send(fails, request_bytes("POST", "/404", data={"x": "1"})) == 404
    with pytest.raises(ServerError):
        send(fails, request_bytes("POST", "/500", data={"x": "1"}))
    assert send(fails, b"no request\r\n\r\n") is None
    assert send(fails, b"") is None


def raise_now() -> None:
    raise IndexError("planted")


def raise_in_callback() -> None:
    asyncio.get_running_loop().call_soon(raise_now)


def hang() -> None:
    threading.Event().wait()


@pytest.mark.parametrize(
    ("fail", "found"),
    [(raise_now, IndexError), (raise_in_callback, IndexError), (hang, TimeoutError)],
)
def test_a_server_that_fails_after_its_response_is_a_finding(monkeypatch, fail, found):
    async def answer_and_fail(scope, receive, send):
        await connections.answer_length(scope, receive, send)
        if scope.get("path") == "/fail":
            fail()

    monkeypatch.setattr(connections, "ANSWERED_S", 0.5)
    assert connections.talk(answer_and_fail, request_bytes("GET", "/") * 2) == [200, 200]
    with pytest.raises(found):
        connections.talk(answer_and_fail, request_bytes("GET", "/fail"))


def test_a_status_of_500_on_a_connection_is_a_finding():
    async def answer_500(scope, receive, send):
        await send({"type": "http.response.start", "status": 500, "headers": []})
        await send({"type": "http.response.body"})

    with pytest.raises(ServerError, match=r"statuses \[500\]"):
        connections.talk(answer_500, request_bytes("GET", "/"))


def test_a_gate_that_lets_a_foreign_file_pass_is_a_finding():
    starts = load("page").starts()
    refused = {name for name, content in starts.items() if page.visit(content) == 403}
    assert refused == {"foreign.http", "stranger.http", "other.http"}
    for name in refused:
        with pytest.raises(page.LeakError):
            page.visit(starts[name], gate=lambda app: app)
    assert {page.visit(content) for name, content in starts.items() if name not in refused} == {200}


@pytest.mark.parametrize("path", FOUND, ids=lambda path: f"{path.parent.name}/{path.name}")
def test_an_earlier_finding_is_now_read_or_refused(tmp_path, without_shape_checks, path):
    """`make fuzz` wrote these files. By now, the reader may also accept them."""
    copy = tmp_path / path.name.partition("-")[2]
    shutil.copy(path, copy)
    target = load(path.parent.name)
    with suppress(StereoweaveError), warnings.catch_warnings(action="error"):
        target.read(copy)
