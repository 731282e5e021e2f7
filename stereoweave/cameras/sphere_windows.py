"""Rectified windows of VR180 and 360-degree pictures: images of both eyes in which rows match.

Two lenses side by side (VR180) have one baseline, which lies along x. An image plane parallel to it gives
rectified pictures, wherever the window lies on the plane; a window to the side is a part of that plane away
from its centre (`PerspectiveWindow`). The eyes of a 360-degree picture turn with the direction of view
(omnidirectional stereo), so that rows match on a cylinder about the vertical (`CylinderWindow`). For the
whole field of view, the axes are angles: those towards the baseline, whose rows are the epipolar planes
(`ArcWindow`), or yaw and pitch (`StripWindow`).

Sources: "Binocular Spherical Stereo" (Li, IEEE Trans. ITS 2008) for epipolar planes as rows; "Omnistereo:
Panoramic Stereo Imaging" (Peleg, Ben-Ezra, Pritch, IEEE Trans. PAMI 2001) for eyes that turn.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from stereoweave.cameras.spherical import Map, Projection, Rays
from stereoweave.errors import Remedy, StereoweaveError
from stereoweave.io.decoding import MOST_PIXELS
from stereoweave.io.images import SMALLEST_SIDE_PX
from stereoweave.stereo import LONGEST_SIDE_PX, StereoCamera

LEAST_FOV_DEG, MOST_FOV_DEG = 10.0, 150.0
# Beyond this angle from the plane perpendicular to the baseline, too little of the baseline is left.
BLIND_DEG = 75.0
# Limit of windows on a plane or a cylinder, whose pixels shrink towards 90 degrees.
_FARTHEST_ASIDE_DEG = 80.0
# A window costs time and memory by its pixels. The widest window of a VR180 picture of half width has 14
# times as many as the picture; one of a part of few degrees would have thousands of times as many.
_MOST_ENLARGED = 16
# A strip repeats this angle at each end, where both of its ends are blended.
_OVERLAP_DEG = 15.0
ALL_ROWS = slice(None)

Across = Float32[np.ndarray, "1 w"]
Down = Float32[np.ndarray, "h 1"]


@dataclass(frozen=True, kw_only=True)
class Window(ABC):
    """Geometry of a rectified image, which the left and the right image of a pair share.

    Attributes:
        size_px: Width and height.
        focal_px: Focal length, or pixels per radian.
        cx_px, cy_px: Column and row at which both axes are 0.
    """

    size_px: tuple[int, int]
    focal_px: float
    cx_px: float
    cy_px: float

    def axes(self, rows: slice = ALL_ROWS) -> tuple[Across, Down]:
        """Return the coordinates of all columns and of some rows, in focal lengths from the centre."""
        across = np.arange(self.size_px[0], dtype=np.float32)[None]
        down = np.arange(self.size_px[1], dtype=np.float32)[rows, None]
        return (across - self.cx_px) / self.focal_px, (down - self.cy_px) / self.focal_px

    @abstractmethod
    def rays(self, rows: slice = ALL_ROWS) -> Rays:
        """Return the direction of each pixel, of any length, for some rows."""

    @abstractmethod
    def find(self, rays: Rays) -> tuple[Map, Map]:
        """Return the columns and rows of the pixels that show the rays; NaN where none does."""

    @abstractmethod
    def nearness(self, disparity_px: Map) -> Map:
        """Return the left eye's 1 / distance of each pixel along its ray, in 1 / baselines; at least 0."""

    def blindness_deg(self, rays: Rays) -> Map:
        """Return the angle of rays from where the baseline is longest; at 90 degrees, none of it is left."""
        x, y, z = rays
        return np.degrees(np.abs(np.arctan2(x, np.hypot(y, z)))).astype(np.float32)

    def camera(self, baseline_m: float) -> StereoCamera | None:
        """Return the camera of both images; None if they are no perspective images."""
        return None

    @property
    def repeats_px(self) -> tuple[float, ...]:
        """Shifts of columns at which the window may show the same direction again."""
        return (0.0,)

    def _to_pixels(self, across: Map, down: Map) -> tuple[Map, Map]:
        columns, rows = across * self.focal_px + self.cx_px, down * self.focal_px + self.cy_px
        return columns.astype(np.float32), rows.astype(np.float32)


@dataclass(frozen=True, kw_only=True)
class PerspectiveWindow(Window):
    """Part of the image plane that is parallel to the baseline, and turned about it by `pitch` radians."""

    pitch: float

    def rays(self, rows: slice = ALL_ROWS) -> Rays:
        """Return the direction of each pixel, for some rows."""
        across, down = np.broadcast_arrays(*self.axes(rows))
        turn = _turn_about_x(self.pitch)
        return np.einsum("ij,jhw->ihw", turn, np.stack([across, down, np.ones_like(down)]))

    def find(self, rays: Rays) -> tuple[Map, Map]:
        """Return the columns and rows of the pixels that show the rays; NaN behind the image plane."""
        x, y, z = np.einsum("ji,jhw->ihw", _turn_about_x(self.pitch), rays)
        ahead = np.where(z > 1e-6, z, np.float32(np.nan))
        return self._to_pixels(x / ahead, y / ahead)

    def nearness(self, disparity_px: Map) -> Map:
        """Return the left eye's 1 / distance, in 1 / baselines: disparity is focal length / depth."""
        across, down = self.axes()
        length = np.sqrt(1 + across**2 + down**2)
        return (np.maximum(disparity_px, 0) / self.focal_px / length).astype(np.float32)

    def camera(self, baseline_m: float) -> StereoCamera | None:
        """Return the camera of both images."""
        return StereoCamera(focal_px=self.focal_px, baseline_m=baseline_m, cx_px=self.cx_px, cy_px=self.cy_px)


@dataclass(frozen=True, kw_only=True)
class ArcWindow(Window):
    """All directions of two fixed eyes: rows are planes through both eyes, columns angles to the baseline."""

    def rays(self, rows: slice = ALL_ROWS) -> Rays:
        """Return the direction of each pixel, as unit vectors, for some rows."""
        aside, plane = np.broadcast_arrays(*self.axes(rows))
        return np.stack([np.sin(aside), np.cos(aside) * np.sin(plane), np.cos(aside) * np.cos(plane)])

    def find(self, rays: Rays) -> tuple[Map, Map]:
        """Return the columns and rows of the pixels that show the rays; outside the image if behind."""
        x, y, z = rays
        return self._to_pixels(np.arctan2(x, np.hypot(y, z)), np.arctan2(y, z))

    def nearness(self, disparity_px: Map) -> Map:
        """Return the left eye's 1 / distance, by the law of sines in the triangle of point and eyes."""
        aside, _ = self.axes()
        parallax = np.maximum(disparity_px, 0) / self.focal_px
        right_cosine = np.cos(aside - parallax)
        return np.where(right_cosine > 1e-3, np.sin(parallax) / np.maximum(right_cosine, 1e-3), 0).astype(
            np.float32
        )


class _Turning(Window):
    """What windows of turning eyes share: angles of yaw as columns, and a baseline that vanishes above."""

    def blindness_deg(self, rays: Rays) -> Map:
        """Return the angle of rays from the level, where the baseline is longest."""
        x, y, z = rays
        return np.degrees(np.abs(np.arctan2(y, np.hypot(x, z)))).astype(np.float32)

    def _level_nearness(self, disparity_px: Map) -> Map:
        """Return 1 / distance from the left eye in the plane of the eyes, which look along tangents.

        A point at distance r from the middle is seen at asin(1 / 2r) to either side.
        """
        parallax = np.clip(disparity_px / self.focal_px, 0, 0.9 * np.pi)
        return (2 * np.tan(parallax / 2)).astype(np.float32)


@dataclass(frozen=True, kw_only=True)
class CylinderWindow(_Turning):
    """Part of a cylinder about the vertical axis, around `yaw` radians, for eyes that turn."""

    yaw: float

    def rays(self, rows: slice = ALL_ROWS) -> Rays:
        """Return the direction of each pixel, of length 1 in the level plane, for some rows."""
        across, down = np.broadcast_arrays(*self.axes(rows))
        return np.stack([np.sin(across + self.yaw), down, np.cos(across + self.yaw)])

    def find(self, rays: Rays) -> tuple[Map, Map]:
        """Return the columns and rows of the pixels that show the rays."""
        x, y, z = rays
        yaw = np.mod(np.arctan2(x, z) - self.yaw + np.pi, 2 * np.pi) - np.pi
        return self._to_pixels(yaw, y / np.maximum(np.hypot(x, z), 1e-9))

    def nearness(self, disparity_px: Map) -> Map:
        """Return the left eye's 1 / distance, in 1 / baselines."""
        _, down = self.axes()
        return self._level_nearness(disparity_px) / np.sqrt(1 + down**2)


@dataclass(frozen=True, kw_only=True)
class StripWindow(_Turning):
    """All directions of eyes that turn: columns are yaw, rows pitch; both ends of the circle overlap."""

    def rays(self, rows: slice = ALL_ROWS) -> Rays:
        """Return the direction of each pixel, as unit vectors, for some rows."""
        yaw, pitch = np.broadcast_arrays(*self.axes(rows))
        return np.stack([np.cos(pitch) * np.sin(yaw), np.sin(pitch), np.cos(pitch) * np.cos(yaw)])

    def find(self, rays: Rays) -> tuple[Map, Map]:
        """Return the columns and rows of the pixels that show the rays; of two, those nearer the middle."""
        x, y, z = rays
        return self._to_pixels(np.arctan2(x, z), np.arctan2(y, np.hypot(x, z)))

    @property
    def repeats_px(self) -> tuple[float, ...]:
        """Shifts of columns at which the window may show the same direction again."""
        circle_px = 2 * math.pi * self.focal_px
        return (0.0, -circle_px, circle_px)

    def nearness(self, disparity_px: Map) -> Map:
        """Return the left eye's 1 / distance, in 1 / baselines."""
        _, pitch = self.axes()
        return self._level_nearness(disparity_px) * np.cos(pitch)


def make_window(
    projection: Projection, eye_size_px: tuple[int, int], look_deg: tuple[float, float], fov_deg: float
) -> Window:
    """Return a window of `fov_deg` by `fov_deg` degrees around a direction, as sharp as the picture.

    Args:
        projection: Projection of each eye's image.
        eye_size_px: Width and height of each eye's image.
        look_deg: Yaw and pitch of the middle.
        fov_deg: Field of view in degrees, from 10 to 150.

    Raises:
        StereoweaveError: The direction or the field of view is out of range, the baseline vanishes there, or
            a side of the window is shorter than 32 px, or it has far more pixels than the picture.
    """
    if not LEAST_FOV_DEG <= fov_deg <= MOST_FOV_DEG:
        raise StereoweaveError(
            f"expected {LEAST_FOV_DEG:g} to {MOST_FOV_DEG:g} degrees, found {fov_deg:g}",
            setting="fov_deg",
            remedy=Remedy("for more, take the whole field of view", ("whole",)),
        )
    yaw, pitch = math.radians(look_deg[0]), math.radians(look_deg[1])
    if not (abs(look_deg[0]) <= 360 and abs(look_deg[1]) <= 90):
        raise StereoweaveError(
            "expected a yaw of -360 to 360 and a pitch of -90 to 90 degrees, found "
            f"{look_deg[0]:g},{look_deg[1]:g}",
            setting="look_deg",
        )
    resolution_px = projection.pixels_per_radian(eye_size_px)
    make = _make_cylinder if projection.turns else _make_plane
    window = make(yaw, pitch, math.radians(fov_deg), resolution_px)
    _check_size(window.size_px, eye_size_px)
    return window


def _make_cylinder(yaw: float, pitch: float, span: float, resolution_px: float) -> CylinderWindow:
    """Return the window of eyes that turn, of `span` by `span` radians around a direction."""
    _check_aside("below or above the level", pitch, span)
    focal_px, height_px, cy_px = _spread(-pitch, span, resolution_px)
    size_px = _even(focal_px * span), height_px
    return CylinderWindow(
        size_px=size_px, focal_px=focal_px, cx_px=(size_px[0] - 1) / 2, cy_px=cy_px, yaw=yaw
    )


def _make_plane(yaw: float, pitch: float, span: float, resolution_px: float) -> PerspectiveWindow:
    """Return the window of fixed eyes, of `span` by `span` radians around a direction."""
    x, y, z = math.sin(yaw) * math.cos(pitch), -math.sin(pitch), math.cos(yaw) * math.cos(pitch)
    aside = math.atan2(x, math.hypot(y, z))
    _check_aside("to a side", aside, span)
    focal_px, width_px, cx_px = _spread(aside, span, resolution_px)
    # A plane shows a direction aside at 1 / cosine of the scale of its middle.
    height_px = _even(2 * math.tan(span / 2) / math.cos(aside) * focal_px)
    return PerspectiveWindow(
        size_px=(width_px, height_px),
        focal_px=focal_px,
        cx_px=cx_px,
        cy_px=(height_px - 1) / 2,
        pitch=math.atan2(-y, z),
    )


def make_whole_window(projection: Projection, eye_size_px: tuple[int, int]) -> Window:
    """Return the window of all directions of a picture, as sharp as the picture.

    Raises:
        StereoweaveError: A side is shorter than 32 px, or it has far more pixels than the picture.
    """
    resolution_px = projection.pixels_per_radian(eye_size_px)
    height_px = _even(math.pi * resolution_px)
    span = math.radians(360 + 2 * _OVERLAP_DEG) if projection.turns else math.pi
    width_px = _even(span * resolution_px)
    size_px = width_px, height_px
    _check_size(size_px, eye_size_px)
    kind = StripWindow if projection.turns else ArcWindow
    return kind(size_px=size_px, focal_px=resolution_px, cx_px=(width_px - 1) / 2, cy_px=(height_px - 1) / 2)


def _spread(middle: float, span: float, resolution_px: float) -> tuple[float, int, float]:
    """Return the focal length, extent and centre in pixels of an axis of tangents, from angles in radians.

    A tangent has the fewest pixels a radian at the angle nearest to 0; there it has the picture's.
    """
    first, last = middle - span / 2, middle + span / 2
    least = 0.0 if first < 0 < last else min(abs(first), abs(last))
    focal_px = resolution_px * math.cos(least) ** 2
    extent_px = _even(focal_px * (math.tan(last) - math.tan(first)))
    return focal_px, extent_px, (extent_px - 1) / 2 - focal_px * (math.tan(first) + math.tan(last)) / 2


def _check_aside(where: str, angle: float, span: float) -> None:
    """Raise a StereoweaveError if a window of `span` radians reaches where the baseline vanishes."""
    farthest_deg = math.degrees(abs(angle) + span / 2)
    if farthest_deg > _FARTHEST_ASIDE_DEG:
        raise StereoweaveError(
            f"expected a window of up to {_FARTHEST_ASIDE_DEG:g} degrees {where}, where the distance of the "
            f"eyes vanishes, found one of up to {farthest_deg:.0f}",
            setting="look_deg",
            remedy=Remedy("look less far aside, or narrow the field of view", ("look_deg", "fov_deg")),
        )


def _check_size(size_px: tuple[int, int], eye_size_px: tuple[int, int]) -> None:
    fits = min(size_px) >= SMALLEST_SIDE_PX and max(size_px) <= LONGEST_SIDE_PX
    if not fits or size_px[0] * size_px[1] > MOST_PIXELS:
        raise StereoweaveError(
            f"expected a window of {SMALLEST_SIDE_PX} to {LONGEST_SIDE_PX} px a side and at most "
            f"{MOST_PIXELS / 1e6:g} megapixels, found {size_px[0]}x{size_px[1]} px",
            remedy=Remedy("choose another field of view", ("fov_deg",)),
        )
    if size_px[0] * size_px[1] > _MOST_ENLARGED * eye_size_px[0] * eye_size_px[1]:
        raise StereoweaveError(
            f"expected a window of at most {_MOST_ENLARGED} times the picture's pixels, found "
            f"{size_px[0]}x{size_px[1]} px of a picture of {eye_size_px[0]}x{eye_size_px[1]} px, which shows "
            "few degrees",
            remedy=Remedy("choose a narrower field of view", ("fov_deg",)),
        )


def _even(extent_px: float) -> int:
    return max(2 * round(extent_px / 2), 2)


def _turn_about_x(pitch: float) -> Float32[np.ndarray, "3 3"]:
    """Return the matrix from directions of a window that is pitched upwards to those of the picture."""
    sine, cosine = math.sin(pitch), math.cos(pitch)
    return np.array([[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]], np.float32)
