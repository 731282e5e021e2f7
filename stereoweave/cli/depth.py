"""The commands `stereoweave depth` and `stereoweave measure`."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stereoweave.cli.commands import running_command, running_options, shows_steps
from stereoweave.cli.options import (
    AsJson,
    BaselineM,
    Calib,
    FocalPx,
    Format,
    Fov,
    LensFov,
    Look,
    Model,
    Pictures,
    Projection,
    Provider,
    Range,
    Raw,
    Rectify,
    Refined,
    Threads,
    Whole,
    make_request,
    make_sphere_request,
    parse_pixel,
    parse_range_px,
)
from stereoweave.errors import StereoweaveError

if TYPE_CHECKING:
    from stereoweave.outputs.report import Summary
    from stereoweave.outputs.results import DepthJob

Write = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME",
        help="Additional file to write: disparity.npy, disparity.tiff, disparity_scaled.png or "
        "matched_left.png; in metres, if the camera is known, depth.pfm, depth.npy, depth.tiff, cloud.ply, "
        "cloud.glb, mesh.ply or mesh.glb; report.html (always "
        "written for a single pair); or all. Repeatable.",
    ),
]
PicturesOrFolder = Annotated[
    list[Path] | None,
    typer.Argument(
        metavar="PICTURE",
        help="LEFT RIGHT, two pictures of the same size; or one picture that holds both views; or a folder "
        "of pairs, recognised by names such as left/1.png, 1_L.jpg, im0.png, cam0/1.png or 1.mpo.",
    ),
]
Left = Annotated[
    str | None,
    typer.Option(metavar="GLOB", help="Quoted pattern for the left pictures, such as 'left/*.png'."),
]
Right = Annotated[
    str | None, typer.Option(metavar="GLOB", help="Quoted pattern for the right pictures, paired by name.")
]
Listed = Annotated[
    Path | None,
    typer.Option(
        "--list", help="Text file with a pair per line: left picture, right picture and, optionally, a name."
    ),
]
Jobs = Annotated[
    int | None,
    typer.Option(
        min=1,
        help="Number of pairs processed in parallel, with one thread each unless --threads is given "
        "(default: all cores).",
    ),
]
Out = Annotated[
    Path | None,
    typer.Option(
        "--out",
        "-o",
        help="Folder to write the results to (default: in the current folder, named after the left picture, "
        "the folder or the list, such as left_depth).",
    ),
]
FocalError = Annotated[float, typer.Option(min=0, help="Uncertainty of the focal length, in percent.")]
RectifyFirst = Annotated[
    bool,
    typer.Option("--rectify", help="Rectify the pair first, by its calibration or by matched features."),
]
BaselineError = Annotated[float, typer.Option(min=0, help="Uncertainty of the baseline, in percent.")]


@shows_steps
def depth(  # noqa: PLR0913 - each is an option of the command line
    pictures: PicturesOrFolder = None,
    out: Out = None,
    left: Left = None,
    right: Right = None,
    listed: Listed = None,
    jobs: Jobs = None,
    format: Format = None,
    calib: Calib = None,
    focal_px: FocalPx = None,
    baseline_m: BaselineM = None,
    rectify: Rectify = None,
    projection: Projection = None,
    look: Look = None,
    fov: Fov = None,
    lens_fov: LensFov = None,
    whole: Whole = False,
    range_px: Range = None,
    write: Write = None,
    refined: Refined = False,
    raw: Raw = False,
    model: Model = "best",
    threads: Threads = None,
    provider: Provider = "cpu",
    as_json: AsJson = False,
) -> None:
    """Estimate the depth of one or many stereo pairs. Writes maps, previews and an HTML report."""
    from stereoweave.matching.backend import Backend
    from stereoweave.matching.options import MatchOptions
    from stereoweave.outputs.results import DepthJob, make_depth
    from stereoweave.pictures.pair_finding import find_pairs

    job = DepthJob(
        request=make_request(
            format,
            calib,
            focal_px,
            baseline_m,
            rectify,
            make_sphere_request(projection, look, fov, lens_fov, whole),
        ),
        backend=Backend(model=model, threads=threads, provider=provider),
        options=MatchOptions(range_px=parse_range_px(range_px), refined=refined, raw=raw),
        files=tuple(write or ()),
        name_of=running_options(),
        command=running_command(),
    )
    pictures = pictures or []
    found = find_pairs(pictures, left, right, listed)
    out = out or _name_results(pictures, left, listed)
    if whole:
        _write_whole(pictures, out, job, many=bool(found), as_json=as_json)
        return
    if found:
        from stereoweave.batch.local import run_batch_command

        raise typer.Exit(run_batch_command(found, out, job, processes=jobs, as_json=as_json))
    made = make_depth(pictures, out, job)
    lines = [note.format(job.name_of) for note in made.all_notes]
    (_print_json if as_json else _print_summary)(made.summary, lines, out)


def _write_whole(pictures: Sequence[Path], out: Path, job: "DepthJob", *, many: bool, as_json: bool) -> None:
    """Write the distances over the whole field of view of one pair, and print a summary."""
    from stereoweave.outputs.sphere_depth import FILES, LEFT, make_sphere_depth

    if many:
        raise StereoweaveError("--whole: expected one pair, found several; process them one by one")
    facts, notes = make_sphere_depth(pictures, out, job)
    lines = [note.format(job.name_of) for note in notes]
    files = {file: str(out / file) for file in (*FILES, LEFT)}
    if as_json:
        typer.echo(json.dumps(asdict(facts) | {"notes": lines, "files": files}, indent=2, allow_nan=False))
        return
    near, far = (
        "infinity" if value is None else f"{value:.3g} {facts.unit}"
        for value in (facts.distance_p1, facts.distance_p99)
    )
    typer.echo(f"{' + '.join(facts.pictures)}: {facts.projection}, {facts.width_px}x{facts.height_px} px")
    typer.echo(f"distance {near} to {far} (the middle 98 % of the pixels)")
    typer.echo("\n".join([*lines, f"files: {', '.join(files)}"]))


def _name_results(pictures: Sequence[Path], left: str | None, listed: Path | None) -> Path:
    """Return the folder for the results if the user names none."""
    from stereoweave.pictures.pair_finding import find_root

    if pictures or listed:
        given = listed or pictures[0]
        # The name of "." is that of the current folder.
        name = given.absolute().resolve().name if given.is_dir() else given.stem
    else:
        name = find_root(left or "").name
    return Path(f"{name}_depth" if name else "depth")


@shows_steps
def measure(  # noqa: PLR0913 - each is an option of the command line
    pictures: Pictures,
    first: Annotated[
        str, typer.Option("--from", metavar="X,Y", help="First point: a pixel of the left picture.")
    ],
    second: Annotated[
        str, typer.Option("--to", metavar="X,Y", help="Second point: another pixel of the left picture.")
    ],
    format: Format = None,
    calib: Calib = None,
    focal_px: FocalPx = None,
    baseline_m: BaselineM = None,
    focal_error_percent: FocalError = 0.0,
    baseline_error_percent: BaselineError = 0.0,
    rectify: RectifyFirst = False,
    projection: Projection = None,
    look: Look = None,
    fov: Fov = None,
    lens_fov: LensFov = None,
    range_px: Range = None,
    refined: Refined = False,
    model: Model = "best",
    threads: Threads = None,
    provider: Provider = "cpu",
    as_json: AsJson = False,
) -> None:
    """Measure the distance in metres between two points.

    The points are pixels of the left picture or, with --rectify, of matched_left.png as depth --rectify
    writes it. Give the cropped pictures of rectify with their calib.yml. The uncertainty is reported too.
    """
    from stereoweave.cameras.diagnosis import find_problems
    from stereoweave.matching.backend import Backend
    from stereoweave.matching.estimate import match
    from stereoweave.matching.options import MatchOptions
    from stereoweave.outputs.measure import CameraError, check_places, distance
    from stereoweave.outputs.point_cloud import require_camera
    from stereoweave.pictures.prepare import prepare

    places = parse_pixel("--from", first), parse_pixel("--to", second)
    options = MatchOptions(range_px=parse_range_px(range_px), refined=refined)
    sphere = make_sphere_request(projection, look, fov, lens_fov)
    prepared = prepare(pictures, make_request(format, calib, focal_px, baseline_m, rectify, sphere))
    camera = require_camera(prepared.pair)
    check_places(prepared.pair.left.shape[1::-1], *places)
    matcher = Backend(model=model, threads=threads, provider=provider).matcher()
    estimate = match(matcher, prepared.pair, options)
    error = CameraError(focal=focal_error_percent / 100, baseline=baseline_error_percent / 100)
    problems = find_problems(prepared.pair, estimate, prepared.alignment, prepared.remedy)
    notes = [note.format(running_options()) for note in (*prepared.notes, *estimate.notes, *problems)]
    try:
        found = distance(estimate, camera, *places, camera_error=error)
    except StereoweaveError as failed:
        if not notes:
            raise
        raise failed.with_detail("; ".join(notes)) from failed
    if as_json:
        typer.echo(json.dumps(asdict(found) | {"notes": notes}, indent=2, allow_nan=False))
    else:
        typer.echo("\n".join([str(found), *notes]))


def _list_files(out: Path) -> dict[str, str]:
    from stereoweave.outputs.results import list_results

    return {file: str(out / file) for file in list_results(out)}


def _print_json(summary: "Summary", notes: list[str], out: Path) -> None:
    found = asdict(summary) | {"notes": notes, "files": _list_files(out)}
    typer.echo(json.dumps(found, indent=2, allow_nan=False))


def _print_summary(summary: "Summary", notes: list[str], out: Path) -> None:
    from stereoweave.outputs.metres import format_metres

    size = f"{summary.width_px}x{summary.height_px} px"
    matched = f"matched by the model {summary.model} in {summary.estimate_ms:.0f} ms"
    typer.echo(f"{' + '.join(summary.pictures)}: {size}, {matched}")
    ranges = [f"disparity {summary.disparity_p1_px:.1f} to {summary.disparity_p99_px:.1f} px"]
    if summary.camera and summary.depth_p1_m is None:
        ranges.append("depth infinite")
    elif summary.camera:
        ranges.append(f"depth {format_metres(summary.depth_p1_m)} to {format_metres(summary.depth_p99_m)}")
    typer.echo(f"{', '.join(ranges)} (the middle 98 % of the pixels)")
    for note in notes:
        typer.echo(note)
    typer.echo(f"files: {', '.join(_list_files(out))}")
    typer.echo(f"report: {out / 'report.html'}")
