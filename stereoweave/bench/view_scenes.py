"""Pairs with reference pictures from between or beyond the cameras, for scoring new views."""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from stereoweave.data.samples import make_sample, require_size
from stereoweave.data.shards import Shards, list_shards
from stereoweave.errors import FormatError, StereoweaveError
from stereoweave.io.files import read_small, reading
from stereoweave.io.images import read_image, read_pair
from stereoweave.io.maps import read_disparity_png, read_pfm
from stereoweave.rendering.renderer import FIRST_POSITION, LAST_POSITION
from stereoweave.stereo import Sample, StereoPair


@dataclass(frozen=True, kw_only=True)
class ReferenceView:
    """An image taken by a further camera on the line through the two cameras of the pair.

    Attributes:
        position: Position from -1 to 2; 0 is the left camera and 1 the right one.
        image: uint8 RGB [H, W, 3].
        offset_px: Offset of the image's content from its nominal place, to the right and down.
    """

    position: float
    image: UInt8[np.ndarray, "h w 3"]
    offset_px: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class ViewScene:
    """A pair with reference views.

    Attributes:
        name: The folder's name, or a name such as SUBFOLDER/ship-000057 in a rendered set.
        sample: The pair; its disparities are NaN if unknown.
        views: At least one reference view of the same size as the pair, sorted by position.
    """

    name: str
    sample: Sample
    views: tuple[ReferenceView, ...]


def read_view_scenes(folder: str | Path) -> Iterator[ViewScene]:
    """Yield the scenes of `folder`, sorted by name and read one at a time; see `list_view_scenes`."""
    return (read() for read in list_view_scenes(folder))


def list_view_scenes(folder: str | Path) -> list[Callable[[], ViewScene]]:
    """Return a reader for each scene of `folder`, sorted by the scenes' names.

    A scene is a folder with left.png, right.png and a view_<position>.png for each further picture. It may
    also have disparity.png (16 bits, pixels * 256, 0 = unknown) or disparity.pfm (NaN or infinity = unknown),
    and right_disparity in the same formats. An optional scene.json gives each picture's offset from its
    nominal place as "offset_px": {position: [right, down]}. If there are no such folders, the scenes are the
    pairs of all rendered sets (`stereoweave synth make`) in and below `folder`.

    Raises:
        StereoweaveError: If the folder contains no scene.
        FormatError: Raised by a reader if a file is missing, damaged or of a different size, if a position is
            not a number or out of range, or if there is no further picture.
    """
    root = Path(folder)
    if scenes := sorted(left.parent for left in root.glob("*/left.png")):
        return [partial(_read_scene, scene) for scene in scenes]
    below = sorted({path.parent for path in root.rglob("[!.]*.tar")})
    sets = [Shards(path) for path in below if list_shards(path)]
    if not sets:
        raise StereoweaveError(
            f"{root}: expected subfolders with left.png, or rendered sets, found neither; "
            "render a set with further views: stereoweave synth make"
        )
    return [
        partial(_read_rendered_scene, pairs, index, root) for pairs in sets for index in range(pairs.count)
    ]


def _read_rendered_scene(pairs: Shards, index: int, root: Path) -> ViewScene:
    folder = pairs.shards[0].path.parent
    name = (folder.relative_to(root) / pairs.name(index)).as_posix()
    views = tuple(ReferenceView(position=at, image=image) for at, image in sorted(pairs.views(index).items()))
    if not views:
        raise FormatError(
            f"{folder}: expected further views of every pair, found none for {name}; "
            "render a set with further views: stereoweave synth make"
        )
    return ViewScene(name=name, sample=pairs[index], views=views)


def _read_scene(folder: Path) -> ViewScene:
    pair = read_pair(folder / "left.png", folder / "right.png")
    truth_px = partial(_read_disparity, folder, pair=pair)
    offsets_px = _read_offsets(folder / "scene.json")
    views = [_read_view(path, pair, offsets_px) for path in folder.glob("view_*.png")]
    if not views:
        raise FormatError(
            f"{folder}: expected a reference picture, such as view_0.5.png, found no view_*.png"
        )
    return ViewScene(
        name=folder.name,
        sample=make_sample(pair, truth_px("disparity"), truth_px("right_disparity")),
        views=tuple(sorted(views, key=lambda view: view.position)),
    )


def _read_view(path: Path, pair: StereoPair, offsets_px: dict[float, tuple[float, float]]) -> ReferenceView:
    position = _parse_position(path)
    image = require_size(read_image(path), path, pair)
    return ReferenceView(position=position, image=image, offset_px=offsets_px.get(position, (0.0, 0.0)))


def _parse_position(path: Path) -> float:
    text = path.stem.removeprefix("view_")
    try:
        position = float(text)
    except ValueError:
        position = float("nan")
    if not FIRST_POSITION <= position <= LAST_POSITION:
        raise FormatError(
            f"{path}: expected view_<position>.png with a position from {FIRST_POSITION:g} to "
            f"{LAST_POSITION:g} (0 is the left camera and 1 the right one), found {text!r}"
        )
    return position


def _read_disparity(folder: Path, name: str, *, pair: StereoPair) -> Float[np.ndarray, "h w"]:
    """Read the named disparity from a PFM file, or else a PNG file; all NaN (unknown) if neither exists."""
    readers: dict[str, Callable[[Path], Float[np.ndarray, "h w"]]] = {
        ".pfm": read_pfm,
        ".png": read_disparity_png,
    }
    for ending, read in readers.items():
        if (path := folder / f"{name}{ending}").exists():
            return require_size(read(path), path, pair)
    return np.full(pair.left.shape[:2], np.nan, np.float32)


def _read_offsets(path: Path) -> dict[float, tuple[float, float]]:
    if not path.exists():
        return {}
    with reading(path, 'JSON whose "offset_px" is {position: [right, down]}'):
        try:
            offsets_px = json.loads(read_small(path)).get("offset_px", {})
            return {float(position): (float(x), float(y)) for position, (x, y) in offsets_px.items()}
        except (AttributeError, TypeError) as error:
            raise ValueError("an unexpected structure") from error
