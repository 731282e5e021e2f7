"""Plain versions of the kernels that take each pixel of a frame from one of two other frames."""

import numpy as np

from stereoweave.video.carried_kernels import MOST_LEVELS, RADIUS_PX
from stereoweave.video.temporal_kernels import SAME_PX, SAME_SHARE


def _window(image, row, column):
    """Return the window around a pixel, with repeated borders."""
    offsets = np.arange(-RADIUS_PX, RADIUS_PX + 1)
    rows = np.clip(row + offsets, 0, image.shape[0] - 1)
    columns = np.clip(column + offsets, 0, image.shape[1] - 1)
    return image[np.ix_(rows, columns)].astype(float)


def _matched_window(image, row, place):
    whole = int(np.floor(place))
    first, second = _window(image, row, whole), _window(image, row, whole + 1)
    return first + (place - whole) * (second - first)


def plain_take(own, other, towards, sources, share, weights):
    """Return disparity and confidence of the view `own`; see `carried_kernels.take_pixels`."""
    found = np.empty((2, *own.shape))
    for y, x in np.ndindex(own.shape):
        here = _window(own, y, x)
        weight = weights[np.abs(here - own[y, x]).astype(int)]
        values, apart = [], []
        for grey, disparity_px, confidence, places in sources:
            row, column = divmod(int(places[y, x]), own.shape[1])
            values.append(np.array([disparity_px[row, column], confidence[row, column]], float))
            shown = [_window(grey, row, column), _matched_window(other, y, x + towards * values[-1][0])]
            apart.append(sum((weight * np.minimum(np.abs(here - each), MOST_LEVELS)).sum() for each in shown))
        (from_px, _), (to_px, _) = values
        part = share
        if abs(to_px - from_px) > SAME_PX + SAME_SHARE * abs(from_px):
            part = 0.0 if apart[0] <= apart[1] else 1.0
        found[:, y, x] = values[0] + part * (values[1] - values[0])
    return found


def plain_locate(flow_px, follows, source):
    """Return the index of the pixel of another frame that each pixel shows; see `carried_kernels.locate`."""
    places = source.copy()
    height, width = source.shape
    for y, x in np.ndindex(source.shape):
        if source[y, x] < 0 or not follows[y // 2, x // 2]:
            column, row = (np.array([x, y]) + np.rint(flow_px[y // 2, x // 2])).astype(int)
            places[y, x] = np.clip(row, 0, height - 1) * width + np.clip(column, 0, width - 1)
    return places
