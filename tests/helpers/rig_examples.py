"""Ray-cast images of known scenes through known cameras, to test rectification."""

from dataclasses import dataclass

import cv2
import numpy as np

from stereoweave.cameras.rig import Optics, Rig
from stereoweave.stereo import StereoPair

SIZE_PX = (640, 480)
FOCAL_PX = 550.0
RADTAN = np.array([-0.28, 0.09, 0.0006, -0.0004, 0.0])
KANNALA_BRANDT = np.array([-0.02, 0.006, -0.003, 0.0005])


@dataclass(frozen=True)
class Sphere:
    """The inside of a sphere around the left camera, which is equally distant in all directions."""

    radius_m: float

    def hit(self, start_m, direction):
        along = direction @ start_m
        way_m = np.sqrt(along**2 + self.radius_m**2 - start_m @ start_m) - along
        points = start_m + way_m[..., None] * direction
        angles = np.arctan2(points[..., 0], points[..., 2]), np.arcsin(points[..., 1] / self.radius_m)
        return way_m, np.stack(angles, axis=-1) * self.radius_m


@dataclass(frozen=True)
class Plane:
    """A plane through a point, spanned by two orthonormal directions."""

    point_m: np.ndarray
    across: np.ndarray
    up: np.ndarray
    half_m: float = np.inf

    def hit(self, start_m, direction):
        normal = np.cross(self.across, self.up)
        with np.errstate(divide="ignore", invalid="ignore"):
            way_m = normal @ (self.point_m - start_m) / (direction @ normal)
        offset_m = start_m + way_m[..., None] * direction - self.point_m
        places_m = np.stack([offset_m @ self.across, offset_m @ self.up], axis=-1)
        missed = (way_m <= 0) | (np.abs(places_m) > self.half_m).any(-1) | ~np.isfinite(way_m)
        return np.where(missed, np.inf, way_m), np.where(missed[..., None], 0, places_m)


def turned(*degrees):
    """Return the rotation about x, then y, then z."""
    x, y, z = (
        cv2.Rodrigues(angle * axis)[0] for angle, axis in zip(np.radians(degrees), np.eye(3), strict=True)
    )
    return z @ y @ x


def pinhole(distortion=RADTAN, offset_px=(0.0, 0.0)):
    return Optics(matrix=_matrix(offset_px), distortion=np.asarray(distortion, float))


def fisheye(distortion=KANNALA_BRANDT, offset_px=(0.0, 0.0)):
    return Optics(matrix=_matrix(offset_px), distortion=np.asarray(distortion, float), fisheye=True)


def _matrix(offset_px):
    fx, fy = FOCAL_PX, FOCAL_PX * 1.002
    return np.array([[fx, 0, 319.5 + offset_px[0]], [0, fy, 239.5 + offset_px[1]], [0, 0, 1.0]])


def rig_of(lens, degrees=(1.2, -1.5, 1.8), centre_m=(0.1, 0.003, -0.002)):
    """Return a rig of two cameras of the same kind, rotated relative to each other, at different heights."""
    rotation = turned(*degrees)
    return Rig(
        left=lens(offset_px=(4.0, -6.0)),
        right=lens(offset_px=(-5.0, 7.0)),
        rotation=rotation,
        translation_m=-rotation @ np.array(centre_m),
        size_px=SIZE_PX,
    )


class Cameras:
    """The two cameras of a rig; each pixel averages `samples` x `samples` rays, which are computed once."""

    def __init__(self, rig, samples=2):
        steps = (np.arange(samples) + 0.5) / samples - 0.5
        width, height = rig.size_px
        places_px = [
            np.stack(np.meshgrid(np.arange(width) + across, np.arange(height) + down), axis=-1)
            for down in steps
            for across in steps
        ]
        self._rays = [
            [directions(optics, at_px) @ rotation for at_px in places_px]
            for optics, rotation in ((rig.left, np.eye(3)), (rig.right, rig.rotation))
        ]
        self._centres_m = np.zeros(3), -rig.rotation.T @ rig.translation_m

    def photograph(self, surfaces, texture, texel_m):
        """Render a pair of surfaces given in the left camera's coordinates."""
        left, right = (
            np.mean([_colours(centre_m, ray, surfaces, texture, texel_m) for ray in rays], axis=0)
            for centre_m, rays in zip(self._centres_m, self._rays, strict=True)
        )
        return StereoPair(left=np.rint(left).astype(np.uint8), right=np.rint(right).astype(np.uint8))


def _colours(start_m, direction, surfaces, texture, texel_m):
    hits = [surface.hit(start_m, direction) for surface in surfaces]
    nearest = np.argmin([way_m for way_m, _ in hits], axis=0)[..., None]
    places_m = np.choose(nearest, [places for _, places in hits])
    texels = (places_m / texel_m).astype(np.float32) + np.array(texture.shape[1::-1], np.float32) / 2
    return cv2.remap(
        texture, texels[..., 0], texels[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101
    ).astype(np.float32)


def directions(optics, at_px):
    """Return unit viewing directions at pixels x, y; Newton's method inverts the camera model."""
    (fx, _, cx), (_, fy, cy), _ = optics.matrix
    distorted = (at_px - (cx, cy)) / (fx, fy)
    guess = distorted.copy()
    if optics.fisheye:
        radius = np.linalg.norm(distorted, axis=-1)
        angle = radius.copy()
        powers = np.array([3, 5, 7, 9])
        for _ in range(10):
            excess = angle + (optics.distortion * angle[..., None] ** powers).sum(-1) - radius
            angle -= excess / (1 + (optics.distortion * powers * angle[..., None] ** (powers - 1)).sum(-1))
        scale = np.where(radius > 0, np.sin(angle) / np.where(radius > 0, radius, 1), 1)
        return np.concatenate([distorted * scale[..., None], np.cos(angle)[..., None]], axis=-1)
    for _ in range(15):
        guess -= _distorted(guess, optics.distortion) - distorted
    rays = np.concatenate([guess, np.ones_like(guess[..., :1])], axis=-1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def _distorted(ideal, distortion):
    """Distort points by OpenCV's pinhole model with k1 k2 p1 p2 k3."""
    k1, k2, p1, p2, k3 = distortion
    x, y = ideal[..., 0], ideal[..., 1]
    square = x * x + y * y
    radial = 1 + square * (k1 + square * (k2 + square * k3))
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x),
            y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=-1,
    )


def project(optics, points_m):
    """Return the pixels x, y of points in a camera's coordinates."""
    if optics.fisheye:
        radius = np.linalg.norm(points_m[..., :2], axis=-1)
        angle = np.arctan2(radius, points_m[..., 2])
        bent = angle + (optics.distortion * angle[..., None] ** np.array([3, 5, 7, 9])).sum(-1)
        distorted = points_m[..., :2] * (bent / radius)[..., None]
    else:
        distorted = _distorted(points_m[..., :2] / points_m[..., 2:], optics.distortion)
    return distorted * np.diag(optics.matrix)[:2] + optics.matrix[:2, 2]


def speckle(rng, size_px=1024):
    """Return a texture, uint8 RGB, of noise at all scales from 2 texels up, as in photographs."""
    total = np.zeros((size_px, size_px, 3))
    for octave in range(1, 7):
        noise = rng.standard_normal((size_px >> octave, size_px >> octave, 3)).astype(np.float32)
        total += cv2.resize(noise, (size_px, size_px), interpolation=cv2.INTER_CUBIC) * 1.5**octave
    return np.clip(128 + 45 * total / total.std(), 0, 255).astype(np.uint8)
