"""What the service makes of the pictures of a request: disparity, depth or a view, as the bytes of a file."""

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from stereoweave.cameras.rectify import crop
from stereoweave.errors import Note, StereoweaveError
from stereoweave.io.decoding import MOST_PIXELS, open_picture
from stereoweave.io.files import RangeError, write_image
from stereoweave.matching.backend import Backend
from stereoweave.matching.matcher import Matcher
from stereoweave.matching.options import MatchOptions
from stereoweave.outputs.point_cloud import needed_camera
from stereoweave.outputs.report import Summary
from stereoweave.outputs.results import FILES, needs_camera
from stereoweave.outputs.run import Result, run_many
from stereoweave.pictures.loading import pixel_factor
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
    "arrangement": "format",
    "baseline_m": "baseline_m",
    "calibration": "calib",
    "focal_px": "focal_px",
    "position": "position",
    "range_px": "range",
    "rectify": "rectify",
    "refined": "refined",
    "strength": "strength",
}
# A note may quote its picture, and what carries them is the head of a response.
_LONGEST_NOTE = 300


class TooLargeError(StereoweaveError):
    """A picture of more pixels than the service takes."""


@dataclass(frozen=True, kw_only=True)
class ServiceJob:
    """What a request wants.

    Attributes:
        folder: Its own, where its pictures are.
        pictures: Two, left first, or one that holds both views.
        file: What it gets: a disparity or a depth in `results.FILES`, or a view, such as view.png.
        request: What is said of the pictures.
        options: How the pair is matched; see `match_options`.
        position: Where a view is seen from.
        strength: As for `rendering.Renderer`.
        checked: Whether the notes say what is amiss with the pair, which takes half as long again.
        most_megapixels: Of a view.
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
            check_position(0.5 + self.strength * (self.position - 0.5))

    @property
    def is_view(self) -> bool:
        """Whether a view is wanted, and not a map."""
        return self.file.startswith(_VIEW)

    @property
    def match_options(self) -> MatchOptions:
        """The options, refined for a view: it shows every error at an edge."""
        return replace(self.options, refined=True) if self.is_view else self.options


@dataclass(frozen=True, kw_only=True)
class Answer:
    """The bytes of a file, and in JSON what is said of it: the numbers of its `Summary`, and notes."""

    content: bytes
    report: str


Answering = Callable[[Sequence[ServiceJob]], list[Answer | Exception]]


def check_pixels(job: ServiceJob) -> float:
    """The megapixels that are matched, as the heads of the job's pictures say, before memory is spent.

    Raises:
        TooLargeError: More than the job's views may have.
        FormatError: No picture, or none of a kind that is read.
    """
    views, megapixels = 3 - len(job.pictures), 0.0
    for path in job.pictures:
        with open_picture(path, views=views) as picture:
            factor = pixel_factor(path, picture, job.request.arrangement) if views == 2 else 1
            megapixels += factor * _checked_megapixels(
                path, picture.size, job.most_megapixels * views / factor
            )
    return megapixels


def _checked_megapixels(path: Path, size_px: tuple[int, ...], most_megapixels: float) -> float:
    width_px, height_px = size_px
    megapixels = width_px * height_px / 1e6
    if megapixels > most_megapixels:
        raise TooLargeError(
            f"{path}: expected at most {most_megapixels:g} megapixels, "
            f"found {width_px}x{height_px}; scale it down"
        )
    return megapixels


def measuring() -> Callable[[ServiceJob], float]:
    """For a `ChildProcess`: the function that measures the pictures of a job."""
    return check_pixels


def answering(backend: Backend) -> Answering:
    """For a `ChildProcess`: load the network and return the function that answers jobs with it."""
    return partial(answer_many, backend.matcher())


def answer_many(matcher: Matcher, jobs: Sequence[ServiceJob]) -> list[Answer | Exception]:
    """What each job gets, or why it gets nothing; those of the same options are matched together."""
    outcome: dict[int, Any] = {}
    alike: dict[MatchOptions, list[int]] = {}
    for at, job in enumerate(jobs):
        outcome[at] = _attempt(_prepared, job)
        if isinstance(outcome[at], Prepared):
            alike.setdefault(job.match_options, []).append(at)
    for options, places in alike.items():
        found = _matched(matcher, options, [outcome[at] for at in places])
        for at, result in zip(places, found, strict=True):
            failed = isinstance(result, Exception)
            outcome[at] = result if failed else _attempt(_answered, matcher, jobs[at], result)
    return [outcome[at] for at in range(len(jobs))]


def field_name(setting: str) -> str | None:
    """The field of a request's form for a setting; None if a request does not have it."""
    return _FIELDS.get(setting)


def without_paths(line: str, folder: Path) -> str:
    """A message in one line, without the paths of this machine."""
    text = line.replace(f"{folder}/", "")
    text = re.sub(r"(?<![^\s'\"(])/(?:[^\s/]+/)+", "", text)  # where a network is
    return " ".join(text.split())


def _attempt(work: Callable[..., Any], *given: Any, **options: Any) -> Any:
    """What the work gives, or its error."""
    try:
        return work(*given, **options)
    except Exception as error:  # whatever it is: the others of the batch shall not be told it
        return error


def _prepared(job: ServiceJob) -> Prepared:
    prepared = prepare(job.pictures, job.request)
    # Again: half views that are guessed are larger than the head of their picture says.
    _checked_megapixels(job.pictures[0], prepared.pair.left.shape[1::-1], job.most_megapixels)
    if needs_camera(job.file):
        needed_camera(prepared.pair)
    return replace(prepared, pair=crop(prepared.pair)) if job.is_view else prepared


def _matched(
    matcher: Matcher, options: MatchOptions, prepared: Sequence[Prepared]
) -> Sequence[Result | Exception]:
    """The results of pairs that are matched together, or the error of each that cannot be matched."""
    results = _attempt(run_many, prepared, matcher, options)
    if not isinstance(results, Exception):
        return results
    if len(prepared) == 1:
        return [results]
    # One by one, so that those that can be matched are.
    return [found for each in prepared for found in _matched(matcher, options, [each])]


def _answered(matcher: Matcher, job: ServiceJob, result: Result) -> Answer:
    # The network's own name: the one that it was loaded by may be a path of this machine.
    summary = replace(result.summary, model=matcher.name)
    notes = [*result.notes, *(result.warnings() if job.checked else ())]
    # Not beside its pictures: where the client went away their folder is removed, and would be made again.
    with TemporaryDirectory(prefix="stereoweave-") as folder:
        path = Path(folder, job.file)
        if job.is_view:
            renderer = Renderer(result.pair, result.estimate, strength=job.strength, threads=result.threads)
            write_image(path, renderer.view(job.position).image)
        else:
            _write_map(path, result)
        return Answer(content=path.read_bytes(), report=_report(summary, notes, job.folder))


def _write_map(path: Path, result: Result) -> None:
    try:
        FILES[path.name](path, result)
    except RangeError as error:
        summary = result.summary
        raise StereoweaveError(
            f"{path.name}: expected 0 to 255.99 px, which a PNG holds, found "
            f"{summary.disparity_min_px:.2f} to {summary.disparity_max_px:.2f} px; ask for pfm, npy or tiff"
        ) from error


def _report(summary: Summary, notes: Sequence[Note], folder: Path) -> str:
    lines = [without_paths(note.worded(field_name), folder)[:_LONGEST_NOTE] for note in notes]
    return json.dumps(asdict(summary) | {"notes": lines}, allow_nan=False)
