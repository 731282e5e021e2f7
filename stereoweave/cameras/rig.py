"""How two cameras see and stand; `calibration_files` reads it, and writes it."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float

from stereoweave.errors import FormatError, Note, StereoweaveError
from stereoweave.stereo import CAMERA_NUMBERS_BELOW, StereoCamera, StereoPair

# How many coefficients OpenCV's models have; 0 is a lens without distortion.
_PINHOLE_COUNTS, _FISHEYE_COUNTS = (0, 4, 5, 8, 12, 14), (0, 4)
# Of the smallest pictures, 32 px wide, that is a view of 173 degrees.
_LEAST_FOCAL_PX = 1
# Files with few decimals are let through: over a picture of 4000 px these are some hundredths of a pixel.
_ROTATION_OFF, _SAME_PX, _SAME_DIRECTION = 1e-5, 1e-2, 1e-3
_ROUNDED = 1e-3

Size = tuple[int, int]


@dataclass(frozen=True, kw_only=True)
class Optics:
    """What a camera makes of a direction: a point x, y, z in front of it (right, down, forward) to a pixel.

    Attributes:
        matrix: [3, 3], focal lengths in px, and the principal point, of a picture whose pixel centres are
            integers; without skew.
        distortion: [N] coefficients as OpenCV orders them: k1 k2 p1 p2 k3 and so on (N of 0, 4, 5, 8, 12
            or 14), of a fisheye lens k1 k2 k3 k4 (0 or 4).
        fisheye: Whether the lens is Kannala and Brandt's, OpenCV's fisheye and Kalibr's `equidistant`.
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
                f"expected {' or '.join(map(str, counts))} distortion coefficients of a "
                f"{'fisheye' if self.fisheye else 'pinhole'} lens, found {self.distortion.size}"
            )


@dataclass(frozen=True, kw_only=True)
class Rig:
    """Two cameras on one mount.

    Attributes:
        left, right: What each sees.
        rotation, translation_m: From the left camera to the right one, in OpenCV's convention: a point is at
            rotation @ x + translation_m for the right camera that is at x for the left one; so of two cameras
            side by side translation_m[0] is minus the baseline.
        size_px: Width and height of the pictures that it is for; None where the file does not say.
        name: What errors call it, such as its file.
        notes: What the file does not state, and what was assumed.
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
                f"{self.name}: expected cameras at two places within {CAMERA_NUMBERS_BELOW:g} m, "
                f"found the translation {self.translation_m.tolist()}"
            )
        if self.size_px is not None and min(self.size_px) < 1:
            raise StereoweaveError(
                f"{self.name}: expected a picture's width and height, found {self.size_px}"
            )

    @property
    def baseline_m(self) -> float:
        """How far the cameras are apart."""
        return float(np.linalg.norm(self.translation_m))

    @property
    def rotation_degrees(self) -> float:
        """By what angle the one camera is turned against the other."""
        return float(np.degrees(np.linalg.norm(cv2.Rodrigues(self.rotation)[0])))

    def unlike_rectified(self) -> str | None:
        """Why rows of its pictures do not match as they are, in a few words; None where they do."""
        left, right = self.left.matrix, self.right.matrix
        if any(optics.fisheye or optics.distortion.any() for optics in (self.left, self.right)):
            return "lenses that distort"
        if np.abs(self.rotation - np.eye(3)).max() > _ROTATION_OFF:
            return f"cameras turned by {self.rotation_degrees:.2f} degrees against each other"
        aside = self.translation_m / self.baseline_m
        if np.abs(aside - (-1, 0, 0)).max() > _SAME_DIRECTION:
            return "a right camera that is not straight to the right of the left one"
        if np.abs((left - right)[[0, 1, 1], [0, 1, 2]]).max() > _SAME_PX:
            return "cameras of two focal lengths or heights of the centre"
        return None

    def camera(self) -> StereoCamera:
        """The camera of a rig whose pictures are rectified already; StereoweaveError for any other rig."""
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
            # Rounded, so that a file's 31.086 is not 31.086000000000013 for being a difference.
            doffs_px=round(float(right[0, 2] - left[0, 2]), 9),
        )

    def check_size(self, pair: StereoPair) -> None:
        """Raise a FormatError where it is for pictures of another size than those of the pair."""
        size_px = pair_size_px(pair)
        if self.size_px not in (None, size_px):
            raise FormatError(
                f"{self.name}: expected a calibration for pictures of {format_size(size_px)}, found one for "
                f"{format_size(self.size_px)}; focal length, centre and doffs grow with the picture: "
                "bring the pictures to that size, or calibrate at theirs"
            )


def pair_size_px(pair: StereoPair) -> Size:
    """Width and height of the pictures of a pair."""
    return pair.left.shape[1], pair.left.shape[0]


def format_size(size_px: Size | None) -> str:
    """A size as people write it, 640x480."""
    return "unknown size" if size_px is None else f"{size_px[0]}x{size_px[1]}"


def rectified_rig(pair: StereoPair) -> Rig:
    """The rig of a rectified pair whose camera is known."""
    camera = pair.camera
    if camera is None:
        raise StereoweaveError("expected a pair whose camera is known, found none; give it a calibration")
    focal_px, cx_px, cy_px = camera.focal_px, camera.cx_px, camera.cy_px
    left = np.array([[focal_px, 0, cx_px], [0, focal_px, cy_px], [0, 0, 1]], np.float64)
    right = left + np.array([[0, 0, camera.doffs_px], [0, 0, 0], [0, 0, 0]])
    return replace(make_rectified_rig(left, right, -camera.baseline_m), size_px=pair_size_px(pair))


def make_rectified_rig(
    left: Float[np.ndarray, "3 n"], right: Float[np.ndarray, "3 n"], aside_m: float
) -> Rig:
    """The rig of rectified pictures; what a matrix says beyond its third column is not looked at."""
    return Rig(
        left=Optics(matrix=left[:, :3], distortion=np.zeros(0)),
        right=Optics(matrix=right[:, :3], distortion=np.zeros(0)),
        rotation=np.eye(3),
        translation_m=np.array([aside_m, 0, 0]),
    )
