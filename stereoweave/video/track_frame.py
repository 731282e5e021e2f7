"""A decoded frame of a track."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, UInt8


class TrackFrame(NamedTuple):
    """Decoded frame.

    Attributes:
        number: Index of the frame in the track.
        pictures: Function that converts the frame to uint8 RGB [H, W, 3]; of a spatial video, to the left and
            the right view. It is called only for needed frames.
        is_key_frame: Whether the frame can be decoded without any earlier frame.
        fine_pictures: The same pictures with all their bits and in the file's own colours, from 0 to 255.
    """

    number: int
    pictures: Callable[[], Sequence[UInt8[np.ndarray, "h w 3"]]]
    is_key_frame: bool
    fine_pictures: Callable[[], Sequence[Float32[np.ndarray, "h w 3"]]]
