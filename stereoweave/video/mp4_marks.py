"""Marks in an MP4 or MOV file by which players and headsets recognise 3-D, panoramas and their cameras.

`st3d` and `sv3d` follow Google's Spherical Video V2 RFC, `vexu` and `hfov` Apple's "QuickTime and ISO Base
Media File Formats and Spatial and Immersive Media". PyAV cannot set them, so they are inserted in the sample
descriptions (ISO/IEC 14496-12) of a finished file.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from stereoweave.errors import FormatError, StereoweaveError
from stereoweave.io.boxes import Box, Place, change_boxes, find_boxes, make_box, make_full_box, split_boxes

# stereo_mode of `st3d`, without and with the right view first; None where the RFC has no number. Then the
# packing kind of `pkin`.
_PACKINGS: dict[str | None, tuple[int, int | None, bytes]] = {
    None: (0, 0, b""),
    "side_by_side": (2, 4, b"side"),
    "top_bottom": (1, None, b"over"),
}
_PROJECTIONS = {
    "rectilinear": b"rect",
    "equirectangular": b"equi",
    "half_equirectangular": b"hequ",
    "fisheye": b"fish",
}
# Horizontal and vertical angle of a whole picture, in degrees.
_COVERED_DEG = {"equirectangular": (360.0, 180.0), "half_equirectangular": (180.0, 180.0)}
MOST_BASELINE_M = 1000.0
"""Greatest distance of cameras that is believed, and written."""
_MOST_DEG = 360.0

_SOURCE = b"Stereoweave\0"
_HAS_LEFT, _HAS_RIGHT, _RIGHT_FIRST = 1, 2, 8
_LEFT_IS_HERO = 1

_MARKS = frozenset({b"st3d", b"sv3d", b"vexu", b"hfov"})
# Boxes of a sample description that the RFC wants after `st3d` and `sv3d`.
_OPTIONAL = frozenset({b"clap", b"pasp", b"colr", b"fiel", b"btrt", b"chrm", b"gama", b"clli", b"mdcv"})
# Bytes of a visual sample description, and of `stsd`, before their boxes.
_ENTRY_BYTES, _STSD_BYTES = 78, 8
_TABLE = b"mdia", b"minf", b"stbl"
# The index of ten hours at 60 frames a second with sound has about 60 MB.
_MOST_INDEX_BYTES = 500_000_000
_MOST_BOXES = 100_000  # on the top level of a file


@dataclass(frozen=True, kw_only=True)
class VideoMarks:
    """What a video file says about its views and cameras.

    Attributes:
        packing: How a frame holds both views: side_by_side, also at half width, or top_bottom, also at half
            height; None for a single view.
        right_first: Whether the right view is on the left, or on top.
        projection: rectilinear, equirectangular, half_equirectangular (VR180) or fisheye.
        field_of_view_deg: Horizontal angle of one view; None if unknown, or the whole 360 or 180 degrees of
            an equirectangular picture.
        vertical_field_of_view_deg: Vertical angle of an equirectangular view; None for 180 degrees.
        baseline_m: Distance of the cameras; None if unknown.
    """

    packing: str | None = None
    right_first: bool = False
    projection: str = "rectilinear"
    field_of_view_deg: float | None = None
    vertical_field_of_view_deg: float | None = None
    baseline_m: float | None = None

    def __post_init__(self) -> None:
        for name, value, known in (
            ("packing", self.packing, _PACKINGS),
            ("projection", self.projection, _PROJECTIONS),
        ):
            if value not in known:
                choices = ", ".join(map(str, known))
                raise StereoweaveError(f"{name}: expected one of {choices}, found {value!r}")
        whole_deg = _COVERED_DEG.get(self.projection, (_MOST_DEG, 0.0))
        for name, number, most in (
            ("field_of_view_deg", self.field_of_view_deg, whole_deg[0]),
            ("vertical_field_of_view_deg", self.vertical_field_of_view_deg, whole_deg[1]),
            ("baseline_m", self.baseline_m, MOST_BASELINE_M),
        ):
            if number is not None and not 0 < number <= most:
                raise StereoweaveError(f"{name}: expected above 0 and at most {most:g}, found {number}")

    @property
    def is_panorama(self) -> bool:
        """Whether the views cover a sphere, or a part of it, equirectangularly."""
        return self.projection in _COVERED_DEG


def write_marks(path: Path, marks: VideoMarks) -> None:
    """Write the marks into the first video track of a finished MP4 or MOV file; earlier marks are replaced.

    Pictures, sound and times stay as they are. The file is changed in place, so that nobody else should read
    it yet.

    Raises:
        FormatError: The file is damaged, has no index or one that is not its last box, no video track or
            several of them, or consists of fragments.
    """
    try:
        with path.open("r+b") as file:
            places = list(find_boxes(file, _MOST_BOXES))
            index = _find_index(places)
            file.seek(index.start)
            new = mark_index(file.read(), marks)
            file.seek(index.start)
            file.write(new)
            file.truncate()
    except FormatError as error:
        raise error.with_prefix(f"{path}: ") from error
    except OSError as error:
        raise StereoweaveError(
            f"{path}: expected a file that can be changed, found {error.strerror}"
        ) from error


def show_bounds(marks: VideoMarks) -> VideoMarks:
    """Return the marks of a panorama with the bounds of its picture in place of Apple's name for them.

    FFmpeg writes a projection to Matroska only with bounds.
    """
    width_deg, height_deg = _find_covered_deg(marks)
    return replace(
        marks,
        projection="equirectangular",
        field_of_view_deg=width_deg,
        vertical_field_of_view_deg=height_deg,
    )


def mark_index(index: bytes, marks: VideoMarks) -> bytes:
    """Return the box `moov` with the marks in its video track.

    Args:
        index: The whole box.
        marks: What to mark; marks that are there already are replaced.

    Raises:
        FormatError: The box is damaged, or has no video track or several.
    """
    if index[:4] == bytes(4):  # up to the end of the file
        index = struct.pack(">I", len(index)) + index[4:]
    [moov, *rest] = split_boxes(index) or [Box(b"", b"", b"")]
    if moov.kind != b"moov" or rest:
        raise FormatError("expected an index (moov), found a damaged one; write the file again")
    count = sum(_is_video(box.content) for box in split_boxes(moov.content) if box.kind == b"trak")
    if count != 1:
        raise FormatError(
            f"expected an index with one video track, found {count or 'none'}; "
            "write the file again with one video track"
        )
    boxes = make_boxes(marks)
    return make_box(b"moov", change_boxes(moov.content, (b"trak",), lambda track: _mark_track(track, boxes)))


def make_boxes(marks: VideoMarks) -> tuple[bytes, bytes]:
    """Return the boxes for a sample description: `st3d` and `sv3d`, and `vexu` and `hfov`."""
    mode, swapped_mode, packing = _PACKINGS[marks.packing]
    google = b""
    stereo_mode = swapped_mode if marks.right_first else mode
    if stereo_mode is not None and (marks.packing or marks.is_panorama):
        google += make_full_box(b"st3d", bytes([stereo_mode]))
    if marks.is_panorama:
        google += _make_sv3d(marks)
    parts = []
    # A part of a sphere is neither the whole nor the half one that Apple's names mean.
    is_part = marks.is_panorama and _find_covered_deg(marks) != _COVERED_DEG[marks.projection]
    if marks.projection != "rectilinear" and not is_part:
        kind = make_full_box(b"prji", _PROJECTIONS[marks.projection])
        parts.append(make_box(b"proj", kind))
    if marks.packing:
        parts.append(_make_eyes(marks))
        parts.append(make_box(b"pack", make_full_box(b"pkin", packing)))
    apple = make_box(b"vexu", b"".join(parts)) if parts else b""
    degrees = marks.field_of_view_deg or _COVERED_DEG.get(marks.projection, (0.0, 0.0))[0]
    if degrees:
        apple += make_box(b"hfov", struct.pack(">I", round(1000 * degrees)))
    return google, apple


def _make_eyes(marks: VideoMarks) -> bytes:
    views = _HAS_LEFT | _HAS_RIGHT | (_RIGHT_FIRST if marks.right_first else 0)
    parts = make_full_box(b"stri", bytes([views])) + make_full_box(b"hero", bytes([_LEFT_IS_HERO]))
    if marks.baseline_m:
        parts += make_box(b"cams", make_full_box(b"blin", struct.pack(">I", round(1e6 * marks.baseline_m))))
    return make_box(b"eyes", parts)


def _find_covered_deg(marks: VideoMarks) -> tuple[float, float]:
    """Return the angles of an equirectangular view."""
    width_deg, height_deg = _COVERED_DEG[marks.projection]
    return marks.field_of_view_deg or width_deg, marks.vertical_field_of_view_deg or height_deg


def _make_sv3d(marks: VideoMarks) -> bytes:
    width_deg, height_deg = _find_covered_deg(marks)
    # What is missing at each side, as a share of the sphere in 0.32 bits.
    across, down = (round((1 - share) / 2 * (1 << 32)) for share in (width_deg / 360, height_deg / 180))
    bounds = make_full_box(b"equi", struct.pack(">4I", down, down, across, across))
    pose = make_full_box(b"prhd", bytes(12))
    return make_box(b"sv3d", make_full_box(b"svhd", _SOURCE) + make_box(b"proj", pose + bounds))


def _mark_track(track: bytes, boxes: tuple[bytes, bytes]) -> bytes:
    if not _is_video(track):
        return track
    return change_boxes(
        track, (*_TABLE, b"stsd"), lambda table: _mark_descriptions(table, boxes), needed=True
    )


def _mark_descriptions(table: bytes, boxes: tuple[bytes, bytes]) -> bytes:
    """Return the content of `stsd` with boxes in each sample description."""
    entries = [box for box in split_boxes(table[_STSD_BYTES:]) if box.kind]
    if not entries or len(entries) != int.from_bytes(table[4:_STSD_BYTES]):
        raise FormatError(
            "expected a sample description in the index, found a damaged one; write the file again"
        )
    return table[:_STSD_BYTES] + b"".join(
        make_box(box.kind, _mark_entry(box.content, boxes)) for box in entries
    )


def _mark_entry(entry: bytes, boxes: tuple[bytes, bytes]) -> bytes:
    if len(entry) < _ENTRY_BYTES:
        raise FormatError("expected a sample description of video, found one cut off; write the file again")
    google, apple = boxes
    kept = [box for box in split_boxes(entry[_ENTRY_BYTES:]) if box.kind not in _MARKS]
    # QuickTime may end the description with four zeros, which are no box.
    first = next((at for at, box in enumerate(kept) if box.kind in _OPTIONAL or not box.kind), len(kept))
    last = len(kept) - 1 if kept and not kept[-1].kind else len(kept)
    parts = [box.whole for box in kept]
    return entry[:_ENTRY_BYTES] + b"".join([*parts[:first], google, *parts[first:last], apple, *parts[last:]])


def _is_video(track: bytes) -> bool:
    media = [box.content for box in split_boxes(track) if box.kind == b"mdia"]
    return any(
        box.kind == b"hdlr" and box.content[8:12] == b"vide" for boxes in media for box in split_boxes(boxes)
    )


def _find_index(places: Sequence[Place]) -> Place:
    kinds = {place.kind for place in places}
    if b"moof" in kinds:
        raise FormatError(
            "expected a file with one index, found fragments (moof); write it without fragments"
        )
    found = [place for place in places if place.kind == b"moov"]
    if len(found) != 1:
        raise FormatError(f"expected one index (moov), found {len(found) or 'none'}; write the file again")
    if found[0] is not places[-1]:
        # The tables of an index count from the start of the file, so media data must not move.
        raise FormatError(
            "expected the index (moov) at the end, found it before other boxes; write the file again"
        )
    size_bytes = found[0].end - found[0].start
    if size_bytes > _MOST_INDEX_BYTES:
        raise FormatError(
            f"expected an index of at most {_MOST_INDEX_BYTES // 1_000_000} MB, found "
            f"{size_bytes // 1_000_000} MB; write the file again"
        )
    return found[0]
