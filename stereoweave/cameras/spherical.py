"""Projections of VR180 and 360-degree pictures: which direction each pixel of an eye's image shows.

Axes: x to the right, y down, z straight ahead. Yaw is positive to the right, pitch positive upwards.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32

from stereoweave.arguments import check_choice, check_number
from stereoweave.errors import Remedy, StereoweaveError

Rays = Float32[np.ndarray, "3 h w"]
Map = Float32[np.ndarray, "h w"]

RECTILINEAR, EQUIRECTANGULAR, HALF, FISHEYE = (
    "rectilinear",
    "equirectangular",
    "half_equirectangular",
    "fisheye",
)
# Names as in FFmpeg; rectilinear is an ordinary picture.
PROJECTIONS = (RECTILINEAR, EQUIRECTANGULAR, HALF, FISHEYE)
# A camera of two lenses sees less to both sides; a picture that shows more was taken or rendered with eyes
# that turn (omnidirectional stereo).
_WIDEST_FIXED_DEG = 230.0
LEAST_LENS_DEG, MOST_LENS_DEG = 20.0, 280.0
_LEAST_SPAN_DEG = 1.0


class Located(NamedTuple):
    """Pixels of an image that show the given rays: columns and rows [H, W], and a mask of those it shows."""

    columns: Map
    rows: Map
    seen: Bool[np.ndarray, "h w"]


@dataclass(frozen=True, kw_only=True)
class Projection:
    """How one eye's image shows directions.

    Attributes:
        name: equirectangular, half_equirectangular or fisheye.
        yaw_deg: Yaw at the left and the right border of an equirectangular image.
        pitch_deg: Pitch at its bottom and top border.
        lens_fov_deg: Field of view of a fisheye's circle, which touches the nearer borders of the image. The
            angle from the axis grows evenly with the distance from the centre (equidistant model).
    """

    name: str
    yaw_deg: tuple[float, float] = (-180.0, 180.0)
    pitch_deg: tuple[float, float] = (-90.0, 90.0)
    lens_fov_deg: float = 180.0

    def __post_init__(self) -> None:
        west, east, bottom, top = (*self.yaw_deg, *self.pitch_deg)
        spans = (east - west, top - bottom)
        if not (_LEAST_SPAN_DEG <= spans[0] <= 360.001 and _LEAST_SPAN_DEG <= spans[1] <= 180.001):
            raise StereoweaveError(
                f"expected an image of 1 to 360 by 1 to 180 degrees, found {spans[0]:g} by {spans[1]:g}"
            )
        if not LEAST_LENS_DEG <= self.lens_fov_deg <= MOST_LENS_DEG:
            raise StereoweaveError(
                f"expected a field of view of {LEAST_LENS_DEG:g} to {MOST_LENS_DEG:g} degrees, "
                f"found {self.lens_fov_deg:g}",
                setting="lens_fov_deg",
            )

    @classmethod
    def named(cls, name: str, lens_fov_deg: float = 180.0) -> "Projection":
        """Return the projection with this name, of a whole image. Raises StereoweaveError if unknown."""
        check_choice("projection", name, (EQUIRECTANGULAR, HALF, FISHEYE))
        if name == HALF:
            return cls(name=HALF, yaw_deg=(-90.0, 90.0))
        return cls(name=name, lens_fov_deg=lens_fov_deg)

    @property
    def turns(self) -> bool:
        """Whether the eyes turn with the direction of view, as in 360-degree pictures, and are not fixed."""
        return self.name != FISHEYE and self.yaw_deg[1] - self.yaw_deg[0] > _WIDEST_FIXED_DEG

    @property
    def is_closed(self) -> bool:
        """Whether the left border continues the right one."""
        return self.name != FISHEYE and self.yaw_deg[1] - self.yaw_deg[0] > 359.99

    def pixels_per_radian(self, size_px: tuple[int, int]) -> float:
        """Return the finer one of the horizontal and vertical resolutions of an image of this size."""
        width_px, height_px = size_px
        if self.name == FISHEYE:
            return min(size_px) / math.radians(self.lens_fov_deg)
        spans = self.yaw_deg[1] - self.yaw_deg[0], self.pitch_deg[1] - self.pitch_deg[0]
        return max(width_px / math.radians(spans[0]), height_px / math.radians(spans[1]))

    def locate(self, rays: Rays, size_px: tuple[int, int]) -> Located:
        """Return the pixels of an image of this width and height that show the rays, of any length."""
        x, y, z = rays
        width_px, height_px = size_px
        if self.name == FISHEYE:
            aside = np.hypot(x, y)
            angle = np.arctan2(aside, z)
            scale = self.pixels_per_radian(size_px) * angle / np.maximum(aside, np.float32(1e-12))
            columns, rows = scale * x + (width_px - 1) / 2, scale * y + (height_px - 1) / 2
            seen = angle <= math.radians(self.lens_fov_deg) / 2
        else:
            yaw_deg = np.degrees(np.arctan2(x, z)) - self.yaw_deg[0]
            pitch_deg = np.degrees(np.arctan2(-y, np.hypot(x, z)))
            yaw_share = np.mod(yaw_deg, 360) / (self.yaw_deg[1] - self.yaw_deg[0])
            pitch_share = (self.pitch_deg[1] - pitch_deg) / (self.pitch_deg[1] - self.pitch_deg[0])
            columns, rows = yaw_share * width_px - 0.5, pitch_share * height_px - 0.5
            seen = (yaw_share <= 1) & (pitch_share >= 0) & (pitch_share <= 1)
            # The outermost half pixel beyond the centres of the first and last row.
            rows = np.clip(rows, 0, height_px - 1)
        return Located(columns.astype(np.float32), rows.astype(np.float32), seen)

    def rays(self, size_px: tuple[int, int], rows: slice = slice(None)) -> Rays:
        """Return the direction of each pixel of an equirectangular image, as unit vectors, for some rows."""
        width_px, height_px = size_px
        west, east = self.yaw_deg
        bottom, top = self.pitch_deg
        yaw = np.radians(west + (np.arange(width_px) + 0.5) / width_px * (east - west))
        pitch = np.radians(top - (np.arange(height_px)[rows, None] + 0.5) / height_px * (top - bottom))
        level = np.cos(pitch)
        shape = (len(pitch), width_px)
        return np.stack(
            [level * np.sin(yaw), np.broadcast_to(-np.sin(pitch), shape), level * np.cos(yaw)]
        ).astype(np.float32)


@dataclass(frozen=True, kw_only=True)
class SphereRequest:
    """User settings for VR180 and 360-degree files.

    Attributes:
        projection: A name in `PROJECTIONS`; default: detected.
        look_deg: Yaw and pitch of the window's middle; default: 0, 0, straight ahead.
        fov_deg: Field of view of the window; default: 90.
        lens_fov_deg: Field of view of a fisheye lens; default: as the file says, or 180.
        whole: Whether to take the whole field of view instead of a window.
    """

    projection: str | None = None
    look_deg: tuple[float, float] | None = None
    fov_deg: float | None = None
    lens_fov_deg: float | None = None
    whole: bool = False

    def __post_init__(self) -> None:
        if self.projection is not None:
            check_choice("projection", self.projection, PROJECTIONS)
        for setting in ("fov_deg", "lens_fov_deg"):
            if (value := getattr(self, setting)) is not None:
                object.__setattr__(self, setting, check_number(setting, value))
        for setting, value in (("look_deg", self.look_deg), ("fov_deg", self.fov_deg)):
            if self.whole and value is not None:
                raise StereoweaveError(
                    "expected only for a window, found with the whole field", setting=setting
                )
        if self.lens_fov_deg is not None and self.projection not in (None, FISHEYE):
            raise StereoweaveError(
                f"expected only for a fisheye, found with {self.projection}", setting="lens_fov_deg"
            )

    def choose(self, name: str, detected: Projection | None) -> Projection | None:
        """Return the projection of a file; None for an ordinary one.

        Raises:
            StereoweaveError: The other settings need a projection, but none is known or another one is.
        """
        chosen = detected
        if self.projection == RECTILINEAR:
            chosen = None
        elif self.projection is not None and (detected is None or detected.name != self.projection):
            chosen = Projection.named(self.projection)
        if chosen is not None and self.lens_fov_deg is not None:
            if chosen.name != FISHEYE:
                raise StereoweaveError(
                    f"expected only for a fisheye, found with {name}, which is {chosen.name}",
                    setting="lens_fov_deg",
                    remedy=Remedy(f"omit it, or choose {FISHEYE}", ("projection",)),
                )
            chosen = replace(chosen, lens_fov_deg=self.lens_fov_deg)
        settings = {
            "whole": self.whole or None,
            "look_deg": self.look_deg,
            "fov_deg": self.fov_deg,
            "lens_fov_deg": self.lens_fov_deg,
        }
        given = [setting for setting, value in settings.items() if value is not None]
        if chosen is None and given:
            raise StereoweaveError(
                f"expected only for VR180 and 360-degree files, found with {name}, of unknown projection",
                setting=given[0],
                remedy=Remedy(f"choose one of {', '.join(PROJECTIONS[1:])}", ("projection",)),
            )
        return chosen


def describe_projection(projection: Projection) -> str:
    """Return the name with the angles that it shows, for notes."""
    if projection.name == FISHEYE:
        return f"fisheye of {projection.lens_fov_deg:g} degrees"
    spans = projection.yaw_deg[1] - projection.yaw_deg[0], projection.pitch_deg[1] - projection.pitch_deg[0]
    return f"{projection.name} of {spans[0]:g}x{spans[1]:g} degrees"
