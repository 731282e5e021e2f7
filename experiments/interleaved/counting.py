"""Counts of interleaved pictures, and of ordinary ones, that are suspected to be interleaved."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from stereoweave.data.readers import read_scenes
from stereoweave.pictures.interleaved import suspect_interleaving

ORDINARY = "ordinary"
_JPEG_QUALITY = 90

_Image = UInt8[np.ndarray, "h w 3"]


@dataclass(frozen=True, kw_only=True)
class SuspectedRow:
    """Counts over all pictures of a layout.

    Attributes:
        layout: How the pictures hold both views; "ordinary" if they hold one.
        stored: Whether they were stored as "png" or as "jpeg".
        pictures: Number of pictures.
        suspected: Number of those that are suspected to be interleaved, in whichever layout.
        named_rightly: Number of those for which the right layout is suspected.
    """

    layout: str
    stored: str
    pictures: int
    suspected: int
    named_rightly: int


def count_suspected(real: Path) -> list[SuspectedRow]:
    """Return a row for each layout and way of storing, over the pairs in a folder."""
    found: dict[tuple[str, str], list[str | None]] = {}
    for scene in read_scenes(real):
        for layout, image in make_pictures(scene.pair.left, scene.pair.right):
            for stored, shown in (("png", image), ("jpeg", _store_jpeg(image))):
                found.setdefault((layout, stored), []).append(suspect_interleaving(shown))
    return [
        SuspectedRow(
            layout=layout,
            stored=stored,
            pictures=len(names),
            suspected=len(names) - names.count(None),
            named_rightly=names.count(None if layout == ORDINARY else layout),
        )
        for (layout, stored), names in found.items()
    ]


def make_pictures(left: _Image, right: _Image) -> Iterator[tuple[str, _Image]]:
    """Yield both views as ordinary pictures, and interleaved in each layout, with the layouts' names."""
    yield ORDINARY, left
    yield ORDINARY, right
    row, column = np.ogrid[: left.shape[0], : left.shape[1]]
    alternate = {
        "row_interleaved": row + 0 * column,
        "column_interleaved": column + 0 * row,
        "checkerboard": row + column,
    }
    for layout, place in alternate.items():
        yield layout, np.where((place % 2 == 0)[..., None], left, right)


def _store_jpeg(image: _Image) -> _Image:
    quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    coded = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), quality)[1]
    return cv2.imdecode(coded, cv2.IMREAD_COLOR_RGB)  # type: ignore[return-value]  # None only for bad data
