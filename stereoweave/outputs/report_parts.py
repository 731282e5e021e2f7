"""Parts of the report's HTML: the page around them, encoded images and maps, and escaped lists.

The template, the style and the scripts are in report_page/. All text is escaped here.
"""

import base64
import html
import string
import zlib
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from stereoweave.outputs.page_parts import hash_source, read_page_part
from stereoweave.outputs.viewer import viewer_script

_read = partial(read_page_part, "report_page")

# What the result's files contain. The report links to those that were written with it.
CONTENTS = {
    "disparity.pfm": "disparity in pixels, float32",
    "disparity.png": "disparity, pixels × 256, 16 bits",
    "disparity_scaled.png": "disparity, 16 bits; its text chunks hold scale and offset",
    "disparity.npy": "disparity in pixels, for NumPy",
    "disparity.tiff": "disparity in pixels, float32",
    "depth.png": "depth in millimetres, 16 bits",
    "depth.pfm": "depth in metres, float32",
    "depth.npy": "depth in metres, for NumPy",
    "depth.tiff": "depth in metres, float32",
    "preview.png": "disparity in colour, full size",
    "confidence.png": "confidence, black is 0, white is 1",
    "occluded.png": "white where only the left camera sees",
    "matched_left.png": "the left picture to which the maps belong",
    "cloud.ply": "point cloud in metres, for CloudCompare or MeshLab",
    "cloud.glb": "point cloud in metres, for Blender",
    "mesh.ply": "mesh in metres, for MeshLab",
    "mesh.glb": "mesh in metres, for Blender and 3-D viewers",
}

_QUALITY = 88
# A confidence is stored as 0 to 100; occluded pixels have 128 added.
_OCCLUDED = 128
_NOT_SEEN = 255
_FINEST_STEP_PX = 1 / 64


def fill_template(fields: Mapping[str, object]) -> str:
    """Return the page: the template with its style, its scripts and the given fields, which are HTML.

    The page may run only these scripts: their checksum is part of the content security policy.
    """
    style, script = (
        _read("page.css"),
        "".join([_read("mesh.js"), viewer_script(), _read("page.js")]),
    )
    return string.Template(_read("page.html")).substitute(
        fields, style=style, script=script, checksum=hash_source(script)
    )


def list_box(kind: str, heading: str, lines: Sequence[str]) -> str:
    """Return a box of class `kind` with the lines as a list; "" if there are none."""
    if not lines:
        return ""
    items = "".join(f"<li>{html.escape(line)}</li>" for line in lines)
    return f'<section class="{kind}"><h2>{html.escape(heading)}</h2><ul>{items}</ul></section>'


def term_list(rows: Sequence[tuple[str, str]], kind: str = "short") -> str:
    """Return rows of class `kind` for a description list: names and values."""
    return "\n".join(
        f'<div class="{kind}"><dt>{html.escape(name)}</dt><dd>{html.escape(value)}</dd></div>'
        for name, value in rows
    )


def download_card(files: Sequence[Path]) -> str:
    """Return links to files in the report's folder, with content and size; nothing if there are none."""
    if not files:
        return ""
    items = "".join(
        f'<li><a href="{name}" download>{name}</a> <span>{CONTENTS[file.name]}</span>'
        f"<span>{_format_size(file.stat().st_size)}</span></li>"
        for file, name in ((file, html.escape(file.name)) for file in files)
    )
    note = "These files are in the folder of this page: send them along if you send it."
    return f"""<section class="card" aria-labelledby="files-heading">
      <h2 id="files-heading">Files</h2>
      <ul class="files">{items}</ul><p class="note">{note}</p>
    </section>"""


def view_tags(positions: Sequence[float], images: Sequence[UInt8[np.ndarray, "h w 3"]]) -> str:
    """Return the tags of the views; the middle one is visible even with scripts disabled."""
    return "\n".join(map(_view_tag, positions, images))


def jpeg_uri(image: UInt8[np.ndarray, "h w 3"]) -> str:
    """Encode an image as a JPEG data URI."""
    encoded, jpeg = cv2.imencode(
        ".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]
    )
    assert encoded
    return "data:image/jpeg;base64," + base64.b64encode(jpeg.tobytes()).decode()


def pack_map(
    disparity_px: Float[np.ndarray, "h w"],
    confidence: Float[np.ndarray, "h w"],
    occluded: Bool[np.ndarray, "h w"],
) -> dict[str, object]:
    """Pack the maps for the read-out under the pointer.

    Disparity is low_px + step_px * level, to 1/64 px or better than 1/60000 of its range. The 16-bit levels
    are stored as differences to their left neighbour, modulo 65536: first all low bytes, then all high bytes.
    They are followed by one byte per pixel: the confidence in percent, plus 128 where the pixel is occluded;
    255 where the confidence is NaN. All bytes are compressed by zlib and encoded in base64.
    """
    low_px, high_px = float(disparity_px.min()), float(disparity_px.max())
    step_px = max(_FINEST_STEP_PX, (high_px - low_px) / 65535)
    levels = np.round((disparity_px - low_px) / step_px).astype("<u2")
    steps = np.diff(levels, axis=1, prepend=np.zeros_like(levels[:, :1]))
    unknown = np.isnan(confidence)
    percent = (
        np.round(100 * np.where(unknown, 0, confidence)).astype(np.uint8) + np.uint8(_OCCLUDED) * occluded
    )
    percent[unknown] = _NOT_SEEN
    planes = np.stack([(steps & 255).astype(np.uint8), (steps >> 8).astype(np.uint8), percent])
    packed = zlib.compress(planes.tobytes())
    height, width = disparity_px.shape
    return {
        "width": width,
        "height": height,
        "low_px": low_px,
        "step_px": step_px,
        "packed": base64.b64encode(packed).decode(),
    }


def _view_tag(position: float, image: UInt8[np.ndarray, "h w 3"]) -> str:
    shown = ' class="shown"' if position == 0.5 else ""
    return f'<img{shown} decoding="sync" src="{jpeg_uri(image)}" alt="View at position {position}">'


def _format_size(count: int) -> str:
    return f"{count / 1e6:.1f} MB" if count >= 1e5 else f"{count / 1e3:.0f} kB"
