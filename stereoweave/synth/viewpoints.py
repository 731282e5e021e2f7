"""Viewpoints around a target, and stereo rigs placed at them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from stereoweave.stereo import StereoCamera

# Default range of the nearest surface's disparity, for images 640 px wide.
NEAREST_PX = (18.0, 160.0)


@dataclass(frozen=True, kw_only=True)
class PosedRig:
    """A rectified rig with its pose in the world.

    Attributes:
        camera: Intrinsics and baseline; doffs_px is 0.
        size_px: Width and height of the images.
        position_m: The left camera's centre [3] in the world.
        axes: Rotation [3, 3]; its rows are the camera's right, down and forward axes in the world.
    """

    camera: StereoCamera
    size_px: tuple[int, int]
    position_m: Float[np.ndarray, "3"]
    axes: Float[np.ndarray, "3 3"]

    def eye_m(self, position: float) -> Float[np.ndarray, "3"]:
        """Return the camera centre at `position`, where 0 is the left camera and 1 the right one."""
        return self.position_m + position * self.camera.baseline_m * self.axes[0]


@dataclass(frozen=True, kw_only=True)
class Orbit:
    """Range of a scene's viewpoints, in spherical coordinates around a point.

    Attributes:
        centre_m: Centre of the orbit; the cameras look at a point near it.
        distance_m: Minimum and maximum distance from the centre.
        azimuth_deg: Minimum and maximum azimuth around z, measured from x towards y.
        elevation_deg: Minimum and maximum elevation above the horizon.
        aim_m: Maximum distance from the centre to the point that the cameras look at.
        floor_m: Minimum z of the midpoint between the cameras.
    """

    centre_m: tuple[float, float, float]
    distance_m: tuple[float, float]
    azimuth_deg: tuple[float, float] = (0.0, 360.0)
    elevation_deg: tuple[float, float] = (-5.0, 30.0)
    aim_m: float = 0.5
    floor_m: float = 0.3


@dataclass(frozen=True, kw_only=True)
class Viewpoint:
    """A position on an orbit, with the point to look at and the roll of the cameras."""

    distance_m: float
    azimuth_deg: float
    elevation_deg: float
    aim_m: Float[np.ndarray, "3"]
    roll_deg: float


def draw_viewpoint(rng: np.random.Generator, orbit: Orbit) -> Viewpoint:
    """Draw a random viewpoint on the orbit, with the cameras nearly level."""
    aim_m = np.array(orbit.centre_m) + orbit.aim_m * rng.uniform(-1, 1, 3) / np.sqrt(3)
    return Viewpoint(
        distance_m=float(np.exp(rng.uniform(*np.log(orbit.distance_m)))),
        azimuth_deg=rng.uniform(*orbit.azimuth_deg),
        elevation_deg=rng.uniform(*orbit.elevation_deg),
        aim_m=aim_m,
        roll_deg=rng.normal(0, 1.5),
    )


def draw_focal_px(rng: np.random.Generator, width_px: int) -> float:
    """Draw a focal length in pixels that gives a horizontal field of view of 42 to 72 degrees."""
    return float(width_px / 2 / np.tan(np.radians(rng.uniform(42, 72)) / 2))


def draw_nearest_px(
    rng: np.random.Generator, width_px: int, range_px: tuple[float, float] = NEAREST_PX
) -> float:
    """Draw the nearest surface's disparity log-uniformly from a range given for images 640 px wide.

    The baseline is derived from this disparity, because training depends more on the distribution of
    disparities than on the distribution of baselines.
    """
    return float(np.exp(rng.uniform(*np.log(range_px))) * width_px / 640)


def place_rig(orbit: Orbit, viewpoint: Viewpoint, camera: StereoCamera, size_px: tuple[int, int]) -> PosedRig:
    """Place a rig at a viewpoint, facing the point that the viewpoint aims at.

    The midpoint between the cameras lies at the viewpoint, but no lower than the orbit's `floor_m`.
    """
    azimuth, elevation = np.radians([viewpoint.azimuth_deg, viewpoint.elevation_deg])
    outwards = np.array(
        [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
    )
    middle_m = np.array(orbit.centre_m) + viewpoint.distance_m * outwards
    middle_m[2] = max(middle_m[2], orbit.floor_m)
    forward = viewpoint.aim_m - middle_m
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    roll = np.radians(viewpoint.roll_deg)
    turned = np.cos(roll) * right + np.sin(roll) * down
    axes = np.stack([turned, np.cross(forward, turned), forward])
    return PosedRig(
        camera=camera,
        size_px=size_px,
        position_m=middle_m - camera.baseline_m / 2 * axes[0],
        axes=axes,
    )


def interpolate_viewpoints(start: Viewpoint, end: Viewpoint, share: float) -> Viewpoint:
    """Interpolate between two viewpoints at a fraction (0..1) of the way, with a smooth start and stop."""
    eased = share * share * (3 - 2 * share)

    def mix(name: str) -> float:
        return (1 - eased) * getattr(start, name) + eased * getattr(end, name)

    return Viewpoint(
        distance_m=mix("distance_m"),
        azimuth_deg=mix("azimuth_deg"),
        elevation_deg=mix("elevation_deg"),
        aim_m=(1 - eased) * start.aim_m + eased * end.aim_m,
        roll_deg=mix("roll_deg"),
    )
