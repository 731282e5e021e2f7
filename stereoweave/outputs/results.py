"""Output files of the `depth` command: maps, masks, previews, point clouds, meshes and the report.

Disparity and depth are unknown outside the left image's content (`StereoPair.left_seen`). Unknown values are
stored as infinity in PFM (as in Middlebury), as NaN in NPY and TIFF, and as 0 in PNG. Infinite depth is
stored as infinity in PFM, NPY and TIFF, and as 0 in PNG.
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from stereoweave import __version__
from stereoweave.arguments import check_choice
from stereoweave.cameras.calibration_files import read_calibration_bytes
from stereoweave.cameras.spherical import SphereRequest
from stereoweave.errors import NameOf, Note, StereoweaveError, keyword
from stereoweave.io.colormap import colour_disparity, find_colour_range_px, grey_confidence
from stereoweave.io.files import reading, refuse_inputs
from stereoweave.io.images import write_image
from stereoweave.io.maps import (
    RangeError,
    format_scale,
    write_depth_png,
    write_disparity_png,
    write_float_tiff,
    write_npy,
    write_pfm,
    write_scaled_disparity_png,
)
from stereoweave.io.results_folder import find_result, replacing_together
from stereoweave.matching.backend import Backend
from stereoweave.matching.options import MatchOptions
from stereoweave.outputs.point_cloud import (
    MOST_POINTS,
    NO_CAMERA,
    EmptyError,
    require_mesh_extra,
    write_glb,
    write_ply,
)
from stereoweave.outputs.report import Context, Summary, write_report
from stereoweave.outputs.report_parts import CONTENTS
from stereoweave.outputs.run import Result, run
from stereoweave.pictures.prepare import Prepared, Request, prepare
from stereoweave.rendering.rehearsals import rehearse_drawing, rehearse_filling
from stereoweave.system.compiling_ahead import compile_ahead
from stereoweave.system.steps import step


def _write_preview(path: Path, result: Result) -> None:
    disparity_px = result.estimate.disparity_px
    range_px = find_colour_range_px(disparity_px[result.seen][None])
    write_image(path, colour_disparity(disparity_px, range_px) * result.seen[..., None])


def _write_report(path: Path, result: Result) -> None:
    context = Context(
        warnings=tuple(note.format(result.name_of) for note in result.warnings()),
        notes=tuple(note.format(result.name_of) for note in result.notes),
        command=result.command,
        date=result.date,
        files=tuple(file for file in map(path.with_name, CONTENTS) if file.exists()),
        threads=result.threads,
    )
    write_report(path, result.pair, result.estimate, result.summary, context)


# All output files of `depth`; the report is last, because it lists the others.
FILES: dict[str, Callable[[Path, Result], None]] = {
    "disparity.pfm": lambda path, result: write_pfm(path, result.disparity_px(np.inf)),
    "disparity.png": lambda path, result: write_disparity_png(path, result.disparity_px()),
    "disparity_scaled.png": lambda path, result: write_scaled_disparity_png(path, result.disparity_px()),
    "disparity.npy": lambda path, result: write_npy(path, result.disparity_px()),
    "disparity.tiff": lambda path, result: write_float_tiff(path, result.disparity_px()),
    "depth.png": lambda path, result: write_depth_png(path, result.depth_m()),
    "depth.pfm": lambda path, result: write_pfm(path, result.depth_m(np.inf)),
    "depth.npy": lambda path, result: write_npy(path, result.depth_m()),
    "depth.tiff": lambda path, result: write_float_tiff(path, result.depth_m()),
    "preview.png": _write_preview,
    "confidence.png": lambda path, result: write_image(path, grey_confidence(result.estimate.confidence)),
    "occluded.png": lambda path, result: write_image(path, np.uint8(255) * result.estimate.occluded),
    "matched_left.png": lambda path, result: write_image(path, result.pair.left),
    "cloud.ply": lambda path, result: write_ply(path, result.point_cloud),
    "cloud.glb": lambda path, result: write_glb(path, result.point_cloud),
    "mesh.ply": lambda path, result: write_ply(path, result.mesh),
    "mesh.glb": lambda path, result: write_glb(path, result.mesh),
    "report.html": _write_report,
}
ALWAYS = ("disparity.pfm", "disparity.png", "preview.png", "confidence.png", "occluded.png", "report.html")
# By themselves, disparity.pfm and some of the others may be a user's ground truth.
_MARKS = ("disparity.pfm", "confidence.png", "occluded.png")
ALL = "all"
REPORT = "report.html"
SCALED = "disparity_scaled.png"
# It is not called left.png, because the user's own pictures often are, and may lie in the same folder.
LEFT = "matched_left.png"


@dataclass(frozen=True, kw_only=True)
class DepthJob:
    """Settings of the `depth` command, which are the same for every pair.

    Attributes:
        request: Settings for opening and rectifying the pictures.
        backend: The matcher and the hardware that runs it.
        options: Matching settings.
        files: Output files besides `always`: names in FILES, or "all". depth.png is added if the camera is
            known, and matched_left.png if the maps fit no picture of the user's.
        always: Output files written for every pair.
        name_of: The front end's names for settings, for the notes and errors that a batch records.
        command: The command as typed, for the reports.
    """

    request: Request = Request()
    backend: Backend = Backend()
    options: MatchOptions = MatchOptions()
    files: tuple[str, ...] = ()
    always: tuple[str, ...] = ALWAYS
    name_of: NameOf = keyword
    command: str = ""

    def __post_init__(self) -> None:
        for file in self.files:
            check_choice("files", file, (ALL, *FILES))


class DepthOutcome(NamedTuple):
    """Summary of a pair's results, notes on its pictures and files, and warnings of its likely defects."""

    summary: Summary
    notes: list[Note]
    warnings: list[Note]

    @property
    def all_notes(self) -> list[Note]:
        """The notes, and then the warnings."""
        return [*self.notes, *self.warnings]


def make_depth(pictures: Sequence[Path], out: Path, job: DepthJob, *, owns_out: bool = False) -> DepthOutcome:
    """Write all the results for a pair to `out` atomically.

    Files in `out` that are not of an earlier result are replaced only with `owns_out`, for a folder that no
    one else writes to. Otherwise, they are an error, and so is an output that would replace a picture.
    """
    matcher = job.backend.matcher()
    prepared = prepare(pictures, job.request)
    files, left_out = _choose_files(job, prepared)
    if REPORT in files:
        compile_ahead(rehearse_drawing, rehearse_filling)
    if not owns_out:
        refuse_inputs((out / file for file in FILES), pictures)
    possible = [*files, SCALED] if "disparity.png" in files else files
    with replacing_together(out, tuple(FILES), possible, () if owns_out else _MARKS) as folder:
        result = run(prepared, matcher, job.options)
        result = replace(result, command=job.command, name_of=job.name_of)
        notes = [*result.notes, *left_out, *write_files(folder, files, result)]
        return DepthOutcome(result.summary, notes, result.warnings())


def list_results(out: Path) -> list[str]:
    """Return the names of the files of the result that `make_depth` wrote to `out`."""
    found = find_result(out, tuple(FILES), _MARKS)
    return [file for file in FILES if file in found]


def job_facts(job: DepthJob) -> dict[str, Any]:
    """Return everything that determines a pair's results, except the pictures; files are given as hashes.

    The provider and the number of threads are left out, so that a batch whose GPU fails can be finished on
    the CPU.
    """
    model, calibration = str(job.backend.model), job.request.calibration
    if model.endswith(".onnx"):
        with reading(model, "a model"):
            model = _hash_content(model, Path(model).read_bytes())
    facts = {"stereoweave": __version__, "model": model, **asdict(job.options)}
    request = asdict(job.request)
    # Batches of earlier versions have no such setting.
    if request.pop("sphere") != asdict(SphereRequest()):
        facts["sphere"] = asdict(job.request.sphere)
    # In the stored descriptions of earlier batches, the format is called "arrangement".
    facts |= {"files": job.files, "always": job.always, "arrangement": request.pop("format"), **request}
    if calibration:
        facts["calibration"] = _hash_content(calibration, read_calibration_bytes(calibration))
    return facts


def _hash_content(path: str | Path, content: bytes) -> str:
    return f"{Path(path).name} {hashlib.sha256(content).hexdigest()[:12]}"


def needs_camera(file: str) -> bool:
    """Return whether an output file is in metres, which requires a camera."""
    return file.startswith(("depth.", "cloud.", "mesh."))


def _choose_files(job: DepthJob, prepared: Prepared) -> tuple[list[str], list[Note]]:
    """Return a pair's output files, and notes on the files that are left out.

    Raises:
        StereoweaveError: A file needs a camera but the pair has none, or trimesh is missing.
    """
    pair, wanted, notes = prepared.pair, {*job.always, *job.files}, list[Note]()
    if prepared.is_new:
        wanted.add(LEFT)
    if pair.camera:
        wanted.add("depth.png")
    if ALL in wanted:
        wanted |= {file for file in FILES if pair.camera or not needs_camera(file)}
        if not pair.camera:
            text = f"no depth, point cloud or mesh: {NO_CAMERA.text}"
            notes.append(replace(NO_CAMERA, text=text))
    files = [file for file in FILES if file in wanted]
    in_metres = [file for file in files if needs_camera(file)]
    if in_metres and not pair.camera:
        raise StereoweaveError(f"{in_metres[0]}: {NO_CAMERA.text}", remedy=NO_CAMERA.remedy)
    if any(file.endswith((".ply", ".glb")) for file in files):
        require_mesh_extra()
    return files, notes


@step("writing the files")
def write_files(folder: Path, files: Sequence[str], result: Result) -> list[Note]:
    """Write the given output files of a result. Returns a note for each file that is skipped or thinned."""
    notes = []
    for file in files:
        try:
            FILES[file](folder / file, result)
            notes += _note_thinning(file, result)
        except RangeError:
            FILES[SCALED](folder / SCALED, result)
            notes.append(_note_scaled(result.summary))
        except EmptyError as nothing:
            notes.append(Note(f"no {file}: {nothing}"))
    return notes


def _note_scaled(summary: Summary) -> Note:
    low_px, high_px = summary.disparity_min_px, summary.disparity_max_px
    assert summary.disparity_scale_px is not None and summary.disparity_offset_px is not None
    formula = format_scale(summary.disparity_scale_px, summary.disparity_offset_px)
    return Note(
        f"no disparity.png: expected disparities of 0 to 255.99 px, found {low_px:.2f} to {high_px:.2f} px; "
        f"{SCALED} was written in its place, with px = {formula}"
    )


def _note_thinning(file: str, result: Result) -> list[Note]:
    """Return a note if a large picture's point cloud or mesh is thinned."""
    match file.split("."):
        case ["cloud", _]:
            step_px = result.point_cloud.step_px
        case ["mesh", _]:
            step_px = result.mesh.step_px
        case _:
            step_px = 1
    if step_px == 1:
        return []
    return [
        Note(
            f"{file}: thinned to one point per {step_px}x{step_px} pixels, for at most {MOST_POINTS:,} points"
        )
    ]
