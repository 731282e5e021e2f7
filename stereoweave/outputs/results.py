"""What `depth` writes of a pair: maps, masks, pictures of them, points and surfaces, and the report.

Where the left picture shows nothing (`StereoPair.left_seen`) disparity and depth are unknown: infinite in a
PFM file, which is Middlebury's way, NaN in NPY and TIFF files, and 0 in a PNG. What is infinitely far is
infinite in all files of depth but the PNG, where it is 0 too.
"""

import hashlib
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from stereoweave import __version__
from stereoweave.cameras.calibration_files import read_calibration_bytes
from stereoweave.errors import NameOf, Note, Remedy, StereoweaveError, keyword
from stereoweave.io.colormap import colour_disparity, find_colour_range_px, grey_confidence
from stereoweave.io.files import (
    RangeError,
    make_folder,
    make_parent_folder,
    reading,
    write_depth_png,
    write_disparity_png,
    write_float_tiff,
    write_image,
    write_npy,
    write_pfm,
)
from stereoweave.io.output_lock import lock_output
from stereoweave.matching.backend import Backend
from stereoweave.matching.options import MatchOptions
from stereoweave.outputs.point_cloud import (
    MOST_POINTS,
    NO_CAMERA,
    EmptyError,
    needing_the_mesh_extra,
    write_glb,
    write_ply,
)
from stereoweave.outputs.report import Summary, write_report
from stereoweave.outputs.run import Result, run
from stereoweave.pictures.prepare import Request, prepare
from stereoweave.stereo import StereoPair


def _write_preview(path: Path, result: Result) -> None:
    disparity_px = result.estimate.disparity_px
    range_px = find_colour_range_px(disparity_px[result.seen][None])
    write_image(path, colour_disparity(disparity_px, range_px) * result.seen[..., None])


# Every file that `depth` can write.
FILES: dict[str, Callable[[Path, Result], None]] = {
    "disparity.pfm": lambda path, result: write_pfm(path, result.disparity_px(np.inf)),
    "disparity.png": lambda path, result: write_disparity_png(path, result.disparity_px()),
    "disparity.npy": lambda path, result: write_npy(path, result.disparity_px()),
    "disparity.tiff": lambda path, result: write_float_tiff(path, result.disparity_px()),
    "depth.png": lambda path, result: write_depth_png(path, result.depth_m()),
    "depth.pfm": lambda path, result: write_pfm(path, result.depth_m(np.inf)),
    "depth.npy": lambda path, result: write_npy(path, result.depth_m()),
    "depth.tiff": lambda path, result: write_float_tiff(path, result.depth_m()),
    "preview.png": _write_preview,
    "confidence.png": lambda path, result: write_image(path, grey_confidence(result.estimate.confidence)),
    "occluded.png": lambda path, result: write_image(path, np.uint8(255) * result.estimate.occluded),
    "cloud.ply": lambda path, result: write_ply(path, result.cloud),
    "cloud.glb": lambda path, result: write_glb(path, result.cloud),
    "mesh.ply": lambda path, result: write_ply(path, result.surface),
    "mesh.glb": lambda path, result: write_glb(path, result.surface),
    "report.html": lambda path, result: write_report(
        path, result.pair, result.estimate, result.summary, result.threads
    ),
}
ALWAYS = ("disparity.pfm", "disparity.png", "preview.png", "confidence.png", "occluded.png", "report.html")
ALL = "all"


@dataclass(frozen=True, kw_only=True)
class DepthJob:
    """What is to be made of every pair: what is said of the pictures, with which network and how.

    Attributes:
        request: What is said of the pictures.
        backend: What matches them.
        options: How the pair is matched.
        files: What is written beside `always`, names in FILES, or "all"; depth.png is with any camera.
        always: What is written of every pair.
        name_of: The front end's names for settings, in the notes and failures that a batch writes down.
    """

    request: Request = Request()
    backend: Backend = Backend()
    options: MatchOptions = MatchOptions()
    files: tuple[str, ...] = ()
    always: tuple[str, ...] = ALWAYS
    name_of: NameOf = keyword

    def __post_init__(self) -> None:
        for file in self.files:
            if file not in FILES and file != ALL:
                raise StereoweaveError(
                    f"expected {ALL} or one of {', '.join(FILES)}, found {file!r}", setting="files"
                )


def make_depth(pictures: Sequence[Path], out: Path, job: DepthJob) -> tuple[Summary, list[Note]]:
    """Write all results of a pair to `out` atomically. Returns the summary and user-facing notes."""
    matcher = job.backend.matcher()
    prepared = prepare(pictures, job.request)
    files, left_out = _files_of(job, prepared.pair)
    with _results_in(out) as folder:
        result = run(prepared, matcher, job.options)
        notes = [*result.notes, *left_out, *write_files(folder, files, result), *result.warnings()]
    return result.summary, notes


def job_facts(job: DepthJob) -> dict[str, Any]:
    """All that decides the results of a pair beside its pictures, files by what is in them.

    What it is computed with does not: a batch whose GPU fails can be finished on the processor.
    """
    model, calibration = str(job.backend.model), job.request.calibration
    if model.endswith(".onnx"):
        with reading(model, "a model"):
            model = _by_content(model, Path(model).read_bytes())
    facts = {"stereoweave": __version__, "model": model, **asdict(job.options)}
    facts |= {"files": job.files, "always": job.always, **asdict(job.request)}
    if calibration:
        facts["calibration"] = _by_content(calibration, read_calibration_bytes(calibration))
    return facts


def _by_content(path: str | Path, content: bytes) -> str:
    return f"{Path(path).name} {hashlib.sha256(content).hexdigest()[:12]}"


def needs_camera(file: str) -> bool:
    """Whether a file in FILES is in metres."""
    return file.startswith(("depth.", "cloud.", "mesh."))


def _files_of(job: DepthJob, pair: StereoPair) -> tuple[list[str], list[Note]]:
    """The files to write of a pair, and notes; raises StereoweaveError if they need a camera without one."""
    wanted, notes = {*job.always, *job.files}, list[Note]()
    if pair.camera:
        wanted.add("depth.png")
    if ALL in wanted:
        wanted |= {file for file in FILES if pair.camera or not needs_camera(file)}
        if not pair.camera:
            text = f"no depth, points or surface in metres: {NO_CAMERA.text}"
            notes.append(replace(NO_CAMERA, text=text))
    files = [file for file in FILES if file in wanted]
    in_metres = [file for file in files if needs_camera(file)]
    if in_metres and not pair.camera:
        raise StereoweaveError(f"{in_metres[0]}: {NO_CAMERA.text}", remedy=NO_CAMERA.remedy)
    if any(file.endswith((".ply", ".glb")) for file in files):
        needing_the_mesh_extra()
    return files, notes


@contextmanager
def _results_in(out: Path) -> Iterator[Path]:
    """A temporary folder, whose files move into `out` in the end; after an error nothing of either is left.

    Files of an earlier result that this one does not have are removed, so that all in `out` belong together.
    Where no disparity.pfm is there, which every result has and is moved first, they are the user's, and stay.
    """
    standing = make_parent_folder(*(out / file for file in FILES))
    with tempfile.TemporaryDirectory(prefix=".stereoweave-", dir=standing) as name:
        yield Path(name)
        # Two commands would leave some files of each.
        with lock_output(make_folder(out)):
            is_earlier_result = (out / "disparity.pfm").exists()
            for file in FILES:
                fresh = Path(name, file)
                if fresh.exists():
                    fresh.replace(out / file)
                elif is_earlier_result:
                    (out / file).unlink(missing_ok=True)


def write_files(folder: Path, files: Sequence[str], result: Result) -> list[Note]:
    """Write the files. Returns notes on those that could not be written or hold less, and why."""
    notes = []
    for file in files:
        try:
            FILES[file](folder / file, result)
            notes += _thinned(file, result)
        except RangeError:
            text = (
                "no disparity.png: it holds 0 to 255.99 px, found "
                f"{result.summary.disparity_min_px:.2f} to {result.summary.disparity_max_px:.2f} px"
            )
            notes.append(Note(text, Remedy("use disparity.pfm")))
        except EmptyError as nothing:
            notes.append(Note(f"no {file}: {nothing}"))
    return notes


def _thinned(file: str, result: Result) -> list[Note]:
    """A note if points or a surface leave out pixels of a large picture."""
    match file.split("."):
        case ["cloud", _]:
            step_px = result.cloud.step_px
        case ["mesh", _]:
            step_px = result.surface.step_px
        case _:
            step_px = 1
    if step_px == 1:
        return []
    return [Note(f"{file}: one of every {step_px}x{step_px} pixels, for at most {MOST_POINTS:,} points")]
