"""LIF files written byte by byte, as Leia's tablets and programs write them."""

import io
import json

import numpy as np
from PIL import Image


def jpeg(image: np.ndarray, **options: object) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, "JPEG", quality=97, subsampling=0, **options)
    return stream.getvalue()


def field(kind: int, content: bytes) -> bytes:
    return kind.to_bytes(4) + len(content).to_bytes(4) + content


def ending(fields: list[bytes]) -> bytes:
    """Return the table of these fields, its length and the mark."""
    table = len(fields).to_bytes(4) + b"".join(fields)
    return table + (len(table) + 6).to_bytes(4) + b"\x1e\x1a"


def tablet_photo(left: np.ndarray, right: np.ndarray) -> bytes:
    """Return a photograph in version 4: six fields, of which two are depth maps."""
    said = {
        "convergence": -0.0112278685,
        "disparitySource": "NEURAL_STEREO",
        "gain": 1.0,
        "views": [
            {"albedoId": -1, "disparityId": 1000001, "xLocation": 0.0, "yLocation": 0.0},
            {"albedoId": 1000002, "disparityId": 1000003, "xLocation": 1.0, "yLocation": 0.0},
        ],
    }
    depth = jpeg(np.zeros((8, 8), np.uint8))
    fields = [
        field(0, (4).to_bytes(4)),
        field(4, (1).to_bytes(4)),
        field(1000001, depth),
        field(1000002, jpeg(right)),
        field(1000003, depth),
        field(7, json.dumps(said).encode()),
    ]
    return jpeg(left) + ending(fields)


def new_photo(left: np.ndarray, *others: np.ndarray, said: dict[str, object] | None = None) -> bytes:
    """Return a photograph in version 5.3; `said` is its description instead of the usual one."""
    said = said or describe([-1, *range(1000001, 1000001 + len(others))])
    fields = [field(1000001 + index, jpeg(other)) for index, other in enumerate(others)]
    return jpeg(left) + ending([*fields, field(8, json.dumps(said).encode())])


def describe(pictures: list[int], *, places: list[float] | None = None, **more: object) -> dict[str, object]:
    """Return the description of views with these pictures, side by side, of a camera of 90 degrees."""
    places = places or [float(index) for index in range(len(pictures))]
    views = [
        {
            "width_px": 480,
            "height_px": 320,
            "focal_px": 240.0,
            "frustum_skew": {"x": 0.0, "y": 0.0},
            "position": {"x": x, "y": 0.0, "z": 0.0},
            "rotation": {"rotation_slant": {"x": 0.0, "y": 0.0}, "roll_degrees": 0.0},
            "image": {"blob_id": picture},
        }
        for picture, x in zip(pictures, places, strict=True)
    ]
    return {"encoder": "5.3.0", "baseline_mm": 45, "views": views, **more}
