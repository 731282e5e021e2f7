"""Matching, drawing, measurement and output for a visitor to the web page, without the user interface."""

import asyncio
import zipfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from stereoweave.app.stereo_pictures import StereoPicture, Wish, crop_both
from stereoweave.cameras.content import find_content
from stereoweave.errors import FormatError, NameOf, Note, Remedy, StereoweaveError, keyword
from stereoweave.io.colormap import colour_disparity, find_colour_range_px
from stereoweave.matching.backend import Backend
from stereoweave.matching.options import MatchOptions
from stereoweave.outputs.measure import distance
from stereoweave.outputs.metres import format_metres
from stereoweave.outputs.report import Summary
from stereoweave.outputs.results import FILES, REPORT, needs_camera, write_files
from stereoweave.outputs.run import Result, run
from stereoweave.pictures.prepare import Prepared, Request, prepare
from stereoweave.rendering.renderer import Renderer
from stereoweave.rendering.scaling import fit_size, scale_down
from stereoweave.stereo import Estimate, StereoPair

_LONGER_SIDE_PX = 1280
# Files up to this total size, reached at about 8 megapixels, are stored twice: individually and in the zip.
_MOST_ZIPPED_BYTES = 300 * 1024**2
# The files that everyone can open.
_SHOWN_FIRST = ("report.html", "preview.png")
_NO_METRES = "For metres, give a calibration file, or the focal length and the baseline."


@dataclass(frozen=True, kw_only=True)
class Session:
    """A visitor's latest result, and the folder that contains its files.

    Attributes:
        result: The result at full size.
        pair, estimate: Both as the page shows them, scaled down and without the borders of an aligned pair.
        content: The rows and columns of the full-size left image that they show.
        renderer: Renderer of views of that pair.
        folder: Folder of the result's files.
        stereo_pictures: The 3-D pictures made so far.
        making: Held while one is made: each is made once, and a later choice is answered later.
    """

    result: Result
    pair: StereoPair
    estimate: Estimate
    content: tuple[slice, slice]
    renderer: Renderer
    folder: Path
    stereo_pictures: dict[Wish, StereoPicture] = field(default_factory=dict)
    making: asyncio.Lock = field(default_factory=asyncio.Lock)

    @property
    def is_written(self) -> bool:
        """Whether the result's files are written."""
        return any((self.folder / name).exists() for name in FILES)

    @property
    def shown_report(self) -> Path:
        """The report that the page shows, once it is asked for."""
        return self.folder / "shown" / REPORT

    def given_px(self, shown_px: tuple[int, int]) -> tuple[int, int]:
        """Convert the column and row of a pixel in the displayed image to those in the full-size image."""
        column, row = (
            round(part.start + (at + 0.5) * (part.stop - part.start) / side - 0.5)
            for at, part, side in zip(shown_px, self.content[::-1], self.pair.left.shape[1::-1], strict=True)
        )
        return column, row

    @property
    def scale(self) -> float:
        """The size at which the page shows the pair, as a share of its own."""
        return self.pair.left.shape[1] / (self.content[1].stop - self.content[1].start)


@dataclass(frozen=True, kw_only=True)
class Uploads:
    """A visitor's uploaded pictures and settings; `name_of` names settings in the report."""

    pictures: tuple[Path, ...]
    request: Request
    backend: Backend
    name_of: NameOf = keyword


def match_uploads(uploads: Uploads, report_progress: Callable[[float, str], None]) -> Result:
    """Match uploaded pictures.

    `report_progress` is called with the completed fraction, from 0 to 1, and the name of the next step.
    """
    if not uploads.pictures:
        raise StereoweaveError(
            "expected a left and a right picture, or one file with both views, found none; drop them on the "
            "form, or try the sample"
        )
    check_uploads([*uploads.pictures, uploads.request.calibration])
    report_progress(0.1, "reading")
    prepared = _prepare(uploads)
    height, width = prepared.pair.left.shape[:2]
    report_progress(0.3, f"matching {width}×{height} px")
    result = run(prepared, uploads.backend.matcher(), MatchOptions(refined=True))
    result = replace(result, name_of=uploads.name_of)
    find_early_warnings(result)
    return result


def find_early_warnings(result: Result) -> list[Note]:
    """Return the warnings if they cost little, as after an alignment, so that they are shown at once."""
    return result.warnings() if result.alignment else []


def _prepare(uploads: Uploads) -> Prepared:
    """Prepare the uploads; the error for a damaged calibration says that there may be none."""
    try:
        return prepare(uploads.pictures, uploads.request)
    except FormatError as error:
        if error.remedy is None and error.message.startswith(f"{uploads.request.calibration}: "):
            error.remedy = Remedy("give another file, or none", ("calibration",))
        raise


def check_uploads(files: Iterable[Path | None]) -> None:
    """Raise a StereoweaveError if the page has already removed an uploaded file."""
    for file in files:
        if file and not file.exists():
            raise StereoweaveError(
                f"{file.name}: expected an upload from the last hour, found an expired one; "
                "upload the file again"
            )


def open_session(result: Result, folder: Path) -> Session:
    """Return a session for a result, which keeps its files in `folder`."""
    pair, estimate = crop_both(result.pair, result.estimate)
    size_px = fit_size(pair.left.shape, (_LONGER_SIDE_PX, _LONGER_SIDE_PX))
    pair, estimate = scale_down(pair, estimate, size_px)
    return Session(
        result=result,
        pair=pair,
        estimate=estimate,
        content=find_content(result.pair),
        renderer=Renderer(pair, estimate),
        folder=folder,
    )


@dataclass(frozen=True, kw_only=True)
class Written:
    """A result's files in all formats, an archive of them, and what the user should know.

    Attributes:
        files: The files.
        archive: The archive; None if the files are too large to be stored twice.
        notes: Notes on skipped files.
        warnings: Notes on likely defects of the pair.
    """

    files: list[Path]
    archive: Path | None
    notes: list[Note]
    warnings: list[Note]


def write_all(result: Result, folder: Path, report_progress: Callable[[float, str], None]) -> Written:
    """Write the result's files in all formats, and check the pair."""
    report_progress(0.7, "checking the pictures")
    warnings = result.warnings()
    report_progress(0.8, "writing the files")
    names = [name for name in FILES if result.pair.camera or not needs_camera(name)]
    notes = write_files(folder, names, result)
    names = [*_SHOWN_FIRST, *(name for name in names if name not in _SHOWN_FIRST)]
    files = [file for file in map(folder.joinpath, names) if file.exists()]
    archive = zip_files(folder / "stereoweave.zip", files)
    return Written(files=files, archive=archive, notes=notes, warnings=warnings)


def zip_files(file: Path, files: Sequence[Path]) -> Path | None:
    """Put files into an uncompressed zip archive, and return its path; None if the files are too large."""
    if sum(path.stat().st_size for path in files) > _MOST_ZIPPED_BYTES:
        return None
    with zipfile.ZipFile(file, "w") as archive:
        for path in files:
            archive.write(path, path.name)
    return file


def write_shown_report(result: Result, file: Path, report_progress: Callable[[float, str], None]) -> None:
    """Write the report into a folder of its own, so that it links to no other files."""
    report_progress(0.5, "drawing the report")
    file.parent.mkdir(exist_ok=True)
    write_files(file.parent, [file.name], result)


def colour_depth(session: Session) -> UInt8[np.ndarray, "h w 3"]:
    """Return the disparity as an RGB image [H, W, 3]."""
    disparity_px = session.estimate.disparity_px
    return colour_disparity(disparity_px, find_colour_range_px(disparity_px))


def format_colour_range(session: Session) -> tuple[str, str]:
    """Format the depths of the first and the last colour, or the disparities if the camera is unknown."""
    ends_px = np.array([find_colour_range_px(session.estimate.disparity_px)])
    if not session.pair.camera:
        far_px, near_px = ends_px[0] / session.scale
        return f"{far_px:.1f} px", f"{near_px:.1f} px"
    far_m, near_m = session.pair.camera.depth_m(ends_px)[0]
    return format_metres(far_m), format_metres(near_m)


def mark_clicks(
    image: UInt8[np.ndarray, "h w 3"], clicks: Sequence[tuple[int, int]]
) -> UInt8[np.ndarray, "h w 3"]:
    """Return the image with a ring at each click, and a line between two clicks."""
    marked = image.copy()
    for colour, width in (((0, 0, 0), 5), ((255, 255, 255), 2)):
        cv2.polylines(marked, [np.array(clicks, np.int32)], False, colour, width, cv2.LINE_AA)
        for click in clicks:
            cv2.circle(marked, click, 7, colour, width, cv2.LINE_AA)
    return marked


def measure_clicks(session: Session, clicks: Sequence[tuple[int, int]]) -> list[str]:
    """Describe each clicked point in one line, and the distance between two points in another."""
    estimate, camera = session.result.estimate, session.result.pair.camera
    points = [session.given_px(click) for click in clicks]
    lines = [_describe_pixel(session.result, point) for point in points]
    if camera is None:
        return [*lines, _NO_METRES]
    if len(points) == 2:
        try:
            measured = distance(estimate, camera, *points)
            lines.append(
                f"Between the two: {measured}; in two of three cases, the error is smaller than that"
            )
        except StereoweaveError as error:
            lines.append(f"Between the two: {error}")
    return lines


def format_summary(summary: Summary) -> list[str]:
    """Format a result's depth and confidence as one line, its size, time and disparity as another."""
    depth = "Depth without metres (they need a calibration)"
    if summary.depth_p1_m is not None:
        depth = (
            f"Depth from {format_metres(summary.depth_p1_m)}, median {format_metres(summary.depth_median_m)}"
        )
    return [
        f"{depth}; confident in {summary.confident_percent:.0f} % of the picture",
        f"{summary.width_px}×{summary.height_px} px, matched in {summary.estimate_ms / 1000:.1f} s; "
        f"between the pictures, things move by {summary.disparity_p1_px:.1f} to "
        f"{summary.disparity_p99_px:.1f} px (disparity)",
    ]


def _describe_pixel(result: Result, point: tuple[int, int]) -> str:
    """Describe the disparity, depth and confidence at a pixel of the full-size left image."""
    column, row = point
    disparity_px = result.estimate.disparity_px[row : row + 1, column : column + 1]
    text = f"({column}, {row}): disparity {disparity_px[0, 0]:.2f} px"
    if result.pair.camera:
        text += f", depth {format_metres(float(result.pair.camera.depth_m(disparity_px)[0, 0]))}"
    return f"{text}; confidence {100 * result.estimate.confidence[row, column]:.0f} %"
