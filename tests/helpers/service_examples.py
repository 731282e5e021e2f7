"""Requests that are each malformed in a different way."""

import functools
import io
import socket
import struct
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import httpx
from PIL import Image

TEXTURED = Path(__file__).resolve().parents[1] / "textured_pair"
LEFT, RIGHT, CALIB = ((TEXTURED / name).read_bytes() for name in ("left.png", "right.png", "calib.txt"))
BOTH = {"left": LEFT, "right": RIGHT}

# A function that sends a request to the service and returns status and text of the response.
Sender = Callable[[httpx.Client], tuple[int, str]]


@functools.cache
def make_malformed_requests(most_megabytes: float) -> dict[str, Sender]:
    """Return requests, keyed by what is wrong with each."""
    files = {**_cut_pictures_off(), **_make_other_files(), **_make_wrong_sizes()}
    pictures = {
        f"left is {what}": partial(_post, "/disparity", {"left": content, "right": RIGHT})
        for what, content in files.items()
    }
    return {
        **pictures,
        **_make_wrong_options(),
        **_make_wrong_fields(),
        **_make_wrong_calibrations(),
        **_make_wrong_http(most_megabytes),
    }


def _post(path: str, files: Any, client: httpx.Client, **options: Any) -> tuple[int, str]:
    response = client.post(path, files=files, **options)
    return response.status_code, response.text


def _cut_pictures_off() -> dict[str, bytes]:
    """Return truncated and modified pictures."""
    found = {}
    with Image.open(io.BytesIO(LEFT)) as picture:
        for kind in ("PNG", "JPEG", "TIFF", "WEBP", "BMP", "PPM", "GIF", "JPEG2000"):
            content = _encode(picture.convert("RGB"), kind)
            for percent in (1, 60):
                found[f"{kind} cut off at {percent} %"] = content[: len(content) * percent // 100]
            found[f"{kind} cut off after 9 bytes"] = content[:9]
    for place in (20, 29, 5000):
        found[f"PNG with byte {place} changed"] = (
            LEFT[:place] + bytes([LEFT[place] ^ 255]) + LEFT[place + 1 :]
        )
    return found


def _encode(picture: Image.Image, kind: str) -> bytes:
    out = io.BytesIO()
    picture.save(out, kind)
    return out.getvalue()


def _make_other_files() -> dict[str, bytes]:
    frames = [Image.new("L", (64, 64), grey) for grey in (0, 99, 200)]
    out = io.BytesIO()
    frames[0].save(out, "GIF", save_all=True, append_images=frames[1:])
    heads = {
        "HEIC": b"\0\0\0\x18ftypheic\0\0\0\0mif1heic",
        "MP4": b"\0\0\0\x18ftypisom\0\0\0\0isomiso2",
        "SVG": b'<svg xmlns="http://www.w3.org/2000/svg" width="64" height="64"></svg>',
        "HTML": b"<!doctype html><title>x</title>",
        "JSON": b'{"left": [1, 2, 3]}',
        "PDF": b"%PDF-1.7\n%\xe2\xe3\xcf\xd3\n",
        "PostScript": b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 64 64\n(%pipe%id) (w) file\n",
        "a zip file": b"PK\x03\x04" + bytes(60),
        "a gzip file": b"\x1f\x8b\x08" + bytes(60),
        "an icon": b"\0\0\1\0\1\0\x40\x40" + bytes(60),
        "an array of NumPy": b"\x93NUMPY\x01\x00v\x00{'descr': '|O', 'shape': (1,), }",
        "a pickle": b"cos\nsystem\n(S'true'\ntR.",
        "a PFM file": b"Pf\n64 64\n-1.0\n" + bytes(4 * 64 * 64),
        "a program": b"\x7fELF\x02\x01\x01" + bytes(60),
        "nothing": b"",
        "one byte": b"\0",
        "zeros": bytes(10_000),
        "text": "Größe: 64 × 64 → 3 m\n".encode(),
    }
    return heads | {"a GIF that moves": out.getvalue()}


def _make_wrong_sizes() -> dict[str, bytes]:
    """Return pictures that are too large, too small, unlike the right one, or have false headers."""
    sizes = {(100_000, 100_000), (2**31 - 1, 2**31 - 1), (0, 0), (0, 64), (20_000, 3_000), (4_000_000_000, 1)}
    heads = {f"PNG that says it has {w}x{h} px": _make_png_head(w, h) for w, h in sorted(sizes)}
    small = {
        f"PNG of {w}x{h} px": _encode(Image.new("L", (w, h)), "PNG")
        for w, h in [(1, 1), (31, 480), (640, 31), (64, 64), (641, 480), (480, 640)]
    }
    return {
        **heads,
        **small,
        "a bomb of 900 megapixels": _encode(Image.new("1", (30_000, 30_000)), "PNG"),
        "more pixels than are taken": _encode(Image.new("L", (1200, 900)), "PNG"),
        "a bomb in a text chunk": _insert_chunk(
            b"zTXt", b"Comment\0\0" + zlib.compress(bytes(200_000_000), 9)
        ),
        "PPM that says it is huge": b"P6 999999999 999999999 255\n" + bytes(1000),
        "PPM of a negative size": b"P6 -640 480 255\n" + bytes(1000),
        "BMP of a negative size": b"BM"
        + struct.pack("<IIIIiiHHIIiiII", 99, 0, 54, 40, -640, -480, 1, 24, *[0] * 6),
        "GIF that says it is huge": b"GIF89a" + struct.pack("<HHBBB", 65535, 65535, 0, 0, 0) + b"\x3b",
        "TIFF whose directory is outside": b"II*\0" + struct.pack("<I", 2**31),
        "TIFF whose directory is itself": b"II*\0" + struct.pack("<IHHHIII", 8, 1, 256, 4, 2**31, 640, 8),
    }


def _make_png_head(width: int, height: int) -> bytes:
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + _make_chunk(b"IHDR", head) + _make_chunk(b"IDAT", zlib.compress(bytes(100)))


def _make_chunk(name: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))


def _insert_chunk(name: bytes, content: bytes) -> bytes:
    return LEFT[:33] + _make_chunk(name, content) + LEFT[33:]


def _make_wrong_options() -> dict[str, Sender]:
    """Return requests with invalid field values."""
    numbers = ("nan", "inf", "-1", "0", "1e400", "x", "1,5")
    of_maps = {
        "range": (
            "nan,3",
            "inf,3",
            "3",
            "1,2,3",
            "5,3",
            "5,5",
            "a,b",
            "1e3,2e3",
            "9000,9001",
            "0," + "9" * 500,
        ),
        "refined": ("maybe", "2"),
        "file": ("exe", "../../etc/passwd", "png\0"),
        "focal_px": numbers,
        "baseline_m": ("nan", "-1", "1e400"),
        "format": ("sideways", "side_by_side"),
        "rectify": ("perhaps",),
        "check": ("[]",),
        "colour": ("red",),
        "left.filename": ("x",),
    }
    of_views = {
        "position": ("nan", "inf", "3", "-1.1", "x"),
        "strength": ("-1", "nan", "inf", "1e308", "9"),
        "file": ("tiff",),
        "refined": ("true",),
    }
    return {
        f"{path} with {field} {value[:20]!r}": partial(_post, path, BOTH, data=_add_camera(field, value))
        for path, fields in {"/depth": of_maps, "/view": of_views}.items()
        for field, values in fields.items()
        for value in values
    }


def _add_camera(field: str, value: str) -> dict[str, str]:
    """Return the field, with others that make the rest of the request valid."""
    camera = {"focal_px": "600", "baseline_m": "0.1"}
    position = {"position": "0.9"} if field == "strength" else {}
    return {**camera, **position, field: value}


def _make_wrong_fields() -> dict[str, Sender]:
    """Return requests with missing, surplus and misnamed files."""
    files = {
        "no file": {"other": b"x"},
        "no right picture": {"left": LEFT},
        "no left picture": {"right": RIGHT},
        "three pictures": {**BOTH, "picture": LEFT},
        "a picture beside the left one": {"left": LEFT, "picture": LEFT},
        "other names": {"Left": LEFT, "Right": RIGHT},
        "a field too many": {**BOTH, "depth": LEFT},
        "names of paths": {"../left": LEFT, "right": RIGHT},
        "one view as picture of both": {"picture": _encode(Image.new("L", (33, 33)), "PNG")},
        "file names that are paths": {
            "left": ("../../../etc/passwd", b"x"),
            "right": ("\x01ü\u202e.png", RIGHT),
        },
    }
    sent = {f"files: {what}": partial(_post, "/disparity", each) for what, each in files.items()}
    as_text = {"left": "left.png", "right": "right.png"}
    return {
        **sent,
        "pictures as text": partial(_post, "/disparity", {"picture": LEFT}, data=as_text),
        "depth without a camera": partial(_post, "/depth", BOTH),
        "a focal length alone": partial(_post, "/depth", BOTH, data={"focal_px": "600"}),
        "a baseline alone": partial(_post, "/depth", BOTH, data={"baseline_m": "0.1"}),
        "two calibrations": partial(_post, "/depth", {**BOTH, "calib": CALIB}, data={"focal_px": "600"}),
    }


def _make_wrong_calibrations() -> dict[str, Sender]:
    laughs = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
        f"{b}: &{b} [{','.join([f'*{a}'] * 9)}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
    )
    contents = {
        "nothing": b"",
        "zeros": bytes(1000),
        "a picture": LEFT,
        "text": b"hello",
        "YAML that grows": laughs.encode(),
        "YAML that runs": b"!!python/object/apply:os.system ['true']",
        "of a negative focal length": CALIB.replace(b"600", b"-600"),
        "of NaN": CALIB.replace(b"600", b"nan"),
        "of an infinite size": CALIB.replace(b"640", b"inf"),
        "of other pictures": CALIB.replace(b"640", b"1280"),
        "too long": CALIB + b"\n# " + bytes(300_000),
        "deeply nested": b"[" * 5_000,
        "deeply nested JSON": b'{"a":' * 5_000,
    }
    return {
        f"calibration is {what}": partial(_post, "/depth", {**BOTH, "calib": content})
        for what, content in contents.items()
    }


def _make_wrong_http(most_megabytes: float) -> dict[str, Sender]:
    """Return requests with invalid headers or with a body in the wrong order."""
    form = "multipart/form-data; boundary=b"
    part = b'--b\r\nContent-Disposition: form-data; name="left"; filename="l"\r\n\r\n'
    bodies = {
        "JSON": ("application/json", b"{}"),
        "broken JSON": ("application/json", b"{"),
        "a plain form": ("application/x-www-form-urlencoded", b"left=1"),
        "a picture alone": ("image/png", LEFT),
        "no kind": ("", LEFT),
        "no boundary": ("multipart/form-data", part),
        "an empty boundary": ("multipart/form-data; boundary=", part),
        "another boundary": ("multipart/form-data; boundary=c", part),
        "a form without a body": (form, b""),
        "a form that is cut off": (form, part + LEFT[:1000]),
        "a part without a name": (form, b"--b\r\nContent-Disposition: form-data\r\n\r\nx\r\n--b--\r\n"),
        "a part without a head": (form, b"--b\r\n\r\nx\r\n--b--\r\n"),
        "a part with a broken head": (form, b"--b\r\n\0\xff: \xfe\r\n\r\nx\r\n--b--\r\n"),
        "thousands of parts": (
            form,
            b'--b\r\nContent-Disposition: form-data; name="x"\r\n\r\n\r\n' * 2000 + b"--b--",
        ),
        "a kind that is not ASCII": (f"{form}; charset=ü".encode(), part),
        "too much": (form, bytes(int(most_megabytes * 1e6) + 1)),
    }
    sent = {
        f"body: {what}": partial(
            _send, "POST", "/disparity", headers={"Content-Type": kind} if kind else {}, content=body
        )
        for what, (kind, body) in bodies.items()
    }
    chunks = partial(_send, "POST", "/view", headers={"Content-Type": form})
    return {
        **sent,
        "too much, in chunks": lambda client: chunks(client, content=iter([part, *[bytes(100_000)] * 100])),
        "another method": partial(_send, "PUT", "/disparity"),
        "no post": partial(_send, "GET", "/view"),
        "another path": partial(_send, "POST", "/%2e%2e/etc/passwd", headers={"Content-Type": form}),
        "a head that is none": partial(_send_bytes, b"HELLO\r\n\r\n"),
        "a length that is none": partial(
            _send_bytes, b"POST /view HTTP/1.1\r\nHost: x\r\nContent-Length: -5\r\n\r\n"
        ),
        "two lengths": partial(
            _send_bytes,
            b"POST /view HTTP/1.1\r\nHost: x\r\nContent-Length: 5\r\nContent-Length: 6\r\n\r\nhello",
        ),
    }


def _send(method: str, path: str, client: httpx.Client, **options: Any) -> tuple[int, str]:
    response = client.request(method, path, **options)
    return response.status_code, response.text


def _send_bytes(request: bytes, client: httpx.Client) -> tuple[int, str]:
    """Send bytes; return the response."""
    with socket.create_connection((client.base_url.host, client.base_url.port), timeout=60) as connection:
        connection.sendall(request)
        answer = connection.makefile("rb").readline().split()
    return int(answer[1]), ""
