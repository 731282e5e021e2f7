"""The page as its command serves it, and a client without a browser."""

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any
from uuid import uuid4

import httpx

SERVER = [
    sys.executable,
    "-c",
    "import sys; from stereoweave.cli.root import main; sys.exit(main(sys.argv[1:]))",
    "app",
]


def start(folder: Path, *words: str, **variables: str) -> tuple[subprocess.Popen[str], str]:
    """Start a separate server with its temporary files in `folder`; return it and its address.

    `variables` are of its environment.
    """
    # A shell or nohup that runs the tests in the background ignores both signals, and processes inherit that.
    before = {number: signal.signal(number, signal.SIG_DFL) for number in (signal.SIGINT, signal.SIGHUP)}
    server = subprocess.Popen(
        [*SERVER, "--port", "0", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "TMPDIR": str(folder), "PYTHONUNBUFFERED": "1", **variables},
    )
    for number, handler in before.items():
        signal.signal(number, handler)
    assert server.stdout
    return server, re.search(r"http://\S+", server.stdout.readline())[0]


def stop(server: subprocess.Popen[str], number: signal.Signals = signal.SIGINT) -> str:
    """Stop the server by a signal; return its output."""
    server.send_signal(number)
    try:
        said = "".join(server.communicate(timeout=30))
    finally:
        server.kill()
    assert server.returncode == 128 + (signal.SIGTERM if number == signal.SIGHUP else number)
    return said


def file_data(path: Any, **more: Any) -> dict[str, Any]:
    """Return a reference to a file in the format of Gradio's client."""
    return {"path": path, "meta": {"_type": "gradio.FileData"}, **more}


_VIDEO_FORM = {
    "video-layout": "detected",
    "video-model": "small",
    "video-output": "depth",
    "video-start": 0,
    "video-time": 0,
}


class Visitor:
    """Client of the page that sends form requests or arbitrary ones."""

    def __init__(self, address: str) -> None:
        self.http = httpx.Client(base_url=address, timeout=60)
        self.http.get("/")
        config = self.http.get("/config").json()
        self._fields = {part["id"]: part["props"].get("elem_id") for part in config["components"]}
        self._inputs = {
            self._fields.get(dependency["targets"][0][0]): (dependency["id"], dependency["inputs"])
            for dependency in config["dependencies"]
        }

    def upload(self, *files: Path) -> list[str]:
        """Upload files; return the page's paths for them."""
        answer = self.http.post(
            "/gradio_api/upload", files=[("files", (file.name, file.read_bytes())) for file in files]
        )
        assert answer.status_code == 200, answer.text
        return answer.json()

    def press(self, button: str = "find", **given: Any) -> dict[str, Any]:
        """Return the request body for a button of the form, with some fields filled in."""
        number, inputs = self._inputs[button]
        form = (
            {"model": "small", "rectify": True, "layout": "detected", "position": 0.5} | _VIDEO_FORM | given
        )
        data = [form.get(self._fields[part]) for part in inputs]
        return {"data": data, "fn_index": number, "session_hash": uuid4().hex}

    def answer(self, body: dict[str, Any]) -> tuple[int, str]:
        """Return status and text of the response, or of the job if the page starts one."""
        joined = self.http.post("/gradio_api/queue/join", json=body)
        if joined.status_code != 200:
            return joined.status_code, joined.text
        data = {"session_hash": body["session_hash"]}
        with self.http.stream("GET", "/gradio_api/queue/data", params=data) as stream:
            for line in stream.iter_lines():
                message = json.loads(line.removeprefix("data: ") or "{}")
                if message.get("msg") == "process_completed":
                    return 200, json.dumps(message["output"])
        raise AssertionError("the page ended its answer before its work")

    def __enter__(self) -> "Visitor":
        return self

    def __exit__(self, *_: object) -> None:
        self.http.close()
