"""New views and layouts for the whole field of view of a VR180 or 360-degree pair, equirectangular again."""

from stereoweave.errors import StereoweaveError
from stereoweave.outputs.view_files import ViewFile, WrittenView
from stereoweave.pictures.panoramas import check_whole_layout, spread_views
from stereoweave.pictures.prepare import Prepared
from stereoweave.rendering.layouts import LAYOUTS, median_disparity_px, write_picture
from stereoweave.rendering.renderer import Renderer
from stereoweave.stereo import Estimate
from stereoweave.system.steps import step


def check_whole_view(file: ViewFile) -> None:
    """Raise a StereoweaveError if a file of views cannot show the whole field of view."""
    check_whole_layout(file.name)
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
    write_picture(file.path, spread)
    what = f"view at {file.position:g}" if file.name is None else file.name
    name = prepared.sphere.whole_projection.name
    return WrittenView(f"{what}, each {name}, {spread.shape[1]}x{spread.shape[0]} px", spread)
