"""Errors of the distances over a VR180 pair of the room, found in one image or in nine merged windows."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Float32

from experiments.sphere_windows.room import SpherePair, look_equirectangular, render_fixed
from stereoweave.cameras.sphere_remap import Cutter
from stereoweave.cameras.sphere_windows import Window, make_whole_window, make_window
from stereoweave.cameras.spherical import Projection
from stereoweave.matching.backend import Backend
from stereoweave.matching.estimate import match
from stereoweave.matching.matcher import Matcher
from stereoweave.stereo import StereoPair

_BANDS_DEG = (0, 30, 45, 60, 75)
_PLANES_DEG, _ASIDE_DEG, _FOV_DEG = (-60, 0, 60), (-42, 0, 42), 75
# Share of a window's width and height over which its weight rises from 0 at its border.
_RISE = 0.1
_LEAST_WEIGHT = 1e-3
_PROJECTION = Projection.named("half_equirectangular")

Nearness = Float32[np.ndarray, "h w"]


@dataclass(frozen=True, kw_only=True)
class SphereRow:
    """Distances of one picture, found in one way.

    Attributes:
        windows: Number of windows; 1 is the image of all directions.
        eye_px: Width and height of each eye's picture.
        matched_megapixels: Pixels of all windows of one eye.
        seconds: Time of cutting and matching.
        error_0_percent, error_30_percent, error_45_percent, error_60_percent: Median relative error of the
            distance from 0, 30, 45 and 60 degrees aside on, up to the next one or to 75.
    """

    windows: int
    eye_px: int
    matched_megapixels: float
    seconds: float
    error_0_percent: float
    error_30_percent: float
    error_45_percent: float
    error_60_percent: float


def measure_distances(eye_px: int) -> list[SphereRow]:
    """Return a row for one image of all directions, and one for nine windows."""
    size_px = eye_px, eye_px
    rays = look_equirectangular(size_px)
    scene, matcher = render_fixed(rays), Backend(model="small").matcher()
    aside_deg = np.degrees(np.abs(np.arcsin(rays[..., 0])))
    rows = []
    for windows in ([make_whole_window(_PROJECTION, size_px)], make_nine_windows(size_px)):
        start_s = time.perf_counter()
        nearness = find_nearness(scene, windows, matcher)
        seconds = time.perf_counter() - start_s
        with np.errstate(divide="ignore"):  # a nearness of 0 is a distance of infinity
            errors = 100 * np.abs(1 / (nearness * scene.distance) - 1)
        medians = [
            float(np.median(errors[(aside_deg >= least) & (aside_deg < most)]))
            for least, most in pairwise(_BANDS_DEG)
        ]
        pixels = sum(width * height for width, height in (window.size_px for window in windows))
        rows.append(
            SphereRow(
                windows=len(windows),
                eye_px=eye_px,
                matched_megapixels=pixels / 1e6,
                seconds=seconds,
                error_0_percent=medians[0],
                error_30_percent=medians[1],
                error_45_percent=medians[2],
                error_60_percent=medians[3],
            )
        )
    return rows


def make_nine_windows(size_px: tuple[int, int]) -> list[Window]:
    """Return windows of 75 by 75 degrees in three planes through the baseline, three in each."""
    looks = [
        (math.sin(aside), -math.cos(aside) * math.sin(plane), math.cos(aside) * math.cos(plane))
        for plane in map(math.radians, _PLANES_DEG)
        for aside in map(math.radians, _ASIDE_DEG)
    ]
    directions = ((math.degrees(math.atan2(x, z)), -math.degrees(math.asin(y))) for x, y, z in looks)
    return [make_window(_PROJECTION, size_px, look_deg, _FOV_DEG) for look_deg in directions]


def find_nearness(scene: SpherePair, windows: Sequence[Window], matcher: Matcher) -> Nearness:
    """Return 1 / distance in each direction of the left eye, in 1 / baselines; NaN where no window reaches.

    Windows are averaged by their confidence and by the distance to their borders.
    """
    height_px, width_px = scene.left.shape[:2]
    rays = _PROJECTION.rays((width_px, height_px))
    total, near = (np.zeros((height_px, width_px), np.float32) for _ in range(2))
    for window in windows:
        cutter = Cutter(_PROJECTION, (width_px, height_px), window)
        left, right = cutter.cut(scene.left), cutter.cut(scene.right)
        estimate = match(matcher, StereoPair(left=left, right=right))
        columns, lines = window.find(rays)
        weight = find_weights(columns, lines, window.size_px)
        places = tuple(
            np.nan_to_num(np.rint(np.clip(place, 0, most - 1))).astype(int)
            for place, most in ((lines, window.size_px[1]), (columns, window.size_px[0]))
        )
        weight *= np.maximum(estimate.confidence[places], _LEAST_WEIGHT)
        near += weight * window.nearness(estimate.disparity_px)[places]
        total += weight
    with np.errstate(invalid="ignore", divide="ignore"):
        return near / total


def find_weights(
    columns: Float[np.ndarray, "h w"], lines: Float[np.ndarray, "h w"], size_px: tuple[int, int]
) -> Float32[np.ndarray, "h w"]:
    """Return weights that rise from the borders of a window on, up to 1; 0 outside it."""
    within_px = [np.minimum(px, most - 1 - px) for px, most in zip((columns, lines), size_px, strict=True)]
    shares = [px / (_RISE * most) for px, most in zip(within_px, size_px, strict=True)]
    # The outermost pixels reach half a pixel beyond their centres.
    is_inside = np.minimum(*within_px) > -0.5
    return np.where(is_inside, np.clip(np.minimum(*shares), _LEAST_WEIGHT, 1), 0).astype(np.float32)
