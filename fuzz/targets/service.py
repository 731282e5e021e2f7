"""Requests to the service, answered by a real network."""

import asyncio
import tempfile
from functools import cache
from pathlib import Path

from prometheus_client import CollectorRegistry

from fuzz.requests import Application, repair_length, request_bytes, send
from fuzz.targets import Target, calibrations
from fuzz.targets.pictures import encode_picture, eyes
from stereoweave.errors import StereoweaveError
from stereoweave.matching.matcher import Matcher
from stereoweave.service.answers import ServiceAnswer, ServiceJob, answer_many, check_pixels
from stereoweave.service.asgi import Guard, Limits, make_app

# The first view compiles the kernels.
_LIMITS = Limits(megapixels=0.05, megabytes=0.5, timeout_s=600)


def _starts() -> dict[str, bytes]:
    left, right = (encode_picture(eye, "JPEG") for eye in eyes())
    files = {"left": ("left.jpg", left), "right": ("right.jpg", right)}
    calib = calibrations.TARGET.starts()["calib.txt"]
    camera = {"focal_px": "60", "baseline_m": "0.1"}
    return {
        "disparity.http": request_bytes(
            "POST", "/disparity", files=files, data={"range": "0,16", "file": "npy"}
        ),
        "depth.http": request_bytes("POST", "/depth", files=files | {"calib": ("calib.txt", calib)}),
        "known.http": request_bytes(
            "POST", "/depth", files=files, data=camera | {"file": "tiff", "check": "1"}
        ),
        "view.http": request_bytes("POST", "/view", files=files, data={"position": "0.4", "strength": "1.2"}),
        "rectify.http": request_bytes("POST", "/disparity", files=files, data={"rectify": "true"}),
        "health.http": request_bytes("GET", "/health?x=1"),
        "openapi.http": request_bytes("GET", "/openapi.json"),
    }


@cache
def _application() -> Application:
    matcher = Matcher("small", threads=1)

    async def answer_job(job: ServiceJob, left_s: float) -> ServiceAnswer:
        check_pixels(job)
        (answer,) = await asyncio.to_thread(answer_many, matcher, [job])
        if isinstance(answer, Exception):
            raise answer
        return answer

    registry = CollectorRegistry()
    app = make_app(answer_job, _LIMITS, Path(tempfile.gettempdir()), registry)
    return Guard(app, _LIMITS, registry)


def _read(path: Path) -> None:
    status = send(_application(), path.read_bytes())
    if status != 200:
        raise StereoweaveError(f"refused: {status}")


TARGET = Target(
    starts=_starts,
    read=_read,
    tokens=(
        *b'-- ? %00 %ff / .. /disparity /depth /view /metrics " true nan 1e999 \0 \xff \xed\xa0\x80'.split(),
        *b"left right picture calib format range refined position strength file charset=utf-7".split(),
        *(b"\r\n", b"\r\n\r\n", b"GET ", b"PUT ", b"POST ", b'; filename="', b"Content-Encoding: gzip\r\n"),
        *(b"Content-Type: multipart/form-data; boundary=\r\n", b"Content-Disposition: form-data; name="),
        *(b"Transfer-Encoding: chunked\r\n", b"Content-Length: 99999999999999999999\r\n"),
    ),
    repair=repair_length,
)
