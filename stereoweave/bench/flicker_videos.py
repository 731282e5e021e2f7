"""Rendered videos with known motion: a still scene, a passing object, a moving camera, a flash and a fade."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from stereoweave.bench.flicker_metrics import find_seen_again
from stereoweave.stereo import StereoPair
from stereoweave.synth.sets.pair_rendering import RenderSpec, draw_stage_and_rig
from stereoweave.synth.sets.renderers import shared_renderer
from stereoweave.synth.viewpoints import PosedRig

LEFT, MIDDLE, RIGHT = 0.0, 0.5, 1.0
NOISE_LEVELS = 4.0
# Supersampling of a passing object along each axis, so that it can move by quarters of a pixel.
_FINE = 4
# Minimum by which the object's disparity exceeds the greatest disparity of the scene.
_IN_FRONT_PX = 8

Change = tuple[Float[np.ndarray, "h w 2"], Float[np.ndarray, "h w"]]
"""Change of points from one frame to another, seen from the same position: motion to the right and down, and
change of disparity, in px."""


@dataclass(frozen=True, kw_only=True)
class RenderedVideo:
    """A rendered video with its ground truth.

    Attributes:
        name: Name of what happens in the video, such as "passing".
        pairs: The scene in each frame, without noise and before exposure.
        gains: Brightness of each frame, as a multiple of the scene's.
        disparities_px: True disparity [H, W] of each frame in the views at LEFT and MIDDLE.
        moving: Mask of the moving object in the left view of each frame.
        change: Function that returns the `Change` from one frame to another, seen from a position.
    """

    name: str
    pairs: list[StereoPair]
    gains: Sequence[float]
    disparities_px: list[dict[float, Float[np.ndarray, "h w"]]]
    moving: list[Bool[np.ndarray, "h w"]]
    change: Callable[[int, int, float], Change]

    def find_seen_again(self, frame: int, other: int, position: float) -> Bool[np.ndarray, "h w"]:
        """Return the mask of a frame's points that another frame also shows, seen from the same position."""
        before_px, after_px = (self.disparities_px[number][position] for number in (frame, other))
        return find_seen_again(before_px, after_px, *self.change(frame, other, position))


def expose(pair: StereoPair, gain: float) -> StereoPair:
    """Return the pair with its brightness multiplied by a gain."""

    def brighten(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
        return np.rint(gain * image).clip(0, 255).astype(np.uint8)

    return StereoPair(left=brighten(pair.left), right=brighten(pair.right))


def add_noise(pair: StereoPair, rng: np.random.Generator) -> StereoPair:
    """Add Gaussian sensor noise of NOISE_LEVELS, independent for each image, pixel and channel."""

    def add(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
        return np.rint(image + rng.normal(0, NOISE_LEVELS, image.shape)).clip(0, 255).astype(np.uint8)

    return StereoPair(left=add(pair.left), right=add(pair.right))


def render_panning(spec: RenderSpec, frames: int) -> RenderedVideo:
    """Render the middle `frames` frames of the camera path, where the camera moves fastest."""
    first = (spec.frames - frames) // 2
    stages = [draw_stage_and_rig(shared_renderer(), spec, 0, first + number) for number in range(frames)]
    rigs = [rig for _, rig in stages]
    renders = [
        shared_renderer().render_views(stage.world, rig, (LEFT, MIDDLE, RIGHT)) for stage, rig in stages
    ]
    disparities_px = [
        {
            position: rig.camera.disparity_px(shot.depth_m).astype(np.float32)
            for position, shot in zip((LEFT, MIDDLE), seen, strict=False)
        }
        for rig, seen in zip(rigs, renders, strict=True)
    ]

    def change(frame: int, other: int, position: float) -> Change:
        return reproject(disparities_px[frame][position], rigs[frame], rigs[other], position)

    return RenderedVideo(
        name="panning",
        pairs=[StereoPair(left=left.image, right=right.image) for left, _, right in renders],
        gains=[1.0] * frames,
        disparities_px=disparities_px,
        moving=[np.zeros(left.depth_m.shape, bool) for left, _, _ in renders],
        change=change,
    )


def reproject(
    disparity_px: Float[np.ndarray, "h w"], rig: PosedRig, other: PosedRig, position: float
) -> Change:
    """Return the `Change` of a view's points when the rig moves to the pose of `other`.

    Args:
        disparity_px: Disparity of the view's pixels; 0 for the sky.
        rig: Rig that the view belongs to.
        other: The same rig at another pose.
        position: Position of the view in both rigs.
    """
    lens, turn = rig.camera, other.axes @ rig.axes.T
    shift = other.axes @ (rig.eye_m(position) - other.eye_m(position))
    rows, columns = np.indices(disparity_px.shape, np.float64)
    ray = np.stack(
        [(columns - lens.cx_px) / lens.focal_px, (rows - lens.cy_px) / lens.focal_px, 1 + 0 * rows]
    )
    # Everything is divided by the point's depth in the first view, so the sky may be infinitely far away.
    point = np.tensordot(turn, ray, 1) + shift[:, None, None] * disparity_px / (
        lens.focal_px * lens.baseline_m
    )
    moved_x = lens.focal_px * point[0] / point[2] + lens.cx_px - columns
    moved_y = lens.focal_px * point[1] / point[2] + lens.cy_px - rows
    change_px = disparity_px / point[2] - disparity_px
    return np.stack([moved_x, moved_y], -1).astype(np.float32), change_px.astype(np.float32)


def freeze(video: RenderedVideo) -> RenderedVideo:
    """Return a video of the same length that repeats the first frame."""
    frames = len(video.pairs)
    nothing = np.zeros((*video.moving[0].shape, 3), np.float32)
    return replace(
        video,
        name="still",
        pairs=video.pairs[:1] * frames,
        disparities_px=video.disparities_px[:1] * frames,
        moving=video.moving[:1] * frames,
        change=lambda frame, other, position: (nothing[..., :2], nothing[..., 2]),
    )


def add_passing_oval(
    video: RenderedVideo, name: str, velocity_px: tuple[float, float], nearing_px: float = 0.0
) -> RenderedVideo:
    """Return a video of the same length in which an oval moves in front of the first frame.

    The oval shows the same frame, upside down and at a quarter of its size.

    Args:
        video: The video whose first frame is used.
        name: The new video's name.
        velocity_px: Motion of the oval per frame in the left view, to the right and down; multiples of 0.25.
        nearing_px: Increase of the oval's disparity per frame; a multiple of 0.5.
    """
    pair, truth_px = video.pairs[0], video.disparities_px[0]
    height, width = video.moving[0].shape
    steps = range(len(video.pairs))
    nearest_px = max(math.ceil(values.max()) for values in truth_px.values()) + _IN_FRONT_PX
    ovals_px = [nearest_px + nearing_px * step for step in steps]

    def paste(
        image: UInt8[np.ndarray, "h w 3"], step: int, position: float
    ) -> tuple[UInt8[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
        left = round(width * 0.375) + velocity_px[0] * step - position * ovals_px[step]
        return _paste_oval(image, pair.left, left, round(height * 0.375) + velocity_px[1] * step)

    shown = [
        {
            place: paste(pair.right if place == RIGHT else pair.left, step, place)
            for place in (LEFT, MIDDLE, RIGHT)
        }
        for step in steps
    ]

    def change(frame: int, other: int, position: float) -> Change:
        of_oval = np.array([*velocity_px, nearing_px]) * (other - frame)
        of_oval[0] -= position * of_oval[2]
        both = shown[frame][position][1][..., None] * of_oval.astype(np.float32)
        return both[..., :2], both[..., 2]

    return replace(
        video,
        name=name,
        pairs=[StereoPair(left=views[LEFT][0], right=views[RIGHT][0]) for views in shown],
        disparities_px=[
            {
                place: np.where(shown[step][place][1], np.float32(ovals_px[step]), truth_px[place])
                for place in truth_px
            }
            for step in steps
        ],
        moving=[views[LEFT][1] for views in shown],
        change=change,
    )


def _paste_oval(
    image: UInt8[np.ndarray, "h w 3"], picture: UInt8[np.ndarray, "h w 3"], left_px: float, top_px: float
) -> tuple[UInt8[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
    """Return the image with an oval pasted in, and the mask of the pixels that are at least half covered.

    Args:
        image: The background.
        picture: Image that the oval shows, upside down and at a quarter of its size.
        left_px: Left edge of the oval's bounding box; a multiple of 0.25.
        top_px: Top edge; a multiple of 0.25.
    """
    height, width = picture.shape[:2]
    oval = np.zeros((height, width, 1), np.uint8)
    cv2.ellipse(oval, (width // 2, height // 2), (width // 2, height // 2), 0, 0, 360, 255, cv2.FILLED)
    fine = np.dstack([picture[::-1] * (oval > 0), oval])
    move = np.array([[1, 0, left_px * _FINE], [0, 1, top_px * _FINE]])
    fine = cv2.warpAffine(
        fine, move, (_FINE * image.shape[1], _FINE * image.shape[0]), flags=cv2.INTER_NEAREST
    )
    layer = cv2.resize(
        fine.astype(np.float32), (image.shape[1], image.shape[0]), interpolation=cv2.INTER_AREA
    )
    share = layer[..., 3:] / 255
    return np.rint(image * (1 - share) + layer[..., :3]).astype(np.uint8), share[..., 0] >= 0.5
