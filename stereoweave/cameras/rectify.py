"""Rectification with a calibration."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Shaped

from stereoweave.cameras.content import crop_camera, find_largest_rectangle
from stereoweave.cameras.rig import Optics, Rig, Size, pair_size_px
from stereoweave.errors import Note, StereoweaveError
from stereoweave.stereo import StereoCamera, StereoPair

# Number of samples in the search for the radius at which the distortion polynomial stops growing.
_RADIUS_STEPS = 2000


@dataclass(frozen=True, kw_only=True)
class Rectified:
    """A rectified pair.

    Attributes:
        pair: The pair, with masks that are False outside the source pictures, and with its camera if known.
        notes: Notes on the rectification.
    """

    pair: StereoPair
    notes: tuple[Note, ...] = ()


class RectifiedView:
    """Remap of the pictures of one camera to the rectified camera.

    Args:
        optics: Intrinsics of the camera.
        turn: Rotation from the camera to the rectified one.
        camera: The rectified camera.
        size_px: Width and height of the pictures.

    Attributes:
        seen: Mask [H, W] of the pixels that the camera sees.
    """

    def __init__(
        self, optics: Optics, turn: Float[np.ndarray, "3 3"], camera: StereoCamera, size_px: Size
    ) -> None:
        width, height = size_px
        pinhole = np.array(
            [[camera.focal_px, 0, camera.cx_px], [0, camera.focal_px, camera.cy_px], [0, 0, 1]]
        )
        places = cv2.fisheye.initUndistortRectifyMap if optics.fisheye else cv2.initUndistortRectifyMap
        self._x_px, self._y_px = places(
            optics.matrix, _pad_distortion(optics), turn, pinhole, size_px, cv2.CV_32FC1
        )
        inside = (self._x_px > -0.5) & (self._x_px < width - 0.5)
        inside &= (self._y_px > -0.5) & (self._y_px < height - 0.5)
        self.seen: Bool[np.ndarray, "h w"] = inside & _find_valid_field(
            optics, turn, pinhole, (height, width)
        )

    @property
    def size_px(self) -> Size:
        """Width and height of the results."""
        return self.seen.shape[1], self.seen.shape[0]

    def apply(self, image: Shaped[np.ndarray, "h w 3"]) -> Shaped[np.ndarray, "h2 w2 3"]:
        """Return a picture as the rectified camera sees it.

        The border is repeated outside the picture, so that matching finds no false edge there.
        """
        return cv2.remap(image, self._x_px, self._y_px, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)

    def crop(self, rows: slice, columns: slice) -> "RectifiedView":
        """Return the remap to a rectangle of the results."""
        part = copy.copy(self)
        part._x_px, part._y_px, part.seen = (
            np.ascontiguousarray(each[rows, columns]) for each in (self._x_px, self._y_px, self.seen)
        )
        return part


@dataclass(frozen=True, kw_only=True, eq=False)
class Rectification:
    """Rectification of all pictures that a rig takes.

    Attributes:
        size_px: Width and height of the pictures.
        camera: Camera of the rectified pictures.
        views: Remaps of the left and the right pictures; None if the pictures are rectified as they are.
        notes: Notes on the rig and the rectification.
    """

    size_px: Size
    camera: StereoCamera
    views: tuple[RectifiedView, RectifiedView] | None
    notes: tuple[Note, ...]

    def apply(self, pair: StereoPair) -> Rectified:
        """Rectify a pair; keep the size, and add the camera."""
        if self.views is None:
            return Rectified(pair=replace(pair, camera=self.camera), notes=self.notes)
        left, right = self.views
        rectified = StereoPair(
            left=left.apply(pair.left),
            right=right.apply(pair.right),
            camera=self.camera,
            left_seen=left.seen,
            right_seen=right.seen,
        )
        return Rectified(pair=rectified, notes=self.notes)

    def crop(self) -> "Rectification":
        """Return the rectification to the largest rectangle that both cameras see, of even sides."""
        if self.views is None:
            return self
        left, right = self.views
        rows, columns = (
            slice(side.start, side.stop - (side.stop - side.start) % 2)
            for side in find_largest_rectangle(left.seen & right.seen)
        )
        return replace(
            self,
            camera=crop_camera(self.camera, rows, columns),
            views=(left.crop(rows, columns), right.crop(rows, columns)),
        )


def rectify(pair: StereoPair, rig: Rig) -> Rectified:
    """Rectify a pair to two parallel pinhole cameras; keep the size, and add the camera.

    Raises the errors of `plan_rectification`.
    """
    return plan_rectification(rig, pair_size_px(pair)).apply(pair)


def plan_rectification(rig: Rig, size_px: Size) -> Rectification:
    """Plan the rectification of pictures of this width and height to two parallel pinhole cameras.

    Both cameras are rotated to a common direction, between their own directions and perpendicular to the
    baseline. The new focal length is the mean of both focal lengths, to preserve the resolution in the
    middle. Both views share one principal point (doffs 0), chosen to keep most of each view visible. If the
    rig is already rectified, the pictures do not change.

    Raises:
        FormatError: The rig is for pictures of a different size.
        StereoweaveError: The right camera is not to the right of the left one, or the cameras look in such
            different directions that no common view is left.
    """
    rig.check_size(size_px)
    _check_side_by_side(rig)
    if rig.unlike_rectified() is None:
        note = Note(f"{rig.name} is a calibration of rectified pictures, so they are left unchanged")
        return Rectification(size_px=size_px, camera=rig.camera(), views=None, notes=(*rig.notes, note))
    # Values that cannot be computed become NaN or infinity and are rejected later.
    with np.errstate(all="ignore"):
        turns = _find_rotations(rig)
        camera = _choose_camera(rig, turns, size_px)
    left = RectifiedView(rig.left, turns[0], camera, size_px)
    right = RectifiedView(rig.right, turns[1], camera, size_px)
    if not (left.seen.any() and right.seen.any()):
        raise StereoweaveError(
            f"{rig.name}: expected two cameras with a common view, found that "
            f"{'the right' if left.seen.any() else 'the left'} one does not see it; check the rotation"
        )
    note = _summarize(rig, turns, left.seen & right.seen)
    return Rectification(size_px=size_px, camera=camera, views=(left, right), notes=(*rig.notes, note))


def _check_side_by_side(rig: Rig) -> None:
    x, y, z = _find_right_centre(rig)
    aside = max(
        (abs(x), "beside"), (abs(y), "below" if y > 0 else "above"), (abs(z), "in front of or behind")
    )[1]
    if aside != "beside":
        raise StereoweaveError(
            f"{rig.name}: expected two cameras side by side, found the right one {aside} the left one "
            f"({x:.3f} m to the right, {y:.3f} m down, {z:.3f} m forward); "
            "if one camera is above the other, rotate the pictures by 90 degrees and calibrate again"
        )
    if x < 0:
        raise StereoweaveError(
            f"{rig.name}: expected the right camera on the right, found it {-x:.3f} m to the left "
            "of the left one: left and right are swapped; swap the pictures and calibrate again"
        )


def _find_right_centre(rig: Rig) -> Float[np.ndarray, "3"]:
    """Return the right camera's position relative to the left one in metres: x right, y down, z forward."""
    return -rig.rotation.T @ rig.translation_m


def _find_rotations(rig: Rig) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3 3"]]:
    """Return the rotations from the left and the right camera to the rectified cameras."""
    aside = _find_right_centre(rig) / rig.baseline_m
    ahead = np.array([0, 0, 1]) + rig.rotation[2]  # sum of both cameras' viewing directions
    ahead -= ahead @ aside * aside
    ahead /= np.linalg.norm(ahead)
    turn = np.stack([aside, np.cross(ahead, aside), ahead])
    return turn, turn @ rig.rotation.T


def _choose_camera(rig: Rig, turns: Sequence[Float[np.ndarray, "3 3"]], size_px: Size) -> StereoCamera:
    """Choose the rectified camera so that both source pictures are, on average, centred in the result."""
    lenses = rig.left, rig.right
    focal_px = float(np.mean([optics.matrix[[0, 1], [0, 1]] for optics in lenses]))
    middle_px = (np.array(size_px) - 1) / 2
    ahead = [turn @ _find_direction(optics, middle_px) for optics, turn in zip(lenses, turns, strict=True)]
    if not all(np.isfinite(direction).all() and direction[2] > 0 for direction in ahead):
        raise StereoweaveError(
            f"{rig.name}: expected two cameras that face the same way, found them rotated by "
            f"{rig.rotation_degrees:.0f} degrees relative to each other; check the rotation"
        )
    aside, down = np.mean([direction[:2] / direction[2] for direction in ahead], axis=0)
    return StereoCamera(
        focal_px=focal_px,
        baseline_m=rig.baseline_m,
        cx_px=float(middle_px[0] - focal_px * aside),
        cy_px=float(middle_px[1] - focal_px * down),
    )


def _find_direction(optics: Optics, at_px: Float[np.ndarray, "2"]) -> Float[np.ndarray, "3"]:
    """Return the viewing direction of a pixel as x, y and z, where z is 1."""
    undistort = cv2.fisheye.undistortPoints if optics.fisheye else cv2.undistortPoints
    (x, y), *_ = undistort(at_px.reshape(1, 1, 2), optics.matrix, _pad_distortion(optics)).reshape(-1, 2)
    return np.array([x, y, 1])


def _find_valid_field(
    optics: Optics, turn: Float[np.ndarray, "3 3"], pinhole: Float[np.ndarray, "3 3"], shape: tuple[int, int]
) -> Bool[np.ndarray, "h w"]:
    """Return the mask of pixels in front of the camera and within the radius where the lens model is valid.

    The distortion polynomial is fitted only inside the picture. Farther out it may decrease, and the parts
    near the border would then appear again, mirrored.
    """
    rows, columns = np.indices(shape, np.float32)
    to_direction = (turn.T @ np.linalg.inv(pinhole)).astype(np.float32)
    x, y, z = (row[0] * columns + row[1] * rows + row[2] for row in to_direction)
    radius = np.hypot(x, y)
    if optics.fisheye:
        return np.arctan2(radius, z) < _find_fold(optics, np.pi)
    return (z > 0) & (radius < _find_fold(optics, 10.0) * z)


@np.errstate(all="ignore")  # values that cannot be computed count as not growing
def _find_fold(optics: Optics, most: float) -> float:
    """Return the radius (fisheye: angle), at most `most`, at which the distorted radius stops growing."""
    radius = np.linspace(0, most, _RADIUS_STEPS)
    squares = radius**2
    k = _pad_distortion(optics)
    if optics.fisheye:
        distorted = radius * (1 + squares * (k[0] + squares * (k[1] + squares * (k[2] + squares * k[3]))))
    else:
        k = np.concatenate([k, np.zeros(8)])
        above = 1 + squares * (k[0] + squares * (k[1] + squares * k[4]))
        distorted = radius * above / (1 + squares * (k[5] + squares * (k[6] + squares * k[7])))
    falls = np.flatnonzero(~(np.diff(distorted) > 0))
    return float(radius[falls[0]]) if falls.size else most


def _pad_distortion(optics: Optics) -> Float[np.ndarray, " n"]:
    """Return the distortion coefficients; four zeros if there are none, as OpenCV's functions require."""
    return optics.distortion if optics.distortion.size else np.zeros(4)


def _summarize(rig: Rig, turns: Sequence[Float[np.ndarray, "3 3"]], seen: Bool[np.ndarray, "h w"]) -> Note:
    left, right = (np.degrees(np.linalg.norm(cv2.Rodrigues(turn)[0])) for turn in turns)
    return Note(
        f"rectified with {rig.name}: left picture rotated by {left:.2f} degrees, right picture by "
        f"{right:.2f}; {100 * seen.mean():.0f} % of the pixels are valid in both"
    )
