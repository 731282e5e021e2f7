"""Self-contained HTML report on a result: images, a summary, and new views with a slider."""

import html
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from stereoweave import __version__
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
from stereoweave.outputs.metres import format_metres
from stereoweave.outputs.page_parts import embed_json
from stereoweave.outputs.report_parts import (
    download_card,
    fill_template,
    jpeg_uri,
    list_box,
    pack_map,
    term_list,
    view_tags,
)
from stereoweave.outputs.viewer_scene import pack_scene
from stereoweave.rendering.layouts import LAYOUTS, LayoutOptions, median_disparity_px, render_views
from stereoweave.rendering.renderer import Renderer
from stereoweave.rendering.scaling import fit_size, resize_nearest, scale_down
from stereoweave.stereo import Estimate, StereoCamera, StereoPair, assume_camera

# Views for browsers without WebGL; others show the view from any position.
POSITIONS = (0.0, 0.25, 0.5, 0.75, 1.0)

_LONGER_SIDE_PX = 1000
_LONGER_SIDE_OF_MAP_PX = 640
# The 3-D view shows what is farther than this multiple of the distance about which it turns there.
_FARTHEST = 4.0
_LEAST_MIDDLE_PX = 1.0
# Largest difference of disparity, per pixel, on one surface of the 3-D view; a larger one is an edge.
# With 1 px, slanted ground had stripes.
_STEEPEST = 2.0


_DISPARITY = " The disparity is how many pixels apart the two pictures show a point."
_NO_METRES = (
    '<p class="note">For depth in metres, give a calibration, or the focal length and baseline of the '
    "cameras.</p>"
)


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
    seen = _seen(pair)
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


@dataclass(frozen=True, kw_only=True)
class Context:
    """What a report needs besides the result itself.

    Attributes:
        warnings: Lines about likely defects of the pair or the result.
        notes: Lines on what was detected or changed while the pictures were read.
        command: The command that made the result, as typed; "" if there was none.
        date: When the pair was matched.
        files: The result's other files, which lie in the report's folder.
        threads: Number of threads for rendering; default: all cores.
    """

    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    command: str = ""
    date: datetime | None = None
    files: tuple[Path, ...] = ()
    threads: int | None = None


def write_report(
    path: Path, pair: StereoPair, estimate: Estimate, summary: Summary, context: Context
) -> None:
    """Write the report as a single HTML file, which loads no other file.

    The report shows the warnings, new views with a slider to move the viewpoint, a wiggle, an anaglyph, the
    left image in 3-D and plain, the depth (or the disparity if the camera is unknown), the confidence, the
    summary, and how the result was made. It links to the context's files. Images have at most 1000 px on the
    longer side.
    """
    page = fill_template(_collect_fields(pair, estimate, summary, context))
    with writing_text(path) as file:
        file.write(page)


def _collect_fields(
    pair: StereoPair, estimate: Estimate, summary: Summary, context: Context
) -> dict[str, object]:
    """Return the values of the template's fields by name."""
    size_px = fit_size(pair.left.shape, (_LONGER_SIDE_PX, _LONGER_SIDE_PX))
    small, small_estimate = scale_down(pair, estimate, size_px)
    width, height = size_px
    range_px = find_colour_range_px(np.atleast_2d(estimate.disparity_px[_seen(pair)]))
    depth = colour_disparity(resize_nearest(estimate.disparity_px, size_px), range_px)
    if small.left_seen is not None:
        depth[~small.left_seen] = 0
    views = _show_views(small, small_estimate, context.threads)
    data = {
        "width_px": summary.width_px,
        "height_px": summary.height_px,
        "camera": asdict(pair.camera) if pair.camera else None,
        "map": pack_map(*_downscale_map(pair, estimate)),
        "scene": _place_scene(pair, estimate),
        **views.data,
    }
    size = f"{summary.width_px} × {summary.height_px} px"
    return {
        "title": html.escape(" + ".join(summary.pictures)),
        "subtitle": html.escape(f"{size}, matched by the model {summary.model} in {_format_time(summary)}"),
        "banner": list_box("banner", "Warnings", context.warnings),
        "notes": list_box("card notes", "Notes", context.notes),
        "width": width,
        "height": height,
        **views.fields,
        "numbers": term_list(_list_numbers(summary)),
        "metres": "" if pair.camera else _NO_METRES,
        "depth_name": "Depth" if pair.camera else "Disparity",
        "meaning": "" if pair.camera else _DISPARITY,
        "depth": jpeg_uri(depth),
        "confidence": jpeg_uri(colour_confidence(small_estimate.confidence, small_estimate.occluded)),
        "ramp": ",".join(legend_colours(24)),
        "ticks": "".join(f"<span>{tick}</span>" for tick in _label_ticks(range_px, pair.camera)),
        "occluded_colour": css_colour(OCCLUDED_RGB),
        "downloads": download_card(context.files),
        "command": term_list([("Command", context.command)], kind="long") if context.command else "",
        "making": term_list(_list_making(context)),
        "data": embed_json(data),
    }


class _Views(NamedTuple):
    """Fields of the template, and data for its script, that show the new views."""

    fields: dict[str, object]
    data: dict[str, object]


def _show_views(pair: StereoPair, estimate: Estimate, threads: int | None) -> _Views:
    """Prepare the new views and the anaglyph of a pair that is small enough to display."""
    width = pair.left.shape[1]
    # A matcher file may give more, which no view can be moved by.
    middle_px = float(np.clip(median_disparity_px(estimate), -width, width))
    renderer = Renderer(pair, estimate, convergence_px=middle_px, threads=threads)
    photo = pack_scene(pair, estimate, convergence_px=middle_px, threads=threads)
    first, last = photo["positions"]
    left_end, right_end = (f"{100 * (position - first) / (last - first):.2f}%" for position in (0, 1))
    return _Views(
        fields={
            "views": view_tags(POSITIONS, list(render_views(renderer, POSITIONS))),
            "first": f"{first:g}",
            "last": f"{last:g}",
            "left_end": left_end,
            "right_end": right_end,
            "left": photo.pop("front"),
            "anaglyph": jpeg_uri(LAYOUTS["anaglyph_dubois"].compose(renderer, LayoutOptions())),
        },
        data={"photo": photo, "positions": POSITIONS},
    )


def _downscale_map(pair: StereoPair, estimate: Estimate) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return disparity, confidence and occlusion for the read-out; the disparity stays in px of the pair.

    The confidence is NaN outside the left image's content.
    """
    size_px = fit_size(pair.left.shape, (_LONGER_SIDE_OF_MAP_PX, _LONGER_SIDE_OF_MAP_PX))
    confidence = estimate.confidence
    if pair.left_seen is not None:
        confidence = np.where(pair.left_seen, confidence, np.float32(np.nan))
    return (
        resize_nearest(estimate.disparity_px, size_px),
        resize_nearest(confidence, size_px),
        resize_nearest(estimate.occluded, size_px),
    )


def _place_scene(pair: StereoPair, estimate: Estimate) -> dict[str, float]:
    """Return the camera of the 3-D view, in px of the pair and in baselines.

    The view turns about the distance `middle`, that of the disparity halfway between the least and the
    greatest one, outliers aside. What is farther than `farthest` is shown there. Without a camera, or with
    one for which the middle is infinitely far, one is assumed (`stereo.assume_camera`), and the least
    disparity is taken to be at infinity.
    """
    least_px, greatest_px = np.percentile(estimate.disparity_px[_seen(pair)], [1, 99]).tolist()
    halfway_px = (least_px + greatest_px) / 2
    height, width = estimate.disparity_px.shape
    camera = pair.camera
    if camera is None or halfway_px + camera.doffs_px < _LEAST_MIDDLE_PX:
        camera = assume_camera((width, height), doffs_px=max(0.0, -least_px, _LEAST_MIDDLE_PX - halfway_px))
    middle_px = halfway_px + camera.doffs_px
    return {
        "focal_px": camera.focal_px,
        "cx_px": camera.cx_px,
        "cy_px": camera.cy_px,
        "doffs_px": camera.doffs_px,
        "least_px": middle_px / _FARTHEST,
        "steepest_px": _STEEPEST * max(1.0, max(height, width) / _LONGER_SIDE_OF_MAP_PX),
        "middle": camera.focal_px / middle_px,
        "farthest": _FARTHEST * camera.focal_px / middle_px,
    }


def _list_numbers(summary: Summary) -> list[tuple[str, str]]:
    """Return the rows of the summary table: a name, and a value with its unit, in each row."""
    rows = [
        ("Size", f"{summary.width_px} × {summary.height_px} px"),
        ("Model", summary.model),
        ("Time", _format_time(summary)),
        (
            "Disparity (the middle 98 % of the pixels)",
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
                "Depth (the middle 98 % of the pixels)",
                f"{format_metres(summary.depth_p1_m)} to {format_metres(summary.depth_p99_m)}",
            ),
            ("Median depth", format_metres(summary.depth_median_m)),
            ("Focal length", f"{summary.camera.focal_px:.1f} px"),
            ("Baseline", f"{summary.camera.baseline_m * 1000:.1f} mm"),
            ("Left principal point", f"{summary.camera.cx_px:.1f}, {summary.camera.cy_px:.1f} px"),
            ("Principal point offset (doffs)", f"{summary.camera.doffs_px:.2f} px"),
        ]
    return [
        *rows,
        ("Pixels with a confidence of at least 50 %", f"{summary.confident_percent:.1f} %"),
        ("Occluded: seen by the left camera only", f"{summary.occluded_percent:.1f} %"),
    ]


def _list_making(context: Context) -> list[tuple[str, str]]:
    """Return how the result was made, besides the command: names and values."""
    date = [("Date", f"{context.date:%Y-%m-%d %H:%M %Z}")] if context.date else []
    return [("Version", f"Stereoweave {__version__}"), *date]


def _seen(pair: StereoPair) -> Any:
    """Return an index of the pixels that the left image covers."""
    return np.s_[:] if pair.left_seen is None else pair.left_seen


def _label_ticks(range_px: tuple[float, float], camera: StereoCamera | None) -> list[str]:
    """Return five labels for the colour bar, evenly spaced in disparity.

    The labels are in metres if the camera is known, else in pixels.
    """
    values_px = np.linspace(*range_px, 5)
    if camera is None:
        return [f"{value_px:.1f} px" for value_px in values_px]
    return [format_metres(_depth_m(camera, value_px)) for value_px in values_px]


def _depth_m(camera: StereoCamera | None, disparity_px: float) -> float | None:
    """Return the depth for a disparity, in metres; None if the depth is infinite or the camera is unknown."""
    if camera is None:
        return None
    depth_m = float(camera.depth_m(np.array([[disparity_px]], np.float64))[0, 0])
    return _round(depth_m) if np.isfinite(depth_m) else None


def _format_time(summary: Summary) -> str:
    time_ms = summary.estimate_ms
    return f"{time_ms:.0f} ms" if time_ms < 999.5 else f"{time_ms / 1000:.1f} s"


def _round(value: float) -> float:
    return round(float(value), 4)
