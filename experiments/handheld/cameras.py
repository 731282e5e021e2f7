"""Hand-held cameras: their rotations, focal lengths, lens distortions and exposures."""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, UInt8

_GAMMA = 2.2
_NEWTON_STEPS = 8


class Size(NamedTuple):
    """Size of a picture in px."""

    width: int
    height: int


@dataclass(frozen=True, kw_only=True)
class Ranges:
    """Ranges of the uniformly drawn random parameters; symmetric about zero unless stated otherwise.

    Attributes:
        turn_degrees: Rotation of each camera about each of its axes, relative to the rectified pair. A
            rotation that both share tilts the baseline, as if one camera were higher or farther forward.
        shift: Displacement of the principal point along x and y, as a fraction of the picture's width.
        scale: Difference between the right and the left camera's focal length, as a fraction.
        distortion: Radial distortion of both lenses: the displacement at the corner, as a fraction of its
            distance from the centre.
        distortion_difference: Difference between the right and the left lens's distortion.
        exposure_stops: Exposure of the right picture relative to the left one.
        balance: Difference between the exposures of the right picture's colour channels, as a fraction.
        noise_levels: Greatest standard deviation of the noise, in levels of 0..255; the least is 0.
        quality: Least and greatest quality of the JPEG files.
    """

    turn_degrees: float = 3.0
    shift: float = 0.02
    scale: float = 0.05
    distortion: float = 0.03
    distortion_difference: float = 0.005
    exposure_stops: float = 0.7
    balance: float = 0.05
    noise_levels: float = 3.0
    quality: tuple[int, int] = (80, 95)


@dataclass(frozen=True, kw_only=True)
class HandheldCamera:
    """A camera that looks at a picture of the rectified pair from that picture's own camera centre.

    The picture can therefore be retaken exactly for any scene depth, because rotation, focal length and
    distortion do not change what is visible along a ray.

    Attributes:
        turn: Rotation [3, 3] from rays of this camera to rays of the rectified camera.
        focal_px: Focal length of this camera.
        shift_px: x and y of the principal point relative to the picture's centre.
        distortion: Undistorted radius divided by distorted radius at the corner, minus 1.
        original_focal_px: Focal length of the rectified camera.
    """

    turn: Float[np.ndarray, "3 3"]
    focal_px: float
    shift_px: Float[np.ndarray, "2"]
    distortion: float
    original_focal_px: float

    def find_sources(
        self, places_px: Float[np.ndarray, "n 2"], size: Size, original: Size
    ) -> Float[np.ndarray, "n 2"]:
        """Return the points of the rectified picture that this camera shows at the given places."""
        distorted = (places_px - _centre_px(size) - self.shift_px) / self.focal_px
        squares = (distorted**2).sum(1, keepdims=True) / self._corner(size) ** 2
        rays = np.column_stack([distorted * (1 + self.distortion * squares), np.ones(len(places_px))])
        turned = rays @ self.turn.T
        return turned[:, :2] / turned[:, 2:] * self.original_focal_px + _centre_px(original)

    def find_places(
        self, sources_px: Float[np.ndarray, "n 2"], size: Size, original: Size
    ) -> Float[np.ndarray, "n 2"]:
        """Return the places at which this camera shows points of the rectified picture.

        This inverts `find_sources`.
        """
        seen = (sources_px - _centre_px(original)) / self.original_focal_px
        rays = np.column_stack([seen, np.ones(len(seen))]) @ self.turn
        undistorted = rays[:, :2] / rays[:, 2:]
        wanted = np.linalg.norm(undistorted, axis=1) / self._corner(size)
        radius = wanted.copy()
        for _ in range(_NEWTON_STEPS):
            error = radius * (1 + self.distortion * radius**2) - wanted
            radius -= error / (1 + 3 * self.distortion * radius**2)
        shares = np.divide(radius, wanted, out=np.ones_like(radius), where=wanted > 0)
        return undistorted * shares[:, None] * self.focal_px + _centre_px(size) + self.shift_px

    def _corner(self, size: Size) -> float:
        return float(np.hypot(size.width, size.height)) / 2 / self.focal_px


def draw_cameras(
    rng: np.random.Generator, ranges: Ranges, width_px: int, focal_px: float
) -> tuple[HandheldCamera, HandheldCamera]:
    """Draw the left and the right camera.

    Args:
        rng: Random number generator.
        ranges: Ranges of the random parameters.
        width_px: Width of the rectified pictures.
        focal_px: Focal length of the rectified pictures.
    """
    distortion = rng.uniform(-1, 1) * ranges.distortion
    cameras = []
    for scale, difference in ((0.0, 0.0), (ranges.scale, ranges.distortion_difference)):
        turn, _ = cv2.Rodrigues(np.radians(rng.uniform(-1, 1, 3) * ranges.turn_degrees))
        cameras.append(
            HandheldCamera(
                turn=turn,
                focal_px=focal_px * (1 + scale * rng.uniform(-1, 1)),
                shift_px=rng.uniform(-1, 1, 2) * ranges.shift * width_px,
                distortion=distortion + difference * rng.uniform(-1, 1),
                original_focal_px=focal_px,
            )
        )
    left, right = cameras
    return left, right


def expose(
    rng: np.random.Generator, ranges: Ranges, image: UInt8[np.ndarray, "h w 3"]
) -> UInt8[np.ndarray, "h w 3"]:
    """Change exposure and colour balance in linear light."""
    gain = 2.0 ** (rng.uniform(-1, 1) * ranges.exposure_stops) * (1 + rng.uniform(-1, 1, 3) * ranges.balance)
    table = 255 * np.minimum(gain * (np.arange(256)[:, None] / 255) ** _GAMMA, 1) ** (1 / _GAMMA)
    return cv2.LUT(image, np.rint(table).astype(np.uint8)[None])


def store(
    rng: np.random.Generator, ranges: Ranges, image: UInt8[np.ndarray, "h w 3"]
) -> UInt8[np.ndarray, "h w 3"]:
    """Add sensor noise, and compress and decode the picture as JPEG."""
    noise = rng.uniform(0, ranges.noise_levels) * rng.standard_normal(image.shape)
    noisy = np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)
    quality = int(rng.integers(ranges.quality[0], ranges.quality[1] + 1))
    _, content = cv2.imencode(".jpg", noisy[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    decoded = cv2.imdecode(content, cv2.IMREAD_COLOR_RGB)
    assert decoded is not None
    return decoded.astype(np.uint8)


def _centre_px(size: Size) -> Float[np.ndarray, "2"]:
    return (np.array(size) - 1) / 2
