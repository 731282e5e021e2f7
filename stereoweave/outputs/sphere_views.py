"""New views and layouts for the whole field of view of a VR180 or 360-degree pair, equirectangular again."""

from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from stereoweave.errors import Remedy, StereoweaveError
from stereoweave.io.vr180_photos import is_vr180_name, write_vr180_photo
from stereoweave.outputs.view_files import ViewFile, WrittenView
from stereoweave.pictures.panoramas import SphereView, check_whole_layout, spread_views
from stereoweave.pictures.prepare import Prepared
from stereoweave.rendering.layouts import LAYOUTS, median_disparity_px, write_picture
from stereoweave.rendering.renderer import Renderer
from stereoweave.stereo import Estimate
from stereoweave.system.steps import step

# The layout whose views a VR180 photo holds apart.
_OF_BOTH = "side_by_side"


def check_extent(file: ViewFile, *, whole: bool) -> None:
    """Raise a StereoweaveError if a file of views cannot show the whole field of view, or a window."""
    if not whole and is_vr180_name(file.path):
        raise StereoweaveError(
            f"{file.path}: expected the whole field of view for a VR180 photo, found a window",
            remedy=Remedy("take the whole, or name the file otherwise", ("whole",)),
        )
    if whole:
        _check_whole(file)


def _check_whole(file: ViewFile) -> None:
    check_whole_layout(file.name)
    if is_vr180_name(file.path) and file.name != _OF_BOTH:
        raise StereoweaveError(
            f"{file.path}: expected the layout {_OF_BOTH} for a VR180 photo, found {file.name or 'one view'}",
            remedy=Remedy("choose it", ("layout",)),
        )
    given = {
        "up": file.up,
        "forward": file.forward,
        "size_px": file.size_px,
        "crop": file.crops,
        "screen": file.screen,
    }
    for setting, value in given.items():
        if value:
            raise StereoweaveError("expected only for a window, found with the whole", setting=setting)


@step("rendering views")
def write_whole_view(file: ViewFile, prepared: Prepared, estimate: Estimate) -> WrittenView:
    """Write a view or a layout of views, rendered along the rows of the window of all directions."""
    assert prepared.sphere is not None
    plane_px = median_disparity_px(estimate) if file.convergence_px is None else file.convergence_px
    renderer = Renderer(
        prepared.pair, estimate, strength=file.strength, convergence_px=plane_px, threads=file.threads
    )
    if file.name is None:
        image = renderer.view(file.position).image
    else:
        image = LAYOUTS[file.name].compose(renderer, file.layout_options)
    spread = spread_views(prepared.sphere.spreader(), image, file.name)
    _write(file.path, spread, prepared.sphere)
    what = f"view at {file.position:g}" if file.name is None else file.name
    name = prepared.sphere.whole_projection.name
    return WrittenView(f"{what}, each {name}, {spread.shape[1]}x{spread.shape[0]} px", spread)


def _write(path: Path, spread: UInt8[np.ndarray, "h w 3"], sphere: SphereView) -> None:
    if not is_vr180_name(path):
        write_picture(path, spread)
        return
    left, right = np.split(spread, 2, axis=1)
    west_deg, east_deg = sphere.whole_projection.yaw_deg
    write_vr180_photo(path, left, right, east_deg - west_deg)
