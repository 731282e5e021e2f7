"""The commands `stereoweave check`, `rectify` and `calibrate`."""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated

import typer

from stereoweave.arguments import check_choice
from stereoweave.cli.commands import running_options, shows_steps
from stereoweave.cli.options import (
    AsJson,
    Calib,
    Format,
    Fov,
    LensFov,
    Look,
    Pictures,
    Projection,
    make_parent_folder,
    make_sphere_request,
    parse_two_counts,
)
from stereoweave.cli.video_check import is_video, print_video_check, refuse_video_options
from stereoweave.errors import FormatError, Note
from stereoweave.system.steps import step

Checked = Annotated[
    list[Path],
    typer.Argument(
        metavar="PICTURE",
        help="LEFT RIGHT, two pictures of the same size; one picture that holds both views; or a stereo "
        "video.",
    ),
]
CheckedFormat = Annotated[
    str | None,
    typer.Option(
        "--format",
        help="Layout of a picture that holds both views, or frame packing of a video, such as side_by_side "
        "or frame_sequential (default: detected). An unknown name lists them all.",
    ),
]
Film = Annotated[
    bool,
    typer.Option(
        "--film", help="Check a stereo video, shot by shot (default: if the file is recognised as a video)."
    ),
]
CheckedScreen = Annotated[
    str | None,
    typer.Option(
        "--screen",
        help="Screen that will show the video as it is: phone, television, headset or light_field. More "
        "depth than it shows without strain is then a problem; so are near objects that a border cuts off.",
    ),
]
Timeline = Annotated[
    Path | None,
    typer.Option(metavar="PICTURE", help="Picture to write of the video's depth and problems over time."),
]

# left.png and right.png alone may be the user's own pictures, so the first file marks an earlier result.
_RECTIFIED = ("rectified.json", "left.png", "right.png", "calib.yml")


@shows_steps
def check(  # noqa: PLR0913 - each is an option of the command line
    pictures: Checked,
    format: CheckedFormat = None,
    projection: Projection = None,
    look: Look = None,
    fov: Fov = None,
    lens_fov: LensFov = None,
    as_json: AsJson = False,
    film: Film = False,
    screen: CheckedScreen = None,
    timeline: Timeline = None,
) -> None:
    """Check a pair or a stereo video for problems.

    The checks cover rectification, swapped pictures, disparity range, exposure and, in a video, colour, empty
    eyes and near objects that a border cuts off, shot by shot. The exit status is 1 if there is a problem.
    """
    from stereoweave.cameras.alignment import check_pair
    from stereoweave.pictures.loading import FORMATS, open_pictures
    from stereoweave.video.packings import APART
    from stereoweave.video.reader import open_video

    if format is not None:
        check_choice("format", format, (*FORMATS, *sorted(APART)))
    sphere = make_sphere_request(projection, look, fov, lens_fov)
    try:
        opened = None if film or format in APART else open_pictures(pictures, format, sphere)
    except FormatError as error:
        if not is_video(error):
            raise
        opened = None
    if opened is None:
        video = open_video(pictures, format, sphere=sphere)
        print_video_check(video, pictures, screen, timeline, as_json)
        return
    refuse_video_options(screen, timeline)
    with step("checking the pair"):
        found = check_pair(opened.pair.left, opened.pair.right)
    lines = _advise_once(found.lines())
    notes = [note.format(running_options()) for note in (*opened.notes, *lines)]
    if as_json:
        facts = {name: _replace_nan(value) for name, value in asdict(found).items()}
        typer.echo(json.dumps(facts | {"notes": notes}, indent=2, allow_nan=False))
    else:
        typer.echo("\n".join(notes))
    if found.defects:
        raise typer.Exit(1)


def _advise_once(notes: Sequence[Note]) -> list[Note]:
    """Replace the advice of each note to rectify the pair by one line about the commands that do it."""
    from stereoweave.cameras.alignment import RECTIFY

    lines = [replace(note, remedy=None) if note.remedy == RECTIFY else note for note in notes]
    if lines != list(notes):
        text = "depth and view rectify such a pair by themselves; stereoweave rectify writes its pictures"
        lines.append(Note(text))
    return lines


def _replace_nan(value: object) -> object:
    """Replace NaN, which means unknown, with None, which JSON writes as null."""
    if isinstance(value, tuple):
        return [_replace_nan(part) for part in value]
    return None if isinstance(value, float) and math.isnan(value) else value


@shows_steps
def rectify(  # noqa: PLR0913 - each is an option of the command line
    pictures: Pictures,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            help="Folder to write left.png, right.png, rectified.json and, for a known camera, calib.yml to "
            "(default: in the current folder, named after the left picture, such as left_rectified).",
        ),
    ] = None,
    format: Format = None,
    calib: Calib = None,
    projection: Projection = None,
    look: Look = None,
    fov: Fov = None,
    lens_fov: LensFov = None,
) -> None:
    """Rectify a pair by its calibration or by matched features.

    Without --calib, features of the pictures are matched. The pictures are cropped to their common area.
    calib.yml is the calibration of the results, rectified.json names the sources.
    """
    from stereoweave.cameras.calibration_files import write_rig
    from stereoweave.cameras.content import crop
    from stereoweave.cameras.rig import format_size, pair_size_px, rectified_rig
    from stereoweave.io.files import refuse_inputs
    from stereoweave.io.images import write_image
    from stereoweave.io.results_folder import replacing_together
    from stereoweave.io.run_folder import describe_run
    from stereoweave.pictures.prepare import Request, prepare

    out = out or Path(f"{pictures[0].stem}_rectified")
    sources = [*pictures, *([calib] if calib else [])]
    refuse_inputs((out / name for name in _RECTIFIED), sources)
    make_parent_folder(*(out / name for name in _RECTIFIED))
    sphere = make_sphere_request(projection, look, fov, lens_fov)
    prepared = prepare(pictures, Request(format=format, calibration=calib, rectify=True, sphere=sphere))
    pair = crop(prepared.pair)
    notes = [note.format(running_options()) for note in prepared.notes]
    written = _RECTIFIED if pair.camera else _RECTIFIED[:-1]
    with replacing_together(out, _RECTIFIED, written, marks=_RECTIFIED[:1]) as folder:
        description = describe_run({"sources": sources, "notes": notes})
        (folder / "rectified.json").write_text(description, encoding="utf-8")
        write_image(folder / "left.png", pair.left)
        write_image(folder / "right.png", pair.right)
        if pair.camera:
            write_rig(folder / "calib.yml", rectified_rig(pair))
    typer.echo("\n".join([f"{out}: left.png and right.png, {format_size(pair_size_px(pair))} px", *notes]))


@shows_steps
def calibrate(  # noqa: PLR0913 - each is an option of the command line
    folder: Annotated[
        Path,
        typer.Argument(
            help="Folder with at least 5 pairs of pictures of a board, in the subfolders left and right or "
            "named left_01, right_01."
        ),
    ],
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Calibration file to write, in OpenCV's YAML format.")
    ],
    board: Annotated[
        str,
        typer.Option(
            metavar="COLUMNSxROWS",
            help="Inner corners of a chessboard, such as 9x6, or squares of a ChArUco board.",
        ),
    ],
    square_mm: Annotated[
        float, typer.Option(help="Side of a square in millimetres, measured on the printed board.")
    ],
    charuco: Annotated[
        str | None,
        typer.Option(metavar="DICT", help="Marker dictionary of a ChArUco board, such as DICT_5X5_100."),
    ] = None,
    marker_mm: Annotated[
        float | None, typer.Option(help="Side of a ChArUco board's marker in millimetres.")
    ] = None,
    fisheye: Annotated[bool, typer.Option("--fisheye", help="Calibrate fisheye lenses.")] = False,
) -> None:
    """Calibrate two cameras from pictures of a board. Reports how accurate the result is."""
    from stereoweave.cameras.boards import Board
    from stereoweave.cameras.calibrate import calibrate as calibrate_by
    from stereoweave.cameras.calibration_files import check_rig_name, write_rig

    check_rig_name(out)
    columns, rows = parse_two_counts("--board", board, "columns and rows, such as 9x6")
    expected = Board(
        columns=columns,
        rows=rows,
        square_m=square_mm / 1000,
        marker_m=None if marker_mm is None else marker_mm / 1000,
        dictionary=charuco,
    )
    make_parent_folder(out)
    found = calibrate_by(folder, expected, fisheye=fisheye)
    write_rig(out, found.rig)
    typer.echo("\n".join([f"{out}: the calibration of {found.rig.name}", *found.lines()]))
