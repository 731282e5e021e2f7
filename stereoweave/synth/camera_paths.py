"""Paths of a camera that moves around a target for as long as a video lasts.

Azimuth, elevation, distance, aim and roll swing like pendulums, each at its own pace. The paces are
irrational multiples of each other, so that a path is smooth everywhere and never repeats itself.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from stereoweave.synth.viewpoints import Orbit, Viewpoint

FRAMES_PER_S = 30
# Root mean square of the speed of the rig's centre, as a fraction of its distance from the target: 0.25 m/s
# at 3.75 m. Hand-held cameras that film a desk or an office move at 0.2 to 0.4 m/s (TUM's RGB-D benchmark).
SPEED_PER_S = 1 / 15
# A path covers at most this part of a full circle.
_WIDEST_DEG = 60.0
_ROLL_DEG = 1.5
# Angular rates relative to that of the azimuth: elevation, distance, the aim's three axes, roll. Heights and
# distances change more slowly than directions. Powers of the golden ratio never fall into step.
_GOLDEN = (1 + 5**0.5) / 2
_PACES = np.array([1, _GOLDEN**-1, _GOLDEN**-2, _GOLDEN**-1.5, _GOLDEN**-0.5, _GOLDEN**-2.5, _GOLDEN**-3])


@dataclass(frozen=True, kw_only=True)
class CameraPath:
    """A path of viewpoints over time.

    Each of seven values swings around a middle: azimuth, elevation (both in degrees), distance, the aim's x,
    y and z (in metres), and roll (in degrees).

    Attributes:
        middle: Middles of the seven values.
        reach: Greatest distances of the values from their middles.
        phase: Phases at time 0 in radians.
        rate_per_s: Angular rates in radians per second.
    """

    middle: Float[np.ndarray, "7"]
    reach: Float[np.ndarray, "7"]
    phase: Float[np.ndarray, "7"]
    rate_per_s: Float[np.ndarray, "7"]

    def viewpoint(self, time_s: float) -> Viewpoint:
        """Return the viewpoint at a time in seconds."""
        values = self.middle + self.reach * np.sin(self.phase + self.rate_per_s * time_s)
        return Viewpoint(
            azimuth_deg=float(values[0]),
            elevation_deg=float(values[1]),
            distance_m=float(values[2]),
            aim_m=values[3:6],
            roll_deg=float(values[6]),
        )


def draw_path(
    rng: np.random.Generator, orbit: Orbit, distance_m: tuple[float, float] | None = None
) -> CameraPath:
    """Draw a random path within an orbit's azimuths and elevations.

    The elevation's range is shortened where cameras would be below the orbit's floor: lifting them onto the
    floor, as `place_rig` does, would bend the path.

    Args:
        rng: Source of all random numbers.
        orbit: Ranges of the viewpoints.
        distance_m: Least and greatest distance from the orbit's centre; by default, the nearer half of the
            orbit's distances.
    """
    near_m, far_m = distance_m or (orbit.distance_m[0], float(np.sqrt(np.prod(orbit.distance_m))))
    low_deg, high_deg = orbit.elevation_deg
    low_deg = min(max(low_deg, _lowest_deg(orbit, near_m, far_m)), high_deg)
    reach_deg = min(np.ptp(orbit.azimuth_deg), _WIDEST_DEG) / 2
    azimuth_deg = rng.uniform(orbit.azimuth_deg[0] + reach_deg, orbit.azimuth_deg[1] - reach_deg)
    aim_m = orbit.aim_m / np.sqrt(3)
    middle = (azimuth_deg, (low_deg + high_deg) / 2, (near_m + far_m) / 2, *orbit.centre_m, 0)
    reach = np.array(
        [reach_deg, (high_deg - low_deg) / 2, (far_m - near_m) / 2, aim_m, aim_m, aim_m, _ROLL_DEG]
    )
    # Arcs at the middle distance; of a sine, the root mean square is the peak divided by the root of 2.
    swings_m = np.array([*np.radians(reach[:2]) * middle[2], reach[2]])
    swings_m[0] *= np.cos(np.radians(middle[1]))
    rate_per_s = SPEED_PER_S * middle[2] / np.sqrt(np.mean((swings_m * _PACES[:3]) ** 2) * 3 / 2)
    return CameraPath(
        middle=np.array(middle),
        reach=reach,
        phase=rng.uniform(0, 2 * np.pi, 7),
        rate_per_s=rate_per_s * _PACES,
    )


def _lowest_deg(orbit: Orbit, near_m: float, far_m: float) -> float:
    """Return the least elevation that is above the floor at all distances between the two."""
    sines = (orbit.floor_m - orbit.centre_m[2]) / np.array([near_m, far_m])
    return float(np.degrees(np.arcsin(np.clip(sines, -1, 1))).max())
