"""Two parallel cameras around a target: where they stand, how far apart, which focal length."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from stereoweave.stereo import StereoCamera

# In a picture 640 px wide, unless a scene has a range of its own.
NEAREST_PX = (18.0, 160.0)


@dataclass(frozen=True, kw_only=True)
class PosedRig:
    """A stereo camera in the world.

    Attributes:
        camera: intrinsics and baseline; doffs_px is 0.
        size_px: width and height of the pictures.
        position_m: [3], of the left camera.
        axes: [3, 3], rows: the camera's right, down and forward in the world.
    """

    camera: StereoCamera
    size_px: tuple[int, int]
    position_m: Float[np.ndarray, "3"]
    axes: Float[np.ndarray, "3 3"]

    def eye_m(self, position: float) -> Float[np.ndarray, "3"]:
        """Where the camera at `position` stands: 0 is the left one, 1 the right."""
        return self.position_m + position * self.camera.baseline_m * self.axes[0]


@dataclass(frozen=True, kw_only=True)
class Orbit:
    """Where a scene may be seen from: around a point, in spherical coordinates, all ranges from..to.

    Attributes:
        centre_m: the point that is looked at, give or take.
        distance_m: from the centre.
        azimuth_deg: around z, counted from x towards y.
        elevation_deg: above the horizon.
        aim_m: how far beside the centre the cameras may look, at most.
        floor_m: the cameras stay above this z.
    """

    centre_m: tuple[float, float, float]
    distance_m: tuple[float, float]
    azimuth_deg: tuple[float, float] = (0.0, 360.0)
    elevation_deg: tuple[float, float] = (-5.0, 30.0)
    aim_m: float = 0.5
    floor_m: float = 0.3


@dataclass(frozen=True, kw_only=True)
class Viewpoint:
    """A place on an orbit."""

    distance_m: float
    azimuth_deg: float
    elevation_deg: float
    aim_m: Float[np.ndarray, "3"]
    roll_deg: float


def draw_viewpoint(rng: np.random.Generator, orbit: Orbit) -> Viewpoint:
    """A place anywhere on the orbit, the cameras nearly level."""
    aim_m = np.array(orbit.centre_m) + orbit.aim_m * rng.uniform(-1, 1, 3) / np.sqrt(3)
    return Viewpoint(
        distance_m=float(np.exp(rng.uniform(*np.log(orbit.distance_m)))),
        azimuth_deg=rng.uniform(*orbit.azimuth_deg),
        elevation_deg=rng.uniform(*orbit.elevation_deg),
        aim_m=aim_m,
        roll_deg=rng.normal(0, 1.5),
    )


def draw_focal_px(rng: np.random.Generator, width_px: int) -> float:
    """A focal length in pixels, for a field of view of 42 to 72 degrees."""
    return float(width_px / 2 / np.tan(np.radians(rng.uniform(42, 72)) / 2))


def draw_nearest_px(
    rng: np.random.Generator, width_px: int, range_px: tuple[float, float] = NEAREST_PX
) -> float:
    """Draw the disparity of the nearest surface, log-uniform in a range given for a width of 640 px.

    The baseline follows from it, because for training the spread of disparities matters more than that of
    baselines.
    """
    return float(np.exp(rng.uniform(*np.log(range_px))) * width_px / 640)


def place_rig(orbit: Orbit, viewpoint: Viewpoint, camera: StereoCamera, size_px: tuple[int, int]) -> PosedRig:
    """The rig at a viewpoint, looking at its aim; the middle between the two cameras is on the orbit."""
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
    """The viewpoint at a share 0..1 of the way, starting and stopping gently, for a camera that moves."""
    eased = share * share * (3 - 2 * share)

    def mixed(name: str) -> float:
        return (1 - eased) * getattr(start, name) + eased * getattr(end, name)

    return Viewpoint(
        distance_m=mixed("distance_m"),
        azimuth_deg=mixed("azimuth_deg"),
        elevation_deg=mixed("elevation_deg"),
        aim_m=(1 - eased) * start.aim_m + eased * end.aim_m,
        roll_deg=mixed("roll_deg"),
    )
