"""Rendering of individual pairs: stage, rig, images and exact ground truth."""

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8

from stereoweave.arguments import check_choice
from stereoweave.data.poses import Pose
from stereoweave.data.samples import make_sample
from stereoweave.errors import StereoweaveError
from stereoweave.stereo import Sample, StereoCamera, StereoPair
from stereoweave.synth.camera_paths import FRAMES_PER_S, CameraPath, draw_path
from stereoweave.synth.scenes import SCENES
from stereoweave.synth.stage import Stage
from stereoweave.synth.viewpoints import (
    PosedRig,
    draw_focal_px,
    draw_nearest_px,
    draw_viewpoint,
    interpolate_viewpoints,
    place_rig,
)
from stereoweave.synth.world import RenderedView, World

# This quantile of depth determines the baseline, so a single blade of grass does not count.
_NEAREST_SHARE = 0.01
# Seen from either camera, even a wire (this quantile of depth) counts if its disparity exceeds the drawn
# disparity by this factor.
_WIRE_SHARE, _EXCESS = 0.002, 1.25
# A small image suffices to find the nearest surface.
_LOOK_WIDTH_PX = 160
# Default rig of sets by world. The focal length, for images 640 px wide, is that of ElasticFusion's default
# camera; the paper gives neither number.
_WORLD_FOCAL_PX, _WORLD_BASELINE_M = 528, 0.5


@runtime_checkable
class SceneRenderer(Protocol):
    """Protocol for renderers of worlds: `OpenGLRenderer`, and the slower `Raycaster` with fewer effects."""

    @property
    def name(self) -> str: ...

    def depth_m(self, world: World, rig: PosedRig, position: float) -> Float[np.ndarray, "h w"]: ...

    def render_views(self, world: World, rig: PosedRig, positions: Sequence[float]) -> list[RenderedView]: ...


@dataclass(frozen=True, kw_only=True)
class RenderSpec:
    """Specification of the pairs of a set.

    Attributes:
        scene: A name in SCENES.
        seed: Seed of all random numbers, combined with the scene's name and the pair's index.
        size_px: Width and height of the images.
        frames: Number of consecutive pairs that form a video of one world from a moving camera; 1 for stills.
        views: Positions of additional views between or beyond the two cameras, such as 0.5.
        rig: Focal length in pixels and baseline in metres of all pairs; if None, both are drawn per world, or
            `world_rig` if the set is by world.
        by_world: Whether the camera of a video keeps moving around the target (`camera_paths`), instead of
            crossing a part of the orbit once, from a start to an end. Pairs are then named after their world.
        distance_m: Least and greatest distance of the cameras from the target's centre, in a set by world; if
            None, the nearer half of the scene's.
    """

    scene: str
    seed: int = 0
    size_px: tuple[int, int] = (640, 480)
    frames: int = 1
    views: tuple[float, ...] = ()
    rig: tuple[float, float] | None = None
    by_world: bool = False
    distance_m: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        check_choice("scene", self.scene, SCENES)
        if self.distance_m is not None:
            _check_distance(self.distance_m, self.by_world)
        if self.rig is not None:
            try:
                _centred_camera(*self.rig, self.size_px)
            except StereoweaveError as error:
                raise StereoweaveError(str(error), setting="rig") from error


@dataclass(frozen=True, kw_only=True)
class RenderedPair:
    """A rendered pair with its ground truth.

    Attributes:
        sample: The pair, its disparities (0 for the sky), occlusion masks and camera.
        views: Position and rendering of each additional view.
    """

    sample: Sample
    views: tuple[tuple[float, RenderedView], ...]


def render_pair(renderer: SceneRenderer, spec: RenderSpec, index: int) -> RenderedPair:
    """Render pair number `index` of a set; the result is the same in every process."""
    sequence, frame = divmod(index, spec.frames)
    stage, rig = draw_stage_and_rig(renderer, spec, sequence, frame)
    left, right, *others = renderer.render_views(stage.world, rig, (0.0, 1.0, *spec.views))
    left_px, right_px = (rig.camera.disparity_px(shot.depth_m).astype(np.float32) for shot in (left, right))
    rng = np.random.default_rng((*_seed(spec, sequence), frame))
    left_image, right_image = (_add_noise(rng, shot.image, stage.noise_levels) for shot in (left, right))
    pair = StereoPair(left=left_image, right=right_image, camera=rig.camera)
    return RenderedPair(
        sample=make_sample(pair, left_px, right_px),
        views=tuple(zip(spec.views, others, strict=True)),
    )


def draw_stage_and_rig(
    renderer: SceneRenderer, spec: RenderSpec, sequence: int, frame: int = 0
) -> tuple[Stage, PosedRig]:
    """Draw the stage and rig of a frame; only the viewpoint differs between the frames of a sequence."""
    if spec.by_world:
        stage, path = _draw_world(SCENES[spec.scene], _seed(spec, sequence), spec.distance_m)
        camera = _centred_camera(*(spec.rig or world_rig(spec.size_px)), spec.size_px)
        return stage, place_rig(stage.orbit, path.viewpoint(frame / FRAMES_PER_S), camera, spec.size_px)
    rng = np.random.default_rng(_seed(spec, sequence))
    stage = SCENES[spec.scene](rng)
    focal_px = draw_focal_px(rng, spec.size_px[0])
    nearest_px = draw_nearest_px(rng, spec.size_px[0], stage.nearest_px)
    start = draw_viewpoint(rng, stage.orbit)
    # A video covers only a part of the orbit.
    end = interpolate_viewpoints(start, draw_viewpoint(rng, stage.orbit), rng.uniform(0.15, 0.4))
    ends = (start,) if spec.frames == 1 else (start, end)
    if spec.rig is not None:
        focal_px, baseline_m = spec.rig
    else:

        def rigs(baseline_m: float) -> list[PosedRig]:
            scale = _LOOK_WIDTH_PX / spec.size_px[0]
            size_px = (_LOOK_WIDTH_PX, max(round(scale * spec.size_px[1]), 1))
            small = _centred_camera(scale * focal_px, baseline_m, size_px)
            return [place_rig(stage.orbit, place, small, size_px) for place in ends]

        baseline_m = _choose_baseline_m(renderer, stage.world, rigs, nearest_px / focal_px)
    share = frame / max(spec.frames - 1, 1)
    camera = _centred_camera(focal_px, baseline_m, spec.size_px)
    return stage, place_rig(stage.orbit, interpolate_viewpoints(start, end, share), camera, spec.size_px)


def draw_world_poses(spec: RenderSpec, world: int) -> list[Pose]:
    """Return the poses of the left cameras of all frames of a world, for a spec by world."""
    stage, path = _draw_world(SCENES[spec.scene], _seed(spec, world), spec.distance_m)
    camera = _centred_camera(*(spec.rig or world_rig(spec.size_px)), spec.size_px)
    times_s = [frame / FRAMES_PER_S for frame in range(spec.frames)]
    rigs = [place_rig(stage.orbit, path.viewpoint(time_s), camera, spec.size_px) for time_s in times_s]
    return [
        Pose(time_s=time_s, position_m=rig.position_m, axes=rig.axes)
        for time_s, rig in zip(times_s, rigs, strict=True)
    ]


def world_rig(size_px: tuple[int, int]) -> tuple[float, float]:
    """Return the default rig of sets by world: focal length in pixels and baseline in metres."""
    return _WORLD_FOCAL_PX * size_px[0] / 640, _WORLD_BASELINE_M


@lru_cache(maxsize=1)  # a renderer keeps what it has computed for the last world
def _draw_world(
    build: Callable[[np.random.Generator], Stage],
    seed: tuple[int, int, int],
    distance_m: tuple[float, float] | None,
) -> tuple[Stage, CameraPath]:
    """Draw a world and the path of the camera in it."""
    rng = np.random.default_rng(seed)
    stage = build(rng)
    return stage, draw_path(rng, stage.orbit, distance_m)


def _check_distance(distance_m: tuple[float, float], by_world: bool) -> None:
    if not by_world:
        raise StereoweaveError(
            f"expected none for a set without worlds, found {distance_m}", setting="distance_m"
        )
    near_m, far_m = distance_m
    if not 0 < near_m <= far_m < np.inf:
        raise StereoweaveError(
            f"expected a least and a greatest distance above 0, found {near_m} and {far_m}",
            setting="distance_m",
        )


def _seed(spec: RenderSpec, sequence: int) -> tuple[int, int, int]:
    return spec.seed, zlib.crc32(spec.scene.encode()), sequence


def _add_noise(
    rng: np.random.Generator, image: UInt8[np.ndarray, "h w 3"], levels: float
) -> UInt8[np.ndarray, "h w 3"]:
    """Add sensor noise that grows with the square root of brightness, like shot noise."""
    if not levels:
        return image
    deviation = levels * np.sqrt((0.25 + image / 255) / 1.25)
    return np.clip(np.rint(image + deviation * rng.standard_normal(image.shape)), 0, 255).astype(np.uint8)


def _choose_baseline_m(
    renderer: SceneRenderer, world: World, rigs: Callable[[float], Sequence[PosedRig]], metres_px: float
) -> float:
    """Return the baseline in metres that gives the nearest surface the desired disparity.

    The nearest surface is determined from the rig's centre. Seen from the cameras, another surface may be
    nearer. The baseline is shortened if necessary, so that the disparity of such a surface exceeds the
    desired disparity by at most a quarter.

    Args:
        renderer: Renderer that measures depth.
        world: The world to look at.
        rigs: Function that returns the rigs for a baseline in metres.
        metres_px: Desired disparity divided by focal length, which is the baseline per metre of depth.
    """

    def nearest_m(baseline_m: float, positions: Sequence[float], share: float) -> float:
        views = [(rig, position) for rig in rigs(baseline_m) for position in positions]
        return min(float(np.quantile(renderer.depth_m(world, *view), share)) for view in views)

    baseline_m = metres_px * nearest_m(1e-6, (0.0,), _NEAREST_SHARE)
    return min(baseline_m, _EXCESS * metres_px * nearest_m(baseline_m, (0.0, 1.0), _WIRE_SHARE))


def _centred_camera(focal_px: float, baseline_m: float, size_px: tuple[int, int]) -> StereoCamera:
    width_px, height_px = size_px
    return StereoCamera(
        focal_px=focal_px, baseline_m=baseline_m, cx_px=(width_px - 1) / 2, cy_px=(height_px - 1) / 2
    )
