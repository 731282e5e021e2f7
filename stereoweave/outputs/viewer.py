"""3-D photo: a self-contained HTML page that shows a pair from any viewpoint near its cameras.

`viewer_script` and `viewer_scene.pack_scene` are the parts of the page, for other pages that show a scene.
"""

import html
import json
import string
from functools import partial
from pathlib import Path

from stereoweave.io.text import writing_text
from stereoweave.outputs.page_parts import embed_json, hash_source, read_page_part
from stereoweave.outputs.viewer_scene import LARGEST_PX, pack_scene
from stereoweave.stereo import Estimate, StereoPair

_read = partial(read_page_part, "viewer_page")


def make_viewer(  # noqa: PLR0913 - all but the first two are optional
    pair: StereoPair,
    estimate: Estimate,
    *,
    title: str = "3-D photo",
    size_px: tuple[int, int] = LARGEST_PX,
    strength: float = 1.0,
    convergence_px: float | None = None,
    threads: int | None = None,
) -> str:
    """Return a self-contained HTML page, of less than 3 MB, that shows the pair in 3-D.

    The page needs no other file and no network. It moves with the mouse, a finger, the arrow keys or by
    itself; without WebGL, it shows the left picture.

    Args:
        pair: The pair.
        estimate: The pair's estimate.
        title: Title of the page.
        size_px: Largest width and height of the packed images; at most `LARGEST_PX`.
        strength: Factor that scales the range of viewpoints about the middle of the baseline.
        convergence_px: Disparity of the points that stay in place. Default: the median disparity.
        threads: Number of threads; default: all cores.
    """
    scene = pack_scene(
        pair, estimate, size_px=size_px, strength=strength, convergence_px=convergence_px, threads=threads
    )
    width, height = (round(side) for side in scene["shown_px"][2:])
    still = scene.pop("front")
    style = string.Template(_read("page.css")).substitute(width=width, height=height)
    script = viewer_script() + _read("page.js")
    return string.Template(_read("page.html")).substitute(
        title=html.escape(title),
        style=style,
        script=script,
        style_hash=hash_source(style),
        script_hash=hash_source(script),
        still=still,
        scene=embed_json(scene),
    )


def write_viewer(path: str | Path, page: str) -> None:
    """Write the page of `make_viewer`."""
    with writing_text(path) as file:
        file.write(page)


def viewer_script() -> str:
    """Return the script that defines `StereoweaveViewer`, with which a page shows a scene of `pack_scene`.

    `await StereoweaveViewer.makeViewer(canvas, scene)` shows the scene on a canvas element and moves it;
    it gives null where the browser has no WebGL. The page must allow images from data: addresses.
    """
    shaders = {f"{kind}_shader": json.dumps(_read(f"view.{kind[:4]}")) for kind in ("vertex", "fragment")}
    return string.Template(_read("viewer.js")).substitute(shaders)
