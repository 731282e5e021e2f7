"""Files of new views: one view, a layout of several, an animation or the 3-D viewer."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from stereoweave.errors import StereoweaveError
from stereoweave.io.animation import write_animation
from stereoweave.io.images import write_image
from stereoweave.outputs.viewer import make_viewer, write_viewer
from stereoweave.outputs.viewer_scene import LARGEST_PX, POSITIONS
from stereoweave.rendering.comfort import ScreenChoice, measure_any_depth
from stereoweave.rendering.cropping import find_common_part
from stereoweave.rendering.floating_windows import find_windows_px
from stereoweave.rendering.layouts import (
    ANIMATIONS,
    LAYOUTS,
    VIEWER,
    LayoutOptions,
    add_mark,
    check_positions,
    check_shows_depth,
    describe_picture,
    has_two_views,
    median_disparity_px,
    render_views,
    write_picture,
)
from stereoweave.rendering.rehearsals import rehearse_drawing, rehearse_filling, rehearse_moving
from stereoweave.rendering.renderer import Renderer, check_position
from stereoweave.rendering.scaling import fit_size, scale_down
from stereoweave.stereo import Estimate, StereoCamera, StereoPair
from stereoweave.system.compiling_ahead import Rehearsal
from stereoweave.system.steps import step


@dataclass(frozen=True)
class WrittenView:
    """What `ViewFile.write` wrote: a description for the user, and the image; None if it moves."""

    description: str
    image: UInt8[np.ndarray, "h w 3"] | None = None


@dataclass(frozen=True, kw_only=True)
class ViewFile:
    """A file of new views, with all its settings, which are checked at once.

    Attributes:
        path: The file.
        name: Its layout (`layouts.choose_layout`); None for a single view.
        position, up, forward: Viewpoint of a single view.
        strength: Factor by which the baseline is multiplied.
        convergence_px: Disparity of the points that stay in place; None for the scene's median disparity.
        layout_options: Options of the layout.
        size_px: Largest width and height of each view; None for the pictures' size.
        crops: Whether to cut off the borders that not every view shows.
        threads: Number of threads; default: all cores.
        screen: Screen that decides strength and convergence, in their place; for layouts of several views.
        windows: Whether a layout of two views has floating windows, unless its borders are cut off.
    """

    path: Path
    name: str | None
    position: float = 0.5
    up: float = 0.0
    forward: float = 0.0
    strength: float = 1.0
    convergence_px: float | None = None
    layout_options: LayoutOptions = LayoutOptions()
    size_px: tuple[int, int] | None = None
    crops: bool = False
    threads: int | None = None
    screen: ScreenChoice | None = None
    windows: bool = False

    def __post_init__(self) -> None:
        if self.screen is not None:
            check_shows_depth(self.name)
        check_position(0.5, up=self.up, forward=self.forward)
        check_positions(self._positions, self.strength)
        if self.crops and not can_crop(self.name):
            raise StereoweaveError(
                f"expected only for a single view, an anaglyph or an animation, found with {self.name}",
                setting="crop",
            )

    @property
    def _positions(self) -> tuple[float, ...]:
        """Positions of the views, the outermost included."""
        if self.name is None:
            return (self.position,)
        if self.name == VIEWER:
            return POSITIONS
        return LAYOUTS[self.name].positions if self.name in LAYOUTS else ANIMATIONS[self.name].positions

    @property
    def rehearsals(self) -> list[Rehearsal]:
        """Rehearsals that compile the kernels of this file's views."""
        if self.name == "rgbd":
            return []
        outside = any(self.strength * abs(position - 0.5) > 0.5 for position in self._positions)
        needed = {
            rehearse_drawing: self.name != VIEWER,
            rehearse_filling: outside or self.name == VIEWER,
            rehearse_moving: bool(self.up or self.forward),
        }
        return [rehearse for rehearse, is_needed in needed.items() if is_needed]

    def add_mark(self, pair: StereoPair) -> "ViewFile":
        """Return the same file with the mark of its layout in its name."""
        if self.name not in LAYOUTS:
            return self
        return replace(self, path=add_mark(self.path, self.name, pair, self.layout_options))

    def write(self, pair: StereoPair, estimate: Estimate, pictures: Iterable[Path]) -> WrittenView:
        """Write the file from a pair and its estimate.

        `pictures` are the pair's files, of which the viewer shows the names.
        """
        if self.screen is not None:
            return self._write_for_screen(self.screen, pair, estimate, pictures)
        plane_px = median_disparity_px(estimate) if self.convergence_px is None else self.convergence_px
        if self.name == VIEWER:
            return self._write_viewer(pair, estimate, plane_px, pictures)
        if self.size_px is not None:
            width = pair.left.shape[1]
            pair, estimate = scale_down(pair, estimate, fit_size(pair.left.shape, self.size_px))
            plane_px *= pair.left.shape[1] / width
        renderer = Renderer(
            pair, estimate, strength=self.strength, convergence_px=plane_px, threads=self.threads
        )
        if self.name is None:
            return self._write_view(renderer)
        return self._write_layout(renderer, self.name)

    def _write_for_screen(
        self, screen: ScreenChoice, pair: StereoPair, estimate: Estimate, pictures: Iterable[Path]
    ) -> WrittenView:
        fit = screen.fit(measure_any_depth(estimate), pair.left.shape[1])
        fitted = replace(
            self, screen=None, windows=True, strength=fit.strength, convergence_px=fit.convergence_px
        )
        written = fitted.write(pair, estimate, pictures)
        return replace(written, description=f"{written.description}\n{screen.describe(fit)}")

    def _find_part(self, renderer: Renderer) -> tuple[slice, slice]:
        """Return the rows and columns of the views to write."""
        if not self.crops:
            return slice(None), slice(None)
        ends = sorted({min(self._positions), max(self._positions)})
        return find_common_part(renderer, ends, up=self.up, forward=self.forward)

    @step("rendering the view")
    def _write_view(self, renderer: Renderer) -> WrittenView:
        part = self._find_part(renderer)
        view = renderer.view(self.position, up=self.up, forward=self.forward)
        image = _cut(view.image, part)
        write_image(self.path, image)
        empty_percent = 100 * (~view.drawn[part]).mean()
        text = f"view at {self.position:g}, {empty_percent:.1f} % of it holes or borders"
        return WrittenView(text, image)

    @step("rendering views")
    def _write_layout(self, renderer: Renderer, name: str) -> WrittenView:
        part = self._find_part(renderer)
        if name in LAYOUTS:
            options, said = self._add_windows(renderer, name)
            image = _cut(LAYOUTS[name].compose(renderer, options), part)
            write_picture(self.path, image, _find_camera(renderer))
            return WrittenView(describe_picture(self.path, name, image) + said, image)
        motion = ANIMATIONS[name]
        turns = motion.turns(self.path)
        frames = render_views(renderer, motion.positions * turns)
        count = write_animation(self.path, (_cut(frame, part) for frame in frames), motion.frame_ms)
        if count == 1:
            return WrittenView(f"{name}, a still picture, because nothing moves in it")
        length_s = len(motion.positions) * turns * motion.frame_ms / 1000
        return WrittenView(f"{name}, {count} frames in {length_s:g} s")

    def _add_windows(self, renderer: Renderer, name: str) -> tuple[LayoutOptions, str]:
        """Return the layout's options with its floating windows, and the words about them."""
        if not self.windows or self.crops or not has_two_views(name):
            return self.layout_options, ""
        windows_px = find_windows_px(
            renderer.estimate, strength=renderer.strength, convergence_px=renderer.convergence_px
        )
        bars = [f"{px:.0f} px {side}" for px, side in zip(windows_px, ("left", "right"), strict=True) if px]
        said = f", floating window {' and '.join(bars)}" if bars else ""
        return replace(self.layout_options, windows_px=windows_px), said

    def _write_viewer(
        self, pair: StereoPair, estimate: Estimate, plane_px: float, pictures: Iterable[Path]
    ) -> WrittenView:
        page = make_viewer(
            pair,
            estimate,
            title=" + ".join(picture.name for picture in pictures),
            size_px=self.size_px or LARGEST_PX,
            strength=self.strength,
            convergence_px=plane_px,
            threads=self.threads,
        )
        write_viewer(self.path, page)
        return WrittenView(f"{VIEWER}, {len(page) / 1e6:.2g} MB; open it in a browser")


def _find_camera(renderer: Renderer) -> StereoCamera | None:
    """Return the camera of the eyes' views; None if it is unknown, or if the views are shifted."""
    camera = renderer.pair.camera
    if camera is None or camera.doffs_px or renderer.convergence_px or not renderer.strength:
        return None
    return replace(camera, baseline_m=renderer.strength * camera.baseline_m)


def can_crop(name: str | None) -> bool:
    """Return whether a layout shows its views in one place, each in full size, so that it can be cropped."""
    return name is None or name in ANIMATIONS or name.startswith("anaglyph")


def _cut(image: UInt8[np.ndarray, "h w 3"], part: tuple[slice, slice]) -> UInt8[np.ndarray, "h2 w2 3"]:
    return np.ascontiguousarray(image[part])
