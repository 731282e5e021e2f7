"""The newest frame of a conversion: its small pictures, how they reach the page, and what they may cost."""

import io
import os
import time
from fractions import Fraction
from functools import partial

import numpy as np
import pytest
from PIL import Image

from stereoweave.app.newest_frame import FramePictures, FrameShower, NewestFrame, make_pictures
from stereoweave.app.video_outputs import OUTPUTS
from stereoweave.io.colormap import colour_disparity
from stereoweave.stereo import Estimate, StereoPair
from stereoweave.video.converted_frames import ConvertedFrame
from stereoweave.video.frame_renderer import FrameRenderer
from stereoweave.video.job import VideoJob
from stereoweave.video.reader import StereoFrame
from stereoweave.video.survey import Survey

WIDTH, HEIGHT = 960, 540
# The sizes at which pictures are shown, by output: at hand, where the longer side is 640 px, and rendered,
# where the left view is 448 px wide.
SIZES = {
    "depth": ((640, 360), (448, 252)),
    "between": ((640, 360), (448, 252)),
    "side_by_side": ((640, 180), (640, 180)),
    "side_by_side_half": ((640, 360), (448, 252)),
    "crossed": ((640, 180), (640, 180)),
    "top_bottom": ((569, 640), (448, 504)),  # 960x1080
    "anaglyph_dubois": ((640, 360), (448, 252)),
    "rgbd": ((640, 180), (640, 180)),
}


def job_of(output: str) -> VideoJob:
    return VideoJob(**OUTPUTS[output].settings)


def converted(output: str, *, disparity_px: float = 12.0, time_s: float = 0.0, squeezed: bool = False):
    """Return a grey frame of one disparity, converted to an output; `squeezed` for a layout of half width."""
    wide, width = np.full((HEIGHT, WIDTH, 3), 90, np.uint8), WIDTH // 2 if squeezed else WIDTH
    pair = StereoPair(left=wide[:, :width], right=wide[:, :width])
    estimate = Estimate(
        disparity_px=np.full((HEIGHT, width), disparity_px, np.float32),
        right_disparity_px=np.full((HEIGHT, width), disparity_px, np.float32),
        confidence=np.ones((HEIGHT, width), np.float32),
        occluded=np.zeros((HEIGHT, width), bool),
    )
    survey = Survey((0.0, 24.0), 12.0, None)
    picture = FrameRenderer(job_of(output), survey)(pair, estimate)
    frame = StereoFrame(wide, wide, Fraction(time_s), None)
    return ConvertedFrame(frame, pair, estimate, picture, survey)


def opened(jpeg: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(jpeg)))


def middle(jpeg: bytes) -> np.ndarray:
    picture = opened(jpeg)
    return picture[picture.shape[0] // 2, picture.shape[1] // 2].astype(float)


@pytest.mark.parametrize("output", OUTPUTS)
def test_pictures_are_small_whether_the_output_is_at_hand_or_rendered(output):
    at_hand = make_pictures(converted(output), output)
    rendered = make_pictures(converted("depth"), output, job_of(output))
    for pictures, size in zip((at_hand, rendered), SIZES[output], strict=True):
        assert opened(pictures.left).shape == (360, 640, 3)
        assert opened(pictures.made).shape[1::-1] == size


@pytest.mark.parametrize("squeezed", [False, True])
def test_depth_beside_another_output_has_the_colours_of_its_conversion(squeezed):
    # 12 px are the middle of the range, also where both are halved.
    layout = converted("side_by_side_half", squeezed=squeezed)
    depth = make_pictures(layout, "depth", job_of("depth"))
    expected = colour_disparity(np.full((1, 1), 0.5, np.float32), (0.0, 1.0))[0, 0]
    assert opened(depth.made).shape == (252, 448, 3)
    assert np.abs(middle(depth.made) - expected).max() < 6


def test_a_frame_of_a_part_is_named_by_its_time_in_the_whole_video():
    assert make_pictures(converted("depth", time_s=1.5), "depth", begin_s=60.0).time_s == 61.5


def test_a_small_frame_is_not_enlarged():
    whole = converted("depth")
    small = whole.frame._replace(left=whole.frame.left[:96, :160])
    pictures = make_pictures(whole._replace(frame=small, picture=whole.picture[:96, :160]), "depth")
    assert opened(pictures.left).shape == opened(pictures.made).shape == (96, 160, 3)


def test_the_page_reads_each_frame_once(tmp_path):
    of_work, of_page = NewestFrame(tmp_path), NewestFrame(tmp_path)
    assert of_page.read() is None
    for number in (1, 2):
        written = FramePictures(number / 25, "depth", b"left \xff", bytes([number]))
        of_work.write(written)
        assert of_page.read() == written
        assert of_page.read() is None


def test_the_page_reads_two_frames_that_were_written_at_the_same_time(tmp_path):
    of_work, of_page = NewestFrame(tmp_path), NewestFrame(tmp_path)
    for time_s in (0.0, 0.04):
        of_work.write(FramePictures(time_s, "depth", b"left", b"made"))
        os.utime(tmp_path / "newest.json", (1e9, 1e9))
        assert of_page.read().time_s == time_s
        assert of_page.read() is None


def test_a_frame_is_shown_as_the_visitor_asks(tmp_path):
    newest = NewestFrame(tmp_path)
    shower = FrameShower(newest, "depth", job_of)
    shower(converted("depth"))
    assert newest.read().output == "depth"
    newest.ask("side_by_side")
    shower._next_s = 0.0
    shower(converted("depth"))
    shown = newest.read()
    assert shown.output == "side_by_side"
    assert opened(shown.made).shape == (180, 640, 3)


def test_frames_that_follow_at_once_are_left_out(tmp_path):
    newest = NewestFrame(tmp_path)
    shower = FrameShower(newest, "depth", job_of)
    for time_s in (0.0, 0.04):
        shower(converted("depth", time_s=time_s))
    assert newest.read().time_s == 0.0


def test_costly_pictures_are_rare_so_that_they_take_a_tenth_of_a_core(tmp_path):
    def spend(seconds: float, output: str) -> VideoJob:
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            pass
        return job_of(output)

    newest = NewestFrame(tmp_path)
    newest.ask("between")
    shower = FrameShower(newest, "depth", partial(spend, 0.1))
    begin_s = time.monotonic()
    shower(converted("depth"))
    assert shower._next_s - begin_s > 0.1 / 0.1


@pytest.mark.parametrize("wish", ["", "unknown", "../../etc/passwd", "depth\n", "\0", "wiggle", "x" * 9999])
def test_an_odd_wish_does_not_end_the_conversion(tmp_path, wish):
    newest = NewestFrame(tmp_path)
    newest.ask(wish)
    FrameShower(newest, "depth", job_of)(converted("depth"))
    assert (newest.read() is None) == bool(wish)


def test_a_frame_that_cannot_be_shown_does_not_end_the_conversion(tmp_path):
    (tmp_path / "file").write_text("no folder")
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        FrameShower(NewestFrame(folder), "depth", job_of)(converted("depth"))
    whole = converted("depth")
    for odd in (
        whole._replace(picture=None),
        whole._replace(picture=np.zeros((0, 0, 3), np.uint8)),
        whole._replace(frame=None),
        whole._replace(estimate=None),
    ):
        newest = NewestFrame(tmp_path / "odd")
        newest.ask("between")
        FrameShower(newest, "depth", job_of)(odd)
        FrameShower(newest, "between", job_of)(odd)


@pytest.mark.parametrize(
    "content",
    [
        *(b"", b"[", b"[1]", b"{}", b"null", b"[" * 100_000, b'[0, "depth", "\xff", ""]'),
        *(b'[0, %s, "", ""]' % output for output in (b'"unknown"', b'""', b"null", b"7", b"[]", b"{}")),
        *(
            b'[%s, "depth", "", ""]' % time_s
            for time_s in (b'"0"', b"null", b"NaN", b"Infinity", b"-1", b"[0]")
        ),
        b'[1%s, "depth", "", ""]' % (400 * b"0"),
    ],
)
def test_a_damaged_hand_over_shows_no_frame(tmp_path, content):
    (tmp_path / "newest.json").write_bytes(content)
    assert NewestFrame(tmp_path).read() is None


@pytest.mark.parametrize(
    ("time_s", "shown"),
    [(0, "0:00.0"), (59.94, "0:59.9"), (59.97, "1:00.0"), (119.96, "2:00.0"), (3725.25, "62:05.2")],
)
def test_the_page_shows_the_time_of_a_frame_in_minutes_and_seconds(time_s, shown):
    assert FramePictures(time_s, "depth", b"", b"").shown_time == shown


def test_colours_are_those_of_the_frame():
    red = np.zeros((48, 64, 3), np.uint8)
    red[..., 0] = 200
    whole = converted("depth")
    pictures = make_pictures(whole._replace(frame=whole.frame._replace(left=red), picture=red), "depth")
    for jpeg in (pictures.left, pictures.made):
        assert np.abs(middle(jpeg) - (200, 0, 0)).max() < 6
