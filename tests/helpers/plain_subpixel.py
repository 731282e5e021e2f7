"""Plain NumPy and OpenCV reference of `subpixel_kernels`, on whole arrays."""

import cv2
import numpy as np


def plain_smooth(padded_px, nearness, same_px):
    """Return the mean of the disparities around each pixel, weighted by nearness and similarity."""
    rows, columns = nearness.shape
    height, width = padded_px.shape[0] - rows + 1, padded_px.shape[1] - columns + 1
    own_px = padded_px[rows // 2 :, columns // 2 :][:height, :width]
    weights, sums_px = np.zeros(own_px.shape), np.zeros(own_px.shape)
    for (v, u), near in np.ndenumerate(nearness):
        other_px = padded_px[v : v + height, u : u + width]
        weight = near * np.clip(1 - (other_px - own_px) ** 2 / (32 * same_px**2), 0, None) ** 16
        weights += weight
        sums_px += weight * other_px
    return sums_px / weights


def plain_compare(here, there, given_px, smooth_px, same_px, gain):
    """Return the disparities from which to start, and the means [H / 2, 4, W / 2] of the comparison."""
    fine_px = _enlarge(smooth_px)
    start_px = np.where(np.abs(fine_px - given_px) < same_px, fine_px, given_px)
    difference = gain * _warp(there, start_px) - here
    wide = np.pad(here.astype(float), ((0, 0), (2, 2)), "edge")
    slope = (8 * (wide[:, 3:-1] - wide[:, 1:-3]) - (wide[:, 4:] - wide[:, :-4])) / 12
    height, width = here.shape
    values = np.stack([slope, difference, slope * difference, slope**2])
    return start_px, values.reshape(4, height // 2, 2, width // 2, 2).mean((2, 4)).swapaxes(0, 1)


def plain_change(given_px, start_px, change_px, occluded, largest_px, least_px):
    """Return the changed disparities."""
    found_px = np.clip(start_px + _enlarge(change_px), given_px - largest_px, given_px + largest_px)
    return np.where(occluded, given_px, np.maximum(found_px, least_px))


def _enlarge(values):
    return cv2.resize(values, None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR)


def _warp(image, disparity_px):
    """Return the levels of the image at x - disparity, by cubic interpolation."""
    width = image.shape[1]
    columns = np.clip(np.arange(width) - disparity_px, 0, width - 1)
    first = columns.astype(int)
    t = columns - first
    weights = [_weigh(t + 1), _weigh(t), _weigh(1 - t), _weigh(2 - t)]
    places = [np.clip(first + i, 0, width - 1) for i in range(-1, 3)]
    return sum(w * np.take_along_axis(image, x, 1) for w, x in zip(weights, places, strict=True))


def _weigh(distance):
    """Return the weight of a pixel at a distance up to 2, Keys' cubic of a = -0.75."""
    near = 1.25 * distance**3 - 2.25 * distance**2 + 1
    far = -0.75 * (distance**3 - 5 * distance**2 + 8 * distance - 4)
    return np.where(distance <= 1, near, far)
