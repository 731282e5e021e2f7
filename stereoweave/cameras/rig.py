"""Intrinsics and relative pose of two cameras."""

import hashlib
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float

from stereoweave.errors import FormatError, Note, StereoweaveError
from stereoweave.stereo import CAMERA_NUMBERS_BELOW, StereoCamera, StereoPair

# Possible numbers of distortion coefficients in OpenCV's models; 0 means no distortion.
_PINHOLE_COUNTS, _FISHEYE_COUNTS = (0, 4, 5, 8, 12, 14), (0, 4)
# In the smallest pictures, 32 px wide, this means a field of view of 173 degrees.
_LEAST_FOCAL_PX = 1
# Tolerances for files with few decimals; they amount to a few hundredths of a pixel in a 4000 px picture.
_ROTATION_OFF, _SAME_PX, _SAME_DIRECTION = 1e-5, 1e-2, 1e-3
_ROUNDED = 1e-3
# Heights in metres are wrong by as much, because a rectified camera has one focal length.
_SQUARE = 1e-3

Size = tuple[int, int]


@dataclass(frozen=True, kw_only=True)
class Optics:
    """Camera intrinsics: projection of a point x, y, z (right, down, forward) to a pixel.

    Attributes:
        matrix: Focal lengths and principal point in px, [3, 3] without skew; pixel centres are integers.
        distortion: Coefficients [N] in OpenCV's order: k1 k2 p1 p2 k3 ... for a pinhole (N is 0, 4, 5, 8, 12
            or 14), and k1 k2 k3 k4 for a fisheye lens (N is 0 or 4).
        fisheye: Whether the lens follows Kannala and Brandt's model, which OpenCV calls fisheye and Kalibr
            `equidistant`.
    """

    matrix: Float[np.ndarray, "3 3"]
    distortion: Float[np.ndarray, " n"]
    fisheye: bool = False

    def __post_init__(self) -> None:
        numbers = (*self.matrix.ravel(), *self.distortion)
        (fx, skew, _), (below, fy, _), last = self.matrix.tolist()
        small = (np.abs(numbers) < CAMERA_NUMBERS_BELOW).all()
        upright = (skew, below, *last) == (0, 0, 0, 0, 1)
        if not (upright and min(fx, fy) >= _LEAST_FOCAL_PX and small):
            raise StereoweaveError(
                "expected a camera matrix fx 0 cx, 0 fy cy, 0 0 1 with focal lengths of at least "
                f"{_LEAST_FOCAL_PX} px and numbers below {CAMERA_NUMBERS_BELOW:g}, "
                f"found {self.matrix.tolist()} and distortion {self.distortion.tolist()}"
            )
        counts = _FISHEYE_COUNTS if self.fisheye else _PINHOLE_COUNTS
        if self.distortion.size not in counts:
            raise StereoweaveError(
                f"expected {' or '.join(map(str, counts))} distortion coefficients for a "
                f"{'fisheye' if self.fisheye else 'pinhole'} lens, found {self.distortion.size}"
            )


@dataclass(frozen=True, kw_only=True)
class Rig:
    """Two cameras on one mount.

    Attributes:
        left, right: Intrinsics of the two cameras.
        rotation, translation_m: Transform from left to right camera coordinates, in OpenCV's convention:
            x_right = rotation @ x_left + translation_m. In a rectified rig, translation_m[0] is minus the
            baseline.
        size_px: Picture width and height; None if the file does not state them.
        name: Name of the rig in error messages, such as its file name.
        notes: Notes on assumptions made about the file.
    """

    left: Optics
    right: Optics
    rotation: Float[np.ndarray, "3 3"]
    translation_m: Float[np.ndarray, "3"]
    size_px: Size | None = None
    name: str = "the calibration"
    notes: tuple[Note, ...] = ()

    def __post_init__(self) -> None:
        off = np.abs(self.rotation @ self.rotation.T - np.eye(3)).max()
        if not (off < _ROUNDED and np.linalg.det(self.rotation) > 0):
            raise StereoweaveError(
                f"{self.name}: expected a rotation matrix from the left camera to the right one, "
                f"found {self.rotation.round(4).tolist()}"
            )
        if not 0 < np.linalg.norm(self.translation_m) < CAMERA_NUMBERS_BELOW:
            raise StereoweaveError(
                f"{self.name}: expected cameras at two positions less than {CAMERA_NUMBERS_BELOW:g} m apart, "
                f"found the translation {self.translation_m.tolist()}"
            )
        if self.size_px is not None and min(self.size_px) < 1:
            raise StereoweaveError(
                f"{self.name}: expected a picture width and height of at least 1, found {self.size_px}"
            )

    @property
    def baseline_m(self) -> float:
        """Distance between the two cameras in metres."""
        return float(np.linalg.norm(self.translation_m))

    def digest(self) -> str:
        """Return a fingerprint of the numbers, which differs between any two calibrations."""
        optics = [(side.matrix, side.distortion, side.fisheye) for side in (self.left, self.right)]
        numbers = [*optics[0], *optics[1], self.rotation, self.translation_m, self.size_px or ()]
        return hashlib.sha256(repr([np.asarray(each).tolist() for each in numbers]).encode()).hexdigest()

    @property
    def rotation_degrees(self) -> float:
        """Angle between the orientations of the two cameras."""
        return float(np.degrees(np.linalg.norm(cv2.Rodrigues(self.rotation)[0])))

    def unlike_rectified(self) -> str | None:
        """Return why the rig's pictures are not rectified, in a few words; None if they are rectified."""
        left, right = self.left.matrix, self.right.matrix
        if any(optics.fisheye or optics.distortion.any() for optics in (self.left, self.right)):
            return "lenses with distortion"
        if np.abs(self.rotation - np.eye(3)).max() > _ROTATION_OFF:
            return f"cameras rotated by {self.rotation_degrees:.2f} degrees relative to each other"
        aside = self.translation_m / self.baseline_m
        if np.abs(aside - (-1, 0, 0)).max() > _SAME_DIRECTION:
            return "a right camera that is not exactly to the right of the left one"
        if np.abs((left - right)[[0, 1, 1], [0, 1, 2]]).max() > _SAME_PX:
            return "cameras with different focal lengths or with principal points in different rows"
        if abs(left[0, 0] - left[1, 1]) > _SQUARE * left[0, 0]:
            return "pixels that are not square"
        return None

    def camera(self) -> StereoCamera:
        """Return the stereo camera of a rectified rig.

        Raises:
            StereoweaveError: The rig is not rectified.
        """
        unlike = self.unlike_rectified()
        if unlike:
            raise StereoweaveError(
                f"{self.name}: expected a calibration of rectified pictures, found {unlike}; "
                "rectify the pictures with it first"
            )
        left, right = self.left.matrix, self.right.matrix
        return StereoCamera(
            focal_px=float(left[0, 0]),
            baseline_m=self.baseline_m,
            cx_px=float(left[0, 2]),
            cy_px=float(left[1, 2]),
            # Rounded, so that the subtraction does not turn a file's 31.086 into 31.086000000000013.
            doffs_px=round(float(right[0, 2] - left[0, 2]), 9),
        )

    def check_size(self, size_px: Size) -> None:
        """Raise FormatError if the rig is for pictures of a different size."""
        if self.size_px not in (None, size_px):
            raise FormatError(
                f"{self.name}: expected a calibration for pictures of {format_size(size_px)}, found one for "
                f"{format_size(self.size_px)}; resize the pictures to that size, or calibrate at their size"
            )


def pair_size_px(pair: StereoPair) -> Size:
    """Return the width and height of a pair's images."""
    return pair.left.shape[1], pair.left.shape[0]


def format_size(size_px: Size | None) -> str:
    """Format a size as WIDTHxHEIGHT, such as 640x480."""
    return "unknown size" if size_px is None else f"{size_px[0]}x{size_px[1]}"


def rectified_rig(pair: StereoPair) -> Rig:
    """Return the rig of a rectified pair whose camera is known."""
    camera = pair.camera
    if camera is None:
        raise StereoweaveError(
            "expected a pair whose camera is known, found an unknown camera; give a calibration"
        )
    focal_px, cx_px, cy_px = camera.focal_px, camera.cx_px, camera.cy_px
    left = np.array([[focal_px, 0, cx_px], [0, focal_px, cy_px], [0, 0, 1]], np.float64)
    right = left + np.array([[0, 0, camera.doffs_px], [0, 0, 0], [0, 0, 0]])
    return replace(make_rectified_rig(left, right, -camera.baseline_m), size_px=pair_size_px(pair))


def make_rectified_rig(
    left: Float[np.ndarray, "3 n"], right: Float[np.ndarray, "3 n"], aside_m: float
) -> Rig:
    """Return a rectified rig from the first three columns of two camera or projection matrices.

    `aside_m` is the x translation from the left camera to the right one: minus the baseline.
    """
    return Rig(
        left=Optics(matrix=left[:, :3], distortion=np.zeros(0)),
        right=Optics(matrix=right[:, :3], distortion=np.zeros(0)),
        rotation=np.eye(3),
        translation_m=np.array([aside_m, 0, 0]),
    )
