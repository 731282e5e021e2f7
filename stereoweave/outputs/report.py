"""Self-contained HTML report on a result: images, a summary, and new views with a slider."""

import base64
import html
import importlib.resources
import json
import string
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from stereoweave.io.colormap import (
    OCCLUDED_RGB,
    colour_confidence,
    colour_disparity,
    css_colour,
    find_colour_range_px,
    legend_colours,
)
from stereoweave.io.maps import find_scale, format_scale
from stereoweave.io.text import writing_text
from stereoweave.rendering.renderer import Renderer
from stereoweave.stereo import Estimate, StereoCamera, StereoPair

POSITIONS = tuple(step / 8 for step in range(-2, 11))

_LONGER_SIDE_PX = 1000
_LONGER_SIDE_OF_MAP_PX = 400
_JPEG_QUALITY = 88


@dataclass(frozen=True, kw_only=True)
class Summary:
    """Summary of a result; a depth is None if it is infinite or the camera is unknown.

    Attributes:
        disparity_p1_px, disparity_p99_px: 1st and 99th percentile of the disparities.
        depth_p1_m, depth_p99_m: Depths of the 99th and the 1st percentile of the disparities.
        disparity_scale_px, disparity_offset_px: Scale and offset of disparity_scaled.png; None if the range
            fits disparity.png.
        occluded_percent: Share of pixels that only the left camera sees.
        confident_percent: Share of pixels with a confidence of at least 0.5.
    """

    pictures: tuple[str, ...]
    model: str
    width_px: int
    height_px: int
    estimate_ms: float
    disparity_min_px: float
    disparity_p1_px: float
    disparity_median_px: float
    disparity_p99_px: float
    disparity_max_px: float
    disparity_scale_px: float | None
    disparity_offset_px: float | None
    depth_min_m: float | None
    depth_p1_m: float | None
    depth_median_m: float | None
    depth_p99_m: float | None
    depth_max_m: float | None
    occluded_percent: float
    confident_percent: float
    camera: StereoCamera | None


def summarize(
    pair: StereoPair, estimate: Estimate, *, pictures: tuple[str, ...], model: str, estimate_ms: float
) -> Summary:
    """Summarise an estimate over the pixels that the left image covers (`StereoPair.left_seen`).

    Args:
        pair: The pair.
        estimate: The pair's estimate.
        pictures: File names of the pictures.
        model: Name of the matcher.
        estimate_ms: Duration of matching.
    """
    height_px, width_px = estimate.disparity_px.shape
    seen = slice(None) if pair.left_seen is None else pair.left_seen
    low_px, p1_px, median_px, p99_px, high_px = np.percentile(
        estimate.disparity_px[seen], [0, 1, 50, 99, 100]
    )
    scale_px, offset_px = find_scale(float(low_px), float(high_px)) or (None, None)
    return Summary(
        pictures=pictures,
        model=model,
        width_px=width_px,
        height_px=height_px,
        estimate_ms=round(estimate_ms, 1),
        disparity_min_px=_round(low_px),
        disparity_p1_px=_round(p1_px),
        disparity_median_px=_round(median_px),
        disparity_p99_px=_round(p99_px),
        disparity_max_px=_round(high_px),
        disparity_scale_px=scale_px,
        disparity_offset_px=offset_px,
        depth_min_m=_depth_m(pair.camera, high_px),
        depth_p1_m=_depth_m(pair.camera, p99_px),
        depth_median_m=_depth_m(pair.camera, median_px),
        depth_p99_m=_depth_m(pair.camera, p1_px),
        depth_max_m=_depth_m(pair.camera, low_px),
        occluded_percent=_round(100 * estimate.occluded[seen].mean()),
        confident_percent=_round(100 * (estimate.confidence[seen] >= 0.5).mean()),
        camera=pair.camera,
    )


def write_report(
    path: Path, pair: StereoPair, estimate: Estimate, summary: Summary, threads: int | None = None
) -> None:
    """Write the report as a single HTML file without external resources.

    The report shows the left image, the depth (or the disparity if the camera is unknown), the confidence,
    the summary, and the views from POSITIONS with a slider to move the viewpoint. Images have at most 1000 px
    on the longer side. `threads` is the number of threads for rendering.
    """
    source = importlib.resources.files("stereoweave.outputs") / "report.html"
    template = source.read_text(encoding="utf-8")
    page = string.Template(template).substitute(_collect_fields(pair, estimate, summary, threads))
    with writing_text(path) as file:
        file.write(page)


def _collect_fields(
    pair: StereoPair, estimate: Estimate, summary: Summary, threads: int | None
) -> dict[str, object]:
    """Return the values of the template's fields by name."""
    small, small_estimate = downscale(pair, estimate, _LONGER_SIDE_PX)
    renderer = Renderer(small, small_estimate, threads=threads)
    views = [renderer.view(position) for position in POSITIONS]
    seen = slice(None) if pair.left_seen is None else pair.left_seen
    range_px = find_colour_range_px(np.atleast_2d(estimate.disparity_px[seen]))
    height, width = small.left.shape[:2]
    depth = colour_disparity(_resize_nearest(estimate.disparity_px, (width, height)), range_px)
    if small.left_seen is not None:
        depth[~small.left_seen] = 0
    data = {
        "width_px": summary.width_px,
        "height_px": summary.height_px,
        "camera": asdict(pair.camera) if pair.camera else None,
        "invented_percent": [round(100 * float((~view.drawn).mean()), 2) for view in views],
        "map": _encode_disparity(estimate),
    }
    title = " + ".join(summary.pictures)
    size = f"{summary.width_px} × {summary.height_px} px"
    return {
        "title": html.escape(title),
        "subtitle": html.escape(f"{size}, matched by {summary.model} in {summary.estimate_ms:.0f} ms"),
        "width": width,
        "height": height,
        "views": "\n".join(map(_view_tag, POSITIONS, (view.image for view in views))),
        "first": POSITIONS[0],
        "last": POSITIONS[-1],
        "step": POSITIONS[1] - POSITIONS[0],
        "left_end": _along_slider(0),
        "right_end": _along_slider(1),
        "numbers": "\n".join(_number_tag(name, value) for name, value in _list_numbers(summary)),
        "left": _data_uri(small.left),
        "depth_name": "Depth" if pair.camera else "Disparity",
        "depth": _data_uri(depth),
        "confidence": _data_uri(colour_confidence(small_estimate.confidence, small_estimate.occluded)),
        "ramp": ",".join(legend_colours(24)),
        "ticks": "".join(f"<span>{tick}</span>" for tick in _label_ticks(range_px, pair.camera)),
        "occluded_colour": css_colour(OCCLUDED_RGB),
        # "</" would end the script element that contains the data.
        "data": json.dumps(data).replace("</", "<\\/"),
    }


def downscale(pair: StereoPair, estimate: Estimate, longer_side_px: int) -> tuple[StereoPair, Estimate]:
    """Downscale a pair and its estimate for display, to at most `longer_side_px` on the longer side.

    Disparities are scaled too; the camera is dropped.
    """
    height, width = estimate.disparity_px.shape
    scale = min(1.0, longer_side_px / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    scale_x = np.float32(size[0] / width)
    left, right = (cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (pair.left, pair.right))
    left_seen, right_seen = (
        None if seen is None else _resize_nearest(seen, size) for seen in (pair.left_seen, pair.right_seen)
    )
    return StereoPair(left=left, right=right, left_seen=left_seen, right_seen=right_seen), Estimate(
        disparity_px=_resize_nearest(estimate.disparity_px, size) * scale_x,
        right_disparity_px=_resize_nearest(estimate.right_disparity_px, size) * scale_x,
        confidence=_resize_nearest(estimate.confidence, size),
        occluded=_resize_nearest(estimate.occluded, size),
    )


def _resize_nearest(values: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Resize a map to (width, height) by nearest neighbour, as means across depth edges lie on no surface."""
    numbers = values.view(np.uint8) if values.dtype == bool else values
    return cv2.resize(numbers, size, interpolation=cv2.INTER_NEAREST_EXACT).view(values.dtype)


def _encode_disparity(estimate: Estimate) -> dict[str, object]:
    """Encode the disparities that are shown beside the mouse pointer, as low_px + step_px * level.

    The levels have 16 bits and are encoded in base64.
    """
    height, width = estimate.disparity_px.shape
    scale = min(1.0, _LONGER_SIDE_OF_MAP_PX / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    picked_px = _resize_nearest(estimate.disparity_px, size)
    low_px = float(picked_px.min())
    step_px = max(float(picked_px.max()) - low_px, 1e-6) / 65535
    levels = np.round((picked_px - low_px) / step_px).astype("<u2")
    return {
        "width": size[0],
        "height": size[1],
        "low_px": low_px,
        "step_px": step_px,
        "levels": base64.b64encode(levels.tobytes()).decode(),
    }


def _list_numbers(summary: Summary) -> list[tuple[str, str]]:
    """Return the rows of the summary table: a name, and a value with its unit, in each row."""
    rows = [
        ("Size", f"{summary.width_px} × {summary.height_px} px"),
        ("Model", summary.model),
        ("Time", f"{summary.estimate_ms:.0f} ms"),
        (
            "Disparity (98 % of the pixels)",
            f"{summary.disparity_p1_px:.1f} to {summary.disparity_p99_px:.1f} px",
        ),
        ("Median disparity", f"{summary.disparity_median_px:.1f} px"),
    ]
    if summary.disparity_scale_px is not None and summary.disparity_offset_px is not None:
        formula = format_scale(summary.disparity_scale_px, summary.disparity_offset_px)
        rows.append(("In disparity_scaled.png", f"{formula} px"))
    if summary.camera:
        rows += [
            (
                "Depth (98 % of the pixels)",
                f"{_format_metres(summary.depth_p1_m)} to {_format_metres(summary.depth_p99_m)}",
            ),
            ("Median depth", _format_metres(summary.depth_median_m)),
            ("Focal length", f"{summary.camera.focal_px:.1f} px"),
            ("Baseline", f"{summary.camera.baseline_m * 1000:.1f} mm"),
            ("Left principal point", f"{summary.camera.cx_px:.1f}, {summary.camera.cy_px:.1f} px"),
            ("Principal point offset (doffs)", f"{summary.camera.doffs_px:.2f} px"),
        ]
    return [
        *rows,
        ("Confident (at least 50 %)", f"{summary.confident_percent:.1f} %"),
        ("Occluded", f"{summary.occluded_percent:.1f} %"),
    ]


def _label_ticks(range_px: tuple[float, float], camera: StereoCamera | None) -> list[str]:
    """Return five labels for the colour bar, evenly spaced in disparity.

    The labels are in metres if the camera is known, else in pixels.
    """
    values_px = np.linspace(*range_px, 5)
    if camera is None:
        return [f"{value_px:.1f} px" for value_px in values_px]
    return [_format_metres(_depth_m(camera, value_px)) for value_px in values_px]


def _depth_m(camera: StereoCamera | None, disparity_px: float) -> float | None:
    """Return the depth for a disparity, in metres; None if the depth is infinite or the camera is unknown."""
    if camera is None:
        return None
    depth_m = float(camera.depth_m(np.array([[disparity_px]], np.float64))[0, 0])
    return _round(depth_m) if np.isfinite(depth_m) else None


def _format_metres(depth_m: float | None) -> str:
    if depth_m is None:
        return "∞"
    return f"{depth_m:#.3g} m" if depth_m < 99.95 else f"{depth_m:.0f} m"


def _round(value: float) -> float:
    return round(float(value), 4)


def _along_slider(position: float) -> str:
    return f"{100 * (position - POSITIONS[0]) / (POSITIONS[-1] - POSITIONS[0]):.2f}%"


def _number_tag(name: str, value: str) -> str:
    return f"<div><dt>{html.escape(name)}</dt><dd>{html.escape(value)}</dd></div>"


def _view_tag(position: float, image: UInt8[np.ndarray, "h w 3"]) -> str:
    # The middle view is visible even with scripts disabled.
    shown = ' class="shown"' if position == 0.5 else ""
    return f'<img{shown} src="{_data_uri(image)}" alt="View at position {position}">'


def _data_uri(image: UInt8[np.ndarray, "h w 3"]) -> str:
    """Encode an image as a JPEG data URI."""
    encoded, jpeg = cv2.imencode(
        ".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    )
    assert encoded
    return "data:image/jpeg;base64," + base64.b64encode(jpeg.tobytes()).decode()
