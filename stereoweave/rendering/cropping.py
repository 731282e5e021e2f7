"""The part of a picture in which every view shows what a camera saw."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Bool

from stereoweave.cameras.content import find_content
from stereoweave.errors import Remedy, StereoweaveError
from stereoweave.rendering.renderer import Renderer

_LEAST_SIDE_PX = 32
# Single rows may end in a hole that belongs to an object at the border.
_ROWS_PERCENT = 99


def find_common_part(
    renderer: Renderer, positions: Iterable[float], *, up: float = 0.0, forward: float = 0.0
) -> tuple[slice, slice]:
    """Return the rows and columns that are left when the invented borders of all these views are cut off.

    Holes inside the picture do not count. Borders without content count, as rectification leaves them.

    Raises:
        StereoweaveError: The views have less than 32x32 pixels in common.
    """
    views = [renderer.view(position, up=up, forward=forward).drawn for position in positions]
    height, width = views[0].shape
    # Borders that rectification leaves are slanted: each of their rows and columns ends elsewhere.
    rows, columns = find_content(renderer.pair)
    drawn = [view[rows, columns] for view in views]
    start, stop = _find_ends(drawn)
    inside = [view[:, start:stop].T for view in drawn]
    top, bottom = _find_ends(inside) if start < stop else (0, 0)
    if min(stop - start, bottom - top) < min(_LEAST_SIDE_PX, height, width):
        raise StereoweaveError(
            f"expected views that have at least {_LEAST_SIDE_PX}x{_LEAST_SIDE_PX} px in common, "
            f"found {max(stop - start, 0)}x{max(bottom - top, 0)}",
            setting="crop",
            remedy=Remedy("take viewpoints nearer to the cameras", ("position", "strength")),
        )
    return (
        slice(rows.start + top, rows.start + bottom),
        slice(columns.start + start, columns.start + stop),
    )


def _find_ends(masks: list[Bool[np.ndarray, "h w"]]) -> tuple[int, int]:
    """Return the first column and the one after the last that the masks' rows reach."""
    width = masks[0].shape[1]
    return max(map(_measure_border, masks)), width - max(_measure_border(mask[:, ::-1]) for mask in masks)


def _measure_border(mask: Bool[np.ndarray, "h w"]) -> int:
    """Return the columns before the first True of a row, for all rows with one but the few widest."""
    known = mask[mask.any(1)]
    if not len(known):
        return mask.shape[1]
    return int(np.percentile(known.argmax(1), _ROWS_PERCENT, method="inverted_cdf"))
