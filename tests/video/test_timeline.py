"""The timeline shows depth, cuts and defects in their places; columns and rows worked out by hand."""

from fractions import Fraction

import numpy as np
import pytest

from stereoweave.rendering.comfort import Depth
from stereoweave.video import timeline
from stereoweave.video.frame_check import FrameCheck
from stereoweave.video.timeline import draw_timeline, shorten
from stereoweave.video.video_check import ShotCheck, VideoCheck

# Time runs from column 120 to column 1570: 145 px a second in a video of ten seconds.
FIRST_PX, PX_PER_S = 120, 145
STRIP_ROW, LEFT_ROW, RIGHT_ROW = 156, 558, 576


def shot(start_s: int, end_s: int, near_px: float, far_px: float, **found) -> ShotCheck:
    depth = Depth(near_px, far_px, far_px)
    time = Fraction(start_s + end_s, 2)
    return ShotCheck(
        start_s=Fraction(start_s),
        end_s=Fraction(end_s),
        frames=25 * (end_s - start_s),
        samples=(FrameCheck(time=time, depth=depth, rows_px=0.0, **found),),
        thumbnail=np.full((90, 160, 3), 77, np.uint8),
        depth=depth,
        width_px=1000,
    )


@pytest.fixture(scope="module")
def picture() -> np.ndarray:
    first = shot(0, 4, 0.0, -20.0, exposure_stops=0.0)
    second = shot(4, 10, 40.0, 20.0, windows_px=(30.0, 0.0), defects=("swapped",))
    return draw_timeline(VideoCheck(shots=(first, second), notes=()), "video", "phone")


def column(time_s: float) -> int:
    return round(FIRST_PX + PX_PER_S * time_s)


def test_the_strip_is_green_for_sound_shots_and_red_for_others(picture):
    assert tuple(picture[STRIP_ROW, column(1)]) == timeline._GOOD
    assert tuple(picture[STRIP_ROW, column(5)]) == timeline._BAD
    assert tuple(picture[STRIP_ROW, column(9)]) == timeline._BAD


def test_what_a_border_cuts_off_is_red_while_it_does(picture):
    assert tuple(picture[LEFT_ROW, column(7)]) == timeline._BAD
    assert tuple(picture[LEFT_ROW, column(2)]) == timeline._FAINT
    assert tuple(picture[RIGHT_ROW, column(7)]) == timeline._FAINT


def test_the_band_is_where_the_depth_is(picture):
    # The axis goes from -4 % to +4.4 % (a percent beyond the phone's budget), with a margin of 6 % of 8.4 %.
    least, most = -4 - 0.504, 4.4 + 0.504
    row = {percent: round(222 + (percent - least) / (most - least) * 318) for percent in (-2.8, 1.2, 3.7)}
    assert tuple(picture[row[-2.8], column(7)]) == timeline._BAND
    assert tuple(picture[row[1.2], column(1)]) == timeline._BAND
    assert tuple(picture[row[1.2], column(7)]) == timeline._ZONE
    assert tuple(picture[row[-2.8], column(1)]) == timeline._WHITE
    assert tuple(picture[row[3.7], column(7)]) == timeline._WHITE


def test_a_cut_is_a_line(picture):
    assert (picture[600:620, column(4) - 1 : column(4) + 2].min((1, 2)) < 200).all()


def test_a_shot_has_its_picture(picture):
    assert tuple(picture[100, column(0) + 40]) == (77, 77, 77)


def test_defects_of_one_name_are_named_once():
    assert shorten(["vertical_shift", "not_rectified", "exposure"]) == "rows, exposure"


@pytest.mark.parametrize("count", [1, 400])
def test_one_shot_or_hundreds_are_drawn(count):
    shots = tuple(shot(number, number + 1, 1.0, 0.0) for number in range(count))
    assert draw_timeline(VideoCheck(shots=shots, notes=()), "v", None).shape == (940, 1600, 3)
