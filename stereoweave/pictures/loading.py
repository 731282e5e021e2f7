"""Opening of stereo pictures: two files, or one file with both views, in any layout or as an animation."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from stereoweave.arguments import check_choice
from stereoweave.cameras.spherical import Projection, SphereRequest
from stereoweave.errors import FormatError, Note, Remedy, StereoweaveError
from stereoweave.io import exif, heif, lif, vr180
from stereoweave.io.decoding import (
    DecodedPicture,
    check_size,
    decode,
    decode_embedded,
    find_view_frames,
    holds_depth,
    measure_embedded,
    open_picture,
    read_frame,
    read_picture,
)
from stereoweave.io.images import check_large_enough, make_pair
from stereoweave.pictures import panoramas
from stereoweave.pictures.interleaved import InterleavedLayout
from stereoweave.pictures.pair_layouts import (
    PAIR_LAYOUTS,
    PairLayout,
    detect_layout,
    measure_resemblance,
)
from stereoweave.stereo import StereoPair
from stereoweave.system.steps import step

# Layouts of one file with both views: the layout of one picture, or a file format with two pictures.
FORMATS = (*PAIR_LAYOUTS, "mpo", "jps")
TWO_PICTURES = "two_pictures"
_OVERRIDE = Remedy("override it if it is wrong", ("format",))

# Output layouts of `rendering.layouts` other than two views, whose halves may nevertheless resemble each
# other.
_OTHER_LAYOUTS = {"a quilt of many views": r"_qs\d+x\d+a[\d.]+$", "a picture and its depth": r"_RGBD$"}

_JPS_MARK, _JPS_STEREO, _JPS_INTERLEAVED, _JPS_BESIDE, _JPS_ABOVE = b"_JPSJPS_", 1, 1, 2, 3
_JPS_HALF_HEIGHT, _JPS_HALF_WIDTH, _JPS_LEFT_FIRST = 1, 2, 4
_CROSSED_ENDINGS = (".jps", ".pns")


@dataclass(frozen=True, kw_only=True)
class Opened:
    """A pair before rectification, as the cameras took it.

    Attributes:
        pair: Both views, upright and in sRGB.
        layout: Layout of the files, which is a name in `PAIR_LAYOUTS`, "mpo" or "two_pictures" (also for a
            HEIC or LIF file with two views and an animation of two frames).
        notes: Notes on what was detected or changed.
        turned_alike: Whether both of two pictures are turned by the EXIF orientation of one, although the
            other has none or another.
        lens: Camera parameters from the metadata, in pixels of the pair; None if there are none.
        projection: Projection of both images; None for ordinary ones.
        sphere: Of a VR180 or 360-degree picture, the window of it that the pair shows.
    """

    pair: StereoPair
    layout: str
    notes: tuple[Note, ...] = ()
    turned_alike: bool = False
    lens: exif.Lens | None = None
    projection: Projection | None = None
    sphere: panoramas.SphereView | None = None


@step("opening the pictures")
def open_pictures(
    paths: Sequence[Path], format: str | None = None, sphere: SphereRequest | None = None
) -> Opened:
    """Open the pair in two pictures, left first, or in one file with both views.

    Of VR180 and 360-degree pictures, the pair is a window of both eyes' images.

    Args:
        paths: One or two files.
        format: Layout of one file with both views, a name in `FORMATS`. Default: detected from the file
            format, the file name and the content, in this order.
        sphere: Projection of the pictures, and the window to show. Default: detected, straight ahead.

    Raises:
        FormatError: A file is unreadable, is too large, has an unsupported format (named in the error) or
            lacks a second view; or the two pictures differ in size.
        StereoweaveError: The layout is unknown or given for two files, or the number of files is neither one
            nor two.
    """
    if format is not None:
        check_choice("format", format, FORMATS)
    sphere = sphere or SphereRequest()
    match paths:
        case [left, right]:
            if format is not None:
                raise StereoweaveError(
                    f"expected one picture that holds both views, found two, {left} and {right}; "
                    "omit this setting, and give the left picture first",
                    setting="format",
                )
            panorama = sphere.projection is not None
            return _show_window(str(left), open_two(left, right, panorama=panorama), sphere)
        case [both]:
            return _show_window(str(both), _open_one(both, format, sphere), sphere)
    names = " ".join(map(str, paths))
    raise StereoweaveError(
        f"expected two pictures, left and right, or one that holds both views, found {len(paths)}: {names}",
        remedy=_advise_on_count(paths),
    )


def _advise_on_count(paths: Sequence[Path]) -> Remedy | None:
    """Return the remedy for another number of pictures than one or two."""
    for first, second in pairwise(map(str, paths)):
        # A shell splits an unquoted name at its spaces.
        if Path(f"{first} {second}").is_file():
            return Remedy(f"put quotes around a name with spaces: '{first} {second}'")
    return Remedy("if one of them is the output, name it as such", ("out",)) if paths else None


def pixel_factor(path: Path, picture: Image.Image, format: str | None) -> int:
    """Return the ratio, 1 or 2, of the number of pixels in both views to the number in the file's header.

    It is 2 for MPO and HEIC files with two views, for animations of two frames, and for half-size views
    declared by `format` or by the file's JPS header. Of other files, see `measure_embedded_views` first.
    """
    if _find_frames(path, picture, format):
        return 2
    known = PAIR_LAYOUTS.get(_read_declared(path, picture, format)[0] or "")
    return 2 if known is not None and known.half else 1


def measure_embedded_views(path: Path, picture: Image.Image, format: str | None) -> list[tuple[int, int]]:
    """Return the widths and heights of both views of a LIF file or VR180 photo; empty for other files.

    The size of a view that is embedded in the file of an open picture may be any, whatever the picture's.

    Raises:
        FormatError: The embedded view is missing, is too large for any use, or is no picture.
    """
    if format is not None:
        return []
    right_px = panoramas.measure_right_eye(path, picture, vr180.read_xmp(picture))
    if right_px:
        return [picture.size, right_px]
    views = lif.read_lif(path)
    return [
        picture.size if view.picture is None else measure_embedded(_name_view(path, side), view.picture)
        for side, view in (views.by_side.items() if views else ())
    ]


def _name_view(path: Path, side: str) -> str:
    return f"{path}, {side} view"


def _find_frames(path: Path, picture: Image.Image, format: str | None) -> list[int]:
    """Return the frames that hold the two views; empty if one frame holds both, as far as `format` tells."""
    if picture.format in ("MPO", heif.FORMAT) and format not in (None, "mpo"):
        return []
    return find_view_frames(path, picture)


def _show_window(name: str, opened: Opened, sphere: SphereRequest) -> Opened:
    """Return what is to be shown of a VR180 or 360-degree picture; other pictures are returned unchanged."""
    eye_size_px = opened.pair.left.shape[1], opened.pair.left.shape[0]
    by_name = opened.projection is None and sphere.projection is None
    guessed = panoramas.guess_projection(name, eye_size_px) if by_name else opened.projection
    projection = sphere.choose(name, guessed)
    if projection is None:
        return opened
    view = panoramas.SphereView.chosen(projection, eye_size_px, sphere)
    why = ", detected from the name" if by_name else ""
    baseline_m = opened.lens.baseline_m if opened.lens else None
    return replace(
        opened,
        pair=panoramas.cut_pair(opened.pair, view),
        notes=(*opened.notes, view.note(sphere, why)),
        lens=exif.Lens(focal_px=view.window.focal_px, baseline_m=baseline_m, parallel=True),
        projection=projection,
        sphere=view,
    )


def open_two(left: Path, right: Path, *, panorama: bool) -> Opened:
    """Open two pictures whole, also those of a `panorama`. Raises FormatError, as `open_pictures` does."""
    decoded = [read_picture(path, panorama=panorama) for path in (left, right)]
    lies, notes = _choose_orientations(*decoded)
    eyes = [each.upright(lie) for each, lie in zip(decoded, lies, strict=True)]
    own = tuple(exif.read_orientation(each.tags) for each in decoded)
    return Opened(
        pair=make_pair(left, eyes[0], right, eyes[1]),
        layout=TWO_PICTURES,
        notes=(*notes, *_note_colours(decoded)),
        turned_alike=lies != own,
        lens=_read_lens(decoded),
    )


def _open_one(path: Path, format: str | None, sphere: SphereRequest) -> Opened:
    with open_picture(path, views=2) as picture:
        xmp = vr180.read_xmp(picture)
        right_eye = None if format else panoramas.read_right_eye(path, picture, xmp)
        if right_eye:
            return _open_vr180(path, (decode(path, picture), right_eye), xmp, sphere)
        views = lif.read_lif(path) if format is None else None
        if views:
            return _open_lif(path, picture, views)
        frames = _find_frames(path, picture, format)
        if frames and picture.format == "MPO":
            return _open_mpo(path, picture, frames)
        if frames and picture.format == heif.FORMAT:
            return _open_heif(path, picture, frames)
        if frames:
            return _open_animation(path, picture, frames, format)
        if format == "mpo":
            raise FormatError(
                f"{path}: expected an MPO file with two pictures of the same size, found only one"
            )
        name, why = _read_declared(path, picture, format)
        decoded, has_depth = decode(path, picture), holds_depth(picture)
    lies = exif.read_orientation(decoded.tags)
    image = decoded.upright(lies)
    if name is None:
        name = _detect_picture_layout(path, image, has_depth=has_depth)
        why = "detected"
    if not format or sphere.projection is not None:
        named = None if vr180.is_panorama(xmp) else str(path)
        name = panoramas.choose_layout(name, named, (image.shape[1], image.shape[0]), sphere)
    notes = [Note(f"{name}, {why}", _OVERRIDE)] if why else []
    layout = PAIR_LAYOUTS[name]
    left, right = _split_views(path, image, layout)
    height_px, width_px = left.shape[:2]
    return Opened(
        pair=StereoPair(left=left, right=right),
        layout=name,
        notes=(
            *notes,
            *layout.note_odd_size(image.shape[1], image.shape[0]),
            *_note_turns(lies),
            *_note_colours([decoded]),
        ),
        lens=exif.read_lens(decoded.tags, width_px, height_px, stored_width_px=decoded.image.width),
        projection=_read_projection(path, xmp, (width_px, height_px), sphere),
    )


def _read_projection(
    path: Path, xmp: bytes, eye_size_px: tuple[int, int], sphere: SphereRequest, *, one_eye: bool = False
) -> Projection | None:
    """Return the projection that XMP states, unless it is damaged and the user gives one.

    Of a picture with both views, GPano may describe one of them or both together, so only the shape counts.
    """
    if not vr180.is_panorama(xmp):
        return None
    try:
        if one_eye:
            return panoramas.read_projection(path, xmp, eye_size_px)
        return panoramas.find_by_aspect(path, eye_size_px)
    except FormatError:
        if sphere.projection is None:
            raise
        return None


def _open_vr180(
    path: Path, decoded: tuple[DecodedPicture, DecodedPicture], xmp: bytes, sphere: SphereRequest
) -> Opened:
    """Open a VR180 photo, whose right eye is in its metadata."""
    lies = exif.read_orientation(decoded[0].tags)
    left, right = (each.upright(lies) for each in decoded)
    return Opened(
        pair=_pair_views(path, "a VR180", left, right),
        layout=TWO_PICTURES,
        notes=(
            Note("a VR180 photo, with the right eye in its metadata"),
            *_note_turns(lies),
            *_note_colours(decoded),
        ),
        projection=_read_projection(path, xmp, (left.shape[1], left.shape[0]), sphere, one_eye=True),
    )


def _open_mpo(path: Path, picture: Image.Image, frames: Sequence[int]) -> Opened:
    """Open the pair in an MPO file; both get the first picture's orientation, as one camera took both."""
    decoded = [read_frame(path, picture, index) for index in frames]
    lies = exif.read_orientation(decoded[0].tags)
    # CIPA DC-007 numbers viewpoints from the left; many files omit the number and store the left view first.
    decoded.sort(key=lambda each: exif.read_viewpoint(each.tags))
    left, right = (each.upright(lies) for each in decoded)
    return Opened(
        pair=_pair_views(path, "an MPO", left, right),
        layout="mpo",
        notes=(
            Note("mpo, two pictures in one file", _OVERRIDE),
            *_note_turns(lies),
            *_note_colours(decoded),
        ),
        lens=_read_lens(decoded),
    )


def _open_heif(path: Path, picture: Image.Image, frames: Sequence[int]) -> Opened:
    """Open the pair in a HEIC file, whose left view comes first; pillow-heif turns both upright."""
    left = read_frame(path, picture, frames[0])
    lens = heif.read_lens(path, picture)
    right = read_frame(path, picture, frames[1])
    pair = _pair_views(path, "a HEIC", *(each.upright(None) for each in (left, right)))
    return Opened(
        pair=pair,
        layout=TWO_PICTURES,
        notes=(Note("a HEIC file with a left and a right view"), *_note_colours([left, right])),
        lens=_complete_lens(lens, _read_lens([left, right])),
    )


def _open_lif(path: Path, picture: Image.Image, views: lif.LifViews) -> Opened:
    """Open the pair in a LIF file, one view of which is the open picture."""
    decoded = [
        decode(path, picture)
        if view.picture is None
        else decode_embedded(_name_view(path, side), view.picture)
        for side, view in views.by_side.items()
    ]
    lies, notes = _choose_orientations(*decoded)
    eyes = [each.upright(lie) for each, lie in zip(decoded, lies, strict=True)]
    which = "left and right view" if views.view_count == 2 else f"the outermost of {views.view_count} views"
    pair = _pair_views(path, "a LIF", *eyes)
    height_px, width_px = pair.left.shape[:2]
    return Opened(
        pair=pair,
        layout=TWO_PICTURES,
        notes=(Note(f"a LIF file, {which}", _OVERRIDE), *notes, *_note_colours(decoded)),
        lens=_complete_lens(views.find_lens(width_px, height_px), _read_lens(decoded)),
    )


def _pair_views(
    path: Path, kind: str, left: UInt8[np.ndarray, "h w 3"], right: UInt8[np.ndarray, "h2 w2 3"]
) -> StereoPair:
    """Make the pair of a file of this kind. Raises FormatError if the sizes differ or are too small."""
    if left.shape != right.shape:
        sizes = " and ".join(f"{eye.shape[1]}x{eye.shape[0]}" for eye in (left, right))
        raise FormatError(f"{path}: expected {kind} file with two pictures of the same size, found {sizes}")
    check_large_enough(path, left)
    return StereoPair(left=left, right=right)


def _complete_lens(lens: exif.Lens | None, by_exif: exif.Lens | None) -> exif.Lens | None:
    """Return a lens of a HEIC or LIF file, completed from EXIF."""
    if lens is None or by_exif is None:
        return lens or by_exif
    return replace(
        lens,
        focal_px=lens.focal_px or by_exif.focal_px,
        baseline_m=lens.baseline_m or by_exif.baseline_m,
    )


def _open_animation(path: Path, picture: Image.Image, frames: Sequence[int], format: str | None) -> Opened:
    """Open the pair in an animation of two frames; the left view is taken to be the first one."""
    if format is not None:
        raise FormatError(
            f"{path}: expected one picture, found an animation of two frames, which are the left and the "
            "right view",
            remedy=Remedy("omit the layout", ("format",)),
        )
    left, right = (read_frame(path, picture, index) for index in frames)
    lies = exif.read_orientation(left.tags)
    return Opened(
        pair=make_pair(path, left.upright(lies), path, right.upright(lies)),
        layout=TWO_PICTURES,
        notes=(
            Note("an animation of two frames, taken for the left and the right view"),
            *_note_turns(lies),
            *_note_colours([left, right]),
        ),
        lens=_read_lens([left, right]),
    )


def _choose_orientations(
    left: DecodedPicture, right: DecodedPicture
) -> tuple[tuple[int | None, int | None], list[Note]]:
    """Return the EXIF orientation to use for each of two pictures, and notes on the choice.

    Each picture uses its own tag, unless the sizes then differ or one tag is missing: some editors rotate a
    picture before they drop the tag, and others only drop it. In these cases, both pictures use the same tag
    if this makes the sizes equal and the pictures more similar.
    """
    own = exif.read_orientation(left.tags), exif.read_orientation(right.tags)
    if own[0] == own[1] or {*own} <= {None, 1}:
        return own, _note_turns(own[0])
    alike = (own[0] or own[1],) * 2
    fitting = [
        lies
        for lies in (own, alike)
        if exif.turn_upright(left.image, lies[0]).size == exif.turn_upright(right.image, lies[1]).size
    ]
    if len(fitting) == 2 and None not in own:
        return own, [Note("each picture turned upright by its own EXIF orientation")]
    best = max(fitting or [own], key=lambda lies: np.nan_to_num(_compare(left, right, lies), nan=-1))
    if best == alike:
        which = (
            "the only EXIF orientation"
            if None in own
            else "the left EXIF orientation, though the right one differs"
        )
        return best, [Note(f"both pictures turned upright by {which}")]
    return best, [Note("one picture turned upright by its EXIF orientation, the other unchanged")]


def _compare(left: DecodedPicture, right: DecodedPicture, lies: tuple[int | None, int | None]) -> float:
    return measure_resemblance(left.upright(lies[0]), right.upright(lies[1]))


def _read_declared(path: Path, picture: Image.Image, format: str | None) -> tuple[str | None, str | None]:
    """Return the layout that the user or a JPS file declares, and a phrase such as "from its JPS header".

    The phrase is None if the user gave the layout; both are None if none is declared. Source: VRex's JPS
    format, in which four bytes follow the identifier and the length: separation, flags, layout and type.
    """
    if format not in (None, "jps"):
        return format, None
    segments = [content for _, content in getattr(picture, "applist", [])]
    mark = next((content for content in segments if content.startswith(_JPS_MARK)), b"")
    if len(mark) < 14 or mark[13] != _JPS_STEREO:
        is_jps = format == "jps" or path.suffix.lower() in _CROSSED_ENDINGS
        return ("crossed", "the default of .jps files") if is_jps else (None, None)
    flags, layout = mark[11], mark[12]
    if layout == _JPS_INTERLEAVED:
        name = "row_interleaved" if flags & _JPS_LEFT_FIRST else "row_interleaved_right_first"
        return name, "from its JPS header"
    if layout not in (_JPS_BESIDE, _JPS_ABOVE):
        raise FormatError(
            f"{path}: expected two views side by side, one above the other or interleaved, found a JPS file "
            "that is an anaglyph; save it side by side"
        )
    beside = layout == _JPS_BESIDE
    half = bool(flags & (_JPS_HALF_WIDTH if beside else _JPS_HALF_HEIGHT))
    known = PairLayout(beside=beside, half=half, right_first=not flags & _JPS_LEFT_FIRST)
    return next(name for name, each in PAIR_LAYOUTS.items() if each == known), "from its JPS header"


def _detect_picture_layout(path: Path, image: UInt8[np.ndarray, "h w 3"], *, has_depth: bool) -> str:
    for kind, mark in _OTHER_LAYOUTS.items():
        if re.search(mark, path.stem):
            raise FormatError(
                f"{path}: expected two views, found {kind}, judging by its name", remedy=_OVERRIDE
            )
    try:
        return detect_layout(str(path), [image], photograph=True)
    except FormatError as error:
        if not has_depth:
            raise
        raise FormatError(
            f"{path}: expected a stereo picture, found a photograph of one view with a depth map, as "
            "portraits of telephones have; take a spatial photo, or give two files, left and right"
        ) from error


def _split_views(
    path: Path, image: UInt8[np.ndarray, "h w 3"], layout: PairLayout | InterleavedLayout
) -> tuple[UInt8[np.ndarray, "h2 w2 3"], UInt8[np.ndarray, "h2 w2 3"]]:
    """Split an image into the left and the right view, both at full size."""
    height_px, width_px = image.shape[:2]
    try:
        view_px = layout.eye_size_px(width_px, height_px)
    except FormatError as error:
        raise FormatError(f"{path}: {error}") from error
    check_size(path, view_px)
    left, right = layout.eyes(image)
    check_large_enough(path, left)
    return left, right


def _read_lens(decoded: Sequence[DecodedPicture]) -> exif.Lens | None:
    """Read camera parameters from the tags of both pictures; the first picture's tags take precedence."""
    first, second = decoded
    return exif.read_lens({**second.tags, **first.tags}, *first.image.size)


def _note_turns(lies: int | None) -> list[Note]:
    return [] if lies in (None, 1) else [Note("turned upright by its EXIF orientation")]


def _note_colours(decoded: Sequence[DecodedPicture]) -> list[Note]:
    """Return notes on colour conversions: a single note if both pictures had the same conversion."""
    texts = [each.note for each in decoded]
    if len(set(texts)) == 1:
        return [Note(text) for text in texts[:1] if text]
    sides = zip(("left", "right"), texts, strict=True)
    return [Note(f"{side} picture: {text}") for side, text in sides if text]
