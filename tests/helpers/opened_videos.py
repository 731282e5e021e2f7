"""Shared by the tests of opening videos: what their frames show, and why others are refused."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import pytest
from video_examples import Pair

from stereoweave.errors import StereoweaveError
from stereoweave.video.reader import StereoFrame, open_video


def assert_eyes(
    frames: Iterable[StereoFrame], pairs: Sequence[Pair], tolerance: float = 0.0
) -> list[StereoFrame]:
    """Assert that each eye differs from the expected image by at most `tolerance` levels on average."""
    frames = list(frames)
    assert len(frames) == len(pairs)
    for frame, expected in zip(frames, pairs, strict=True):
        for eye, image in zip(frame[:2], expected, strict=True):
            assert eye.shape == image.shape
            assert np.abs(eye.astype(int) - image).mean() <= tolerance
    return frames


def refusal(*paths: Path, **options: object) -> str:
    """Return the one line by which videos are refused."""
    with pytest.raises(StereoweaveError) as caught:
        open_video(paths, **options)
    message = str(caught.value)
    assert "\n" not in message
    return message


def refusal_by_name(path: Path, format: str | None = None) -> str:
    """Return the one line by which a video is refused, which names it."""
    message = refusal(path, format=format)
    assert str(path) in message
    return message
