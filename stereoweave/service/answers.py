"""The service's answers: a pair's disparity, depth or view, as the bytes of a file."""

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from stereoweave.cameras.alignment import SWAPPED
from stereoweave.cameras.content import crop
from stereoweave.errors import Note, StereoweaveError
from stereoweave.io.decoding import MOST_PIXELS, open_picture
from stereoweave.io.images import write_image
from stereoweave.io.maps import RangeError
from stereoweave.matching.backend import Backend
from stereoweave.matching.estimate import load_kernels
from stereoweave.matching.matcher import Matcher
from stereoweave.matching.options import MatchOptions
from stereoweave.outputs.point_cloud import require_camera
from stereoweave.outputs.report import Summary
from stereoweave.outputs.results import FILES, needs_camera
from stereoweave.outputs.run import Result, run_many
from stereoweave.pictures.loading import measure_embedded_views, pixel_factor
from stereoweave.pictures.prepare import Prepared, Request, prepare
from stereoweave.rendering.renderer import Renderer, check_position

MOST_MEGAPIXELS = MOST_PIXELS // 1_000_000
MEDIA_TYPES = {
    ".png": "image/png",
    ".jpg": "image/jpeg",
    ".tiff": "image/tiff",
    ".pfm": "image/x-portable-floatmap",
    ".npy": "application/x-npy",
}
_VIEW = "view"
_FIELDS = {
    "format": "format",
    "baseline_m": "baseline_m",
    "calibration": "calib",
    "focal_px": "focal_px",
    "position": "position",
    "range_px": "range",
    "rectify": "rectify",
    "refined": "refined",
    "strength": "strength",
}
# Notes may quote text from a picture, and they are sent in a response header.
_LONGEST_NOTE = 300


class TooLargeError(StereoweaveError):
    """Error for a request that is larger than the service accepts."""


@dataclass(frozen=True, kw_only=True)
class ServiceJob:
    """One request to process.

    Attributes:
        folder: Folder that contains this request's files.
        pictures: Two pictures, left first, or one picture that holds both views.
        file: Name of the file to return: a disparity or depth map in `results.FILES`, or a view such as
            view.png.
        request: Layout, camera and rectification of the pictures.
        options: Matching options; see `match_options`.
        position: Position of a view.
        strength: Factor by which the baseline is multiplied, as in `Renderer`.
        checked: Whether to check the pair and add notes on problems; the job then takes 1.5 times as long.
        most_megapixels: Maximum size of each view of the pair, in megapixels.
    """

    folder: Path
    pictures: tuple[Path, ...]
    file: str
    request: Request = Request()
    options: MatchOptions = MatchOptions()
    position: float = 0.5
    strength: float = 1.0
    checked: bool = False
    most_megapixels: float = MOST_MEGAPIXELS

    def __post_init__(self) -> None:
        if self.is_view:
            check_position(self.position, strength=self.strength)

    @property
    def is_view(self) -> bool:
        """Whether the file is a view rather than a map."""
        return self.file.startswith(_VIEW)

    @property
    def match_options(self) -> MatchOptions:
        """The matching options. Views are always refined, because they show every error at an edge."""
        return replace(self.options, refined=True) if self.is_view else self.options


@dataclass(frozen=True, kw_only=True)
class ServiceAnswer:
    """The bytes of a file, and a JSON report with the fields of `Summary` and the notes."""

    content: bytes
    report: str


BatchAnswerer = Callable[[Sequence[ServiceJob]], list[ServiceAnswer | Exception]]


def check_pixels(job: ServiceJob) -> float:
    """Return the number of megapixels to match, read from the pictures' headers without decoding.

    Raises:
        TooLargeError: A view is larger than the job allows.
        FormatError: A file is not a picture of a supported format.
    """
    views, megapixels = 3 - len(job.pictures), 0.0
    for path in job.pictures:
        with open_picture(path, views=views) as picture:
            format = job.request.format
            embedded_px = measure_embedded_views(path, picture, format) if views == 2 else []
            if embedded_px:
                most = job.most_megapixels
                megapixels += sum(_check_megapixels(path, size_px, most) for size_px in embedded_px)
                continue
            factor = pixel_factor(path, picture, format) if views == 2 else 1
            megapixels += factor * _check_megapixels(path, picture.size, job.most_megapixels * views / factor)
    return megapixels


def _check_megapixels(path: Path, size_px: tuple[int, ...], most_megapixels: float) -> float:
    width_px, height_px = size_px
    megapixels = width_px * height_px / 1e6
    if megapixels > most_megapixels:
        raise TooLargeError(
            f"{path}: expected at most {most_megapixels:g} megapixels, "
            f"found {width_px}x{height_px} pixels; scale the picture down"
        )
    return megapixels


def load_measurer() -> Callable[[ServiceJob], float]:
    """Return the function with which a `ChildProcess` measures a job's pictures."""
    return check_pixels


def load_answerer(backend: Backend) -> BatchAnswerer:
    """Load the network and the kernels of matching, and return the function that answers jobs.

    A `ChildProcess` has started when this returns, so no request waits for these kernels.
    """
    matcher = backend.matcher()
    load_kernels()
    return partial(answer_many, matcher)


def answer_many(matcher: Matcher, jobs: Sequence[ServiceJob]) -> list[ServiceAnswer | Exception]:
    """Return each job's answer or error; jobs with equal options are matched together."""
    outcomes: dict[int, Any] = {}
    by_options: dict[MatchOptions, list[int]] = {}
    for at, job in enumerate(jobs):
        outcomes[at] = _attempt(_prepare, job)
        if isinstance(outcomes[at], Prepared):
            by_options.setdefault(job.match_options, []).append(at)
    for options, indices in by_options.items():
        found = _match_together(matcher, options, [outcomes[at] for at in indices])
        for at, result in zip(indices, found, strict=True):
            failed = isinstance(result, Exception)
            outcomes[at] = result if failed else _attempt(_answer, matcher, jobs[at], result)
    return [outcomes[at] for at in range(len(jobs))]


def field_name(setting: str) -> str | None:
    """Return the form field for a setting; None if the form has no such field."""
    return _FIELDS.get(setting)


def strip_paths(line: str, folder: Path) -> str:
    """Remove this machine's paths and line breaks from a message."""
    text = line.replace(f"{folder}/", "")
    text = re.sub(r"(?<![^\s'\"(])/(?:[^\s/]+/)+", "", text)  # the path of a model file
    return " ".join(text.split())


def _attempt(work: Callable[..., Any], *given: Any, **options: Any) -> Any:
    """Call a function, and return its result or the error that it raises."""
    try:
        return work(*given, **options)
    except Exception as error:  # no error may affect the other jobs of the batch
        return error


def _prepare(job: ServiceJob) -> Prepared:
    prepared = prepare(job.pictures, job.request)
    # Check again, because views detected as half-size are enlarged beyond the size in the picture's header.
    _check_megapixels(job.pictures[0], prepared.pair.left.shape[1::-1], job.most_megapixels)
    if needs_camera(job.file):
        require_camera(prepared.pair)
    return replace(prepared, pair=crop(prepared.pair)) if job.is_view else prepared


def _match_together(
    matcher: Matcher, options: MatchOptions, prepared: Sequence[Prepared]
) -> Sequence[Result | Exception]:
    """Match pairs together, and return the result or error of each."""
    results = _attempt(run_many, prepared, matcher, options)
    if not isinstance(results, Exception):
        return results
    if len(prepared) == 1:
        return [results]
    # Match the pairs one by one, so that one pair's error does not affect the others.
    return [found for each in prepared for found in _match_together(matcher, options, [each])]


def _answer(matcher: Matcher, job: ServiceJob, result: Result) -> ServiceAnswer:
    # Report the network's own name, because the model may be a path on this machine.
    summary = replace(result.summary, model=matcher.name)
    notes = [*result.notes, *(result.warnings() if job.checked else ())]
    # Do not write to the pictures' folder, because it is removed if the client disconnects, and writing would
    # create it again.
    with TemporaryDirectory(prefix="stereoweave-") as folder:
        path = Path(folder, job.file)
        if job.is_view:
            renderer = Renderer(result.pair, result.estimate, strength=job.strength, threads=result.threads)
            write_image(path, renderer.view(job.position).image)
        else:
            _write_map(path, result)
        return ServiceAnswer(content=path.read_bytes(), report=_make_report(summary, notes, job.folder))


def _write_map(path: Path, result: Result) -> None:
    try:
        FILES[path.name](path, result)
    except RangeError as error:
        summary = result.summary
        swapped = summary.disparity_min_px < 0 and SWAPPED in result.warnings()
        cause = f"{SWAPPED.format(field_name)}; or " if swapped else ""
        raise StereoweaveError(
            f"{path.name}: expected disparities from 0 to 255.99 px, the range of a PNG, found "
            f"{summary.disparity_min_px:.2f} to {summary.disparity_max_px:.2f} px; "
            f"{cause}request pfm, npy or tiff"
        ) from error


def _make_report(summary: Summary, notes: Sequence[Note], folder: Path) -> str:
    lines = [strip_paths(note.format(field_name), folder)[:_LONGEST_NOTE] for note in notes]
    return json.dumps(asdict(summary) | {"notes": lines}, allow_nan=False)
