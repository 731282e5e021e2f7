"""Conversion between ROS 2 messages and Stereoweave's arrays; only accesses fields, and needs no ROS."""

from array import array
from typing import Any

import numpy as np

from stereoweave.stereo import Estimate, StereoCamera

# Encodings of sensor_msgs/Image: number of channels, and the indices of red, green and blue.
_ENCODINGS = {
    "rgb8": (3, [0, 1, 2]),
    "bgr8": (3, [2, 1, 0]),
    "rgba8": (4, [0, 1, 2]),
    "bgra8": (4, [2, 1, 0]),
    "mono8": (1, [0, 0, 0]),
}
_FLOAT32 = 7  # sensor_msgs/PointField.FLOAT32
_POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4")])


def rgb_of(image: Any) -> np.ndarray:
    """Convert a sensor_msgs/Image to uint8 RGB [H, W, 3]; its rows may end in padding."""
    if image.encoding not in _ENCODINGS:
        raise ValueError(f"expected an image of {', '.join(_ENCODINGS)}, found {image.encoding!r}")
    channels, colours = _ENCODINGS[image.encoding]
    rows = np.frombuffer(image.data, np.uint8).reshape(image.height, image.step)
    pixels = rows[:, : image.width * channels].reshape(image.height, image.width, channels)
    return np.ascontiguousarray(pixels[..., colours])


def camera_of(left_info: Any, right_info: Any) -> StereoCamera:
    """Convert two sensor_msgs/CameraInfo: P is fx 0 cx Tx, 0 fy cy 0, 0 0 1 0; on the right, Tx = -fx B."""
    left, right = left_info.p, right_info.p
    if not (left[0] > 0 and right[3] < 0):
        raise ValueError(
            "expected CameraInfo of a calibrated stereo pair, P[0] > 0 left and P[3] < 0 right, "
            f"found {left[0]:g} and {right[3]:g}; is it the right camera's that came second?"
        )
    return StereoCamera(
        focal_px=float(left[0]),
        baseline_m=float(-right[3] / right[0]),
        cx_px=float(left[2]),
        cy_px=float(left[6]),
        doffs_px=float(right[2] - left[2]),
    )


def known_of(estimate: Estimate, least_confidence: float) -> np.ndarray:
    """Mask of the left image's pixels with a reliable disparity, bool [H, W]."""
    return (estimate.confidence >= least_confidence) & ~estimate.occluded


def depth_of(estimate: Estimate, camera: StereoCamera, known: np.ndarray) -> np.ndarray:
    """Compute depth in metres, float32 [H, W], after REP 118: NaN where unknown, +inf where too far away."""
    return np.where(known, camera.depth_m(estimate.disparity_px), np.nan).astype(np.float32)


def fill_image(message: Any, header: Any, values: np.ndarray) -> None:
    """Fill a sensor_msgs/Image of encoding 32FC1 from float32 [H, W]."""
    message.header = header
    message.height, message.width = values.shape
    message.encoding, message.is_bigendian, message.step = "32FC1", 0, 4 * values.shape[1]
    message.data = _bytes(values.astype("<f4"))


def fill_disparity(  # noqa: PLR0913 - what a message needs
    message: Any,
    header: Any,
    estimate: Estimate,
    camera: StereoCamera,
    known: np.ndarray,
    range_px: tuple[float, float],
) -> None:
    """Fill a stereo_msgs/DisparityImage from an estimate with disparities in range_px.

    The message's disparities d include doffs, so that depth is f T / d. Unknown ones are below min_disparity.
    """
    least_px, most_px = (float(end_px + camera.doffs_px) for end_px in range_px)
    shifted_px = estimate.disparity_px + camera.doffs_px
    valid = known & (shifted_px >= least_px) & (shifted_px <= most_px)
    message.header = header
    fill_image(message.image, header, np.where(valid, shifted_px, least_px - 1))
    message.f, message.t = camera.focal_px, camera.baseline_m
    message.min_disparity, message.max_disparity, message.delta_d = least_px, most_px, 1 / 16
    window = message.valid_window
    window.x_offset, window.y_offset = 0, 0
    window.height, window.width = estimate.disparity_px.shape
    window.do_rectify = False


def fill_cloud(  # noqa: PLR0913 - what a message needs
    message: Any, new_field: Any, header: Any, rgb: np.ndarray, depth_m: np.ndarray, camera: StereoCamera
) -> None:
    """Fill a sensor_msgs/PointCloud2 with the image's rows and columns: x right, y down, z forward, and rgb.

    A point without a finite depth is NaN. `new_field` creates an empty sensor_msgs/PointField.
    """
    height, width = depth_m.shape
    rows, columns = np.indices(depth_m.shape, np.float32)
    points = np.empty(depth_m.shape, _POINT)
    points["z"] = np.where(np.isfinite(depth_m), depth_m, np.nan)
    points["x"] = (columns - camera.cx_px) / camera.focal_px * points["z"]
    points["y"] = (rows - camera.cy_px) / camera.focal_px * points["z"]
    red, green, blue = np.moveaxis(rgb.astype(np.uint32), 2, 0)
    points["rgb"] = red << 16 | green << 8 | blue  # PCL's packing: readers take it as float32
    message.header = header
    message.height, message.width = height, width
    message.fields = [_field(new_field(), name, 4 * at) for at, name in enumerate(_POINT.names or ())]
    message.is_bigendian, message.is_dense = False, False
    message.point_step, message.row_step = _POINT.itemsize, _POINT.itemsize * width
    message.data = _bytes(points)


def _field(field: Any, name: str, offset: int) -> Any:
    field.name, field.offset, field.datatype, field.count = name, offset, _FLOAT32, 1
    return field


def _bytes(values: np.ndarray) -> array:
    # rclpy checks every element of bytes or a list, but takes an array unchecked.
    return array("B", values.tobytes())
