"""One frame of an uploaded video, and what is said about uploads that have none."""

import io
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from spatial_examples import SPATIAL
from video_examples import example_pairs, flat_pairs, packed, truncate, write_side_by_side, write_video

from experiments.sphere_windows.room import render_turning
from stereoweave.app.still_frame import convert_still
from stereoweave.app.video_tab import label_of
from stereoweave.app.video_upload import VideoUpload
from stereoweave.errors import StereoweaveError
from stereoweave.io.images import write_image
from stereoweave.matching.backend import Backend
from stereoweave.video.reader import open_video

pytestmark = pytest.mark.system


def ask(*files: Path, start_s: float = 0.0, output: str = "depth", format: str | None = None) -> VideoUpload:
    return VideoUpload(
        files=files,
        format=format,
        output=output,
        start_s=start_s,
        backend=Backend(threads=1),
        name_of=label_of,
    )


def show(upload: VideoUpload):
    return convert_still(upload, lambda share, what: None)


def opened(jpeg: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(jpeg))).astype(float)


def test_the_frame_is_that_of_the_time(tmp_path):
    pairs = example_pairs(40, step_px=6)
    video = write_side_by_side(tmp_path / "video.mp4", pairs)
    still = show(ask(video, start_s=1.2, format="side_by_side"))
    assert still.pictures.time_s == 1.2
    assert still.last_s == 1.5  # 39 frames of 40 ms are 1.56 s
    errors = [np.abs(opened(still.pictures.left) - left).mean() for left, _ in pairs]
    assert np.argmin(errors) == 30
    made = opened(still.pictures.made)
    assert made.shape == (96, 160, 3)
    assert made.std() > 20


def test_the_frame_at_the_slider_s_end_is_in_the_video(tmp_path):
    video = write_video(
        tmp_path / "video.mp4",
        [packed(*pair) for pair in example_pairs(5)],
        times_ms=[0, 33, 67, 100, 133],
    )
    last_s = show(ask(video, format="side_by_side")).last_s
    assert show(ask(video, start_s=last_s, format="side_by_side")).pictures.time_s == last_s


def test_a_spatial_video_shows_its_left_view_and_what_was_found(testdata):
    still = show(ask(SPATIAL, start_s=1.0, output="side_by_side"))
    assert opened(still.pictures.left).shape == (192, 320, 3)
    assert opened(still.pictures.made).shape == (192, 640, 3)
    assert [line[:38] for line in still.facts] == ["spatial video (MV-HEVC), left view fir"]
    assert still.warnings == []


@pytest.mark.testdata
def test_a_spatial_video_of_another_writer_is_shown(testdata):
    still = show(ask(testdata / "consumer" / "stereo_spatial.mp4", output="anaglyph_dubois"))
    assert opened(still.pictures.left).shape == opened(still.pictures.made).shape
    assert opened(still.pictures.made).std() > 10


def test_a_window_of_a_360_degree_film_is_not_rectified_as_in_the_conversion(tmp_path):
    scene = render_turning((768, 384))
    left, right = (cv2.GaussianBlur(eye, (0, 0), 2) for eye in (scene.left, np.roll(scene.right, 8, axis=0)))
    film = write_side_by_side(
        tmp_path / "a_360.mp4", [(left, right)] * 2, layout="top_bottom", codec="libx264"
    )
    made = opened(show(ask(film, output="side_by_side", format="top_bottom")).pictures.made)
    read = next(iter(open_video([film], "top_bottom").frames()))
    assert np.abs(made - np.hstack([read.left, read.right])).mean() < 5


def odd_uploads(folder: Path) -> dict[str, VideoUpload]:
    """Write uploads that cannot be shown; return them by what is wrong."""
    sound = write_side_by_side(folder / "sound.mp4", example_pairs(4))
    other = write_side_by_side(folder / "other.mp4", flat_pairs(4))
    one_eye = write_video(folder / "one_eye.mp4", [left for left, _ in example_pairs(4, width=161)])
    files = {
        "empty": b"",
        "text": b"no video",
        "noise": np.random.default_rng(0).bytes(20_000),
        "head alone": sound.read_bytes()[:40],
        "zeros": bytes(20_000),
        "a page": b"<!doctype html><title>Not found</title>",
    }
    for name, content in files.items():
        (folder / f"{name}.mp4").write_bytes(content)
    spatial = truncate_copy(SPATIAL, folder / "cut.mp4", 0.3)
    write_image(folder / "picture.png", example_pairs(1)[0][0])
    return {
        **{name: ask(folder / f"{name}.mp4") for name in files},
        "nothing": ask(),
        "expired": ask(folder / "gone.mp4"),
        "a folder": ask(folder),
        "a picture": ask(folder / "picture.png"),
        "one eye": ask(one_eye),
        "cut before its index": ask(spatial),
        "a packing for a spatial video": ask(SPATIAL, format="crossed"),
        "two sizes": ask(sound, other),
        "two videos and a packing": ask(sound, sound, format="crossed"),
        "after the end": ask(sound, start_s=9.0, format="side_by_side"),
        "before the start": ask(sound, start_s=-1.0),
        "no time": ask(sound, start_s=math.nan),
        "a time without end": ask(sound, start_s=math.inf),
    }


def truncate_copy(path: Path, copy: Path, share: float) -> Path:
    copy.write_bytes(path.read_bytes())
    return truncate(copy, share)


def test_each_odd_upload_is_one_line(tmp_path):
    found = {}
    for name, upload in odd_uploads(tmp_path).items():
        with pytest.raises(StereoweaveError) as raised:
            show(upload)
        found[name] = raised.value.format(label_of)
    assert len(found) == 19
    assert {name: line for name, line in found.items() if "\n" in line or "expected" not in line} == {}
