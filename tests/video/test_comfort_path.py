"""A video's strength and convergence follow its depth smoothly, and over cuts; values worked out by hand."""

import math
from fractions import Fraction

import numpy as np
import pytest

from stereoweave.rendering.comfort import ScreenChoice
from stereoweave.stereo import Estimate
from stereoweave.video.comfort_path import ComfortPath

WIDTH, HEIGHT = 1000, 20
TELEVISION = ScreenChoice(name="television")  # 10 px in front, 20 px behind


def estimate_of(near_px: float, far_px: float, confidence: float = 1.0) -> Estimate:
    """Return the estimate of a wall with a tenth of it nearer, away from the borders."""
    px = np.full((HEIGHT, WIDTH), far_px, np.float32)
    px[:, 400:500] = near_px
    sure = np.full_like(px, confidence)
    return Estimate(disparity_px=px, right_disparity_px=px, confidence=sure, occluded=px > 1e9)


def play(path: ComfortPath, frames, *, rate: int = 25, cuts=(), start: int = 0):
    return [
        path(estimate, Fraction(number, rate), begins_shot=number in cuts)
        for number, estimate in enumerate(frames, start)
    ]


def test_the_first_frame_has_what_a_picture_has():
    (first,) = play(ComfortPath(TELEVISION), [estimate_of(70.0, 10.0)])
    # 60 px in a budget of 30 px; 10 px of them in front: 0.5 * (70 - 50) = 10.
    assert (first.strength, first.convergence_px) == pytest.approx((0.5, 50.0))


def test_convergence_moves_at_most_1_percent_a_second_within_a_shot():
    # From a wall at 10 px to a wall at 60 px: 50 px, 5 % of the width.
    found = play(ComfortPath(TELEVISION), [estimate_of(10.0, 10.0)] + [estimate_of(60.0, 60.0)] * 250)
    planes_px = [frame.convergence_px for frame in found]
    assert planes_px[0] == 10.0
    assert max(np.diff(planes_px)) == pytest.approx(0.01 * WIDTH / 25)
    # 4 s at most at full speed, then slower and slower.
    assert planes_px[75] == pytest.approx(40.0)
    assert planes_px[250] == pytest.approx(60.0, abs=0.1)


def test_strength_falls_faster_than_it_rises():
    deep, flat = estimate_of(70.0, 10.0), estimate_of(10.0, 10.0)
    falling = [frame.strength for frame in play(ComfortPath(TELEVISION), [flat] + [deep] * 100)]
    assert -min(np.diff(falling)) == pytest.approx(0.25 / 25)
    assert falling[-1] == pytest.approx(0.5, abs=0.02)
    rising = [frame.strength for frame in play(ComfortPath(TELEVISION), [deep] + [flat] * 100)]
    assert max(np.diff(rising)) == pytest.approx(0.05 / 25)


def test_a_small_step_has_a_time_constant_of_half_a_second():
    # 2 px, of which the first frame goes 1 - exp(-0.04 / 0.5): 0.15 px, less than the 0.4 px at full speed.
    found = play(ComfortPath(TELEVISION), [estimate_of(10.0, 10.0), estimate_of(12.0, 12.0)])
    assert found[1].convergence_px - 10.0 == pytest.approx(2.0 * (1 - math.exp(-0.08)))


def test_at_a_cut_the_middle_of_the_new_shot_is_where_the_old_one_was():
    # The near end is 15 px before the middle, and 10 px may be in front: the screen is at 15 px, and the
    # middle 5 px behind it. A wall at 40 px then starts 5 px behind the screen, too, and moves to it.
    frames = [estimate_of(25.0, 10.0)] * 3 + [estimate_of(40.0, 40.0)] * 100
    found = play(ComfortPath(TELEVISION), frames, cuts=[3])
    assert [frame.convergence_px for frame in found[:4]] == pytest.approx([15.0, 15.0, 15.0, 45.0])
    assert found[4].convergence_px == pytest.approx(40.0 + 5.0 * math.exp(-0.08))
    assert found[-1].convergence_px == pytest.approx(40.0, abs=0.1)


def test_at_a_cut_the_new_shot_stays_in_the_budget():
    # The middle was 5 px behind the screen; the new shot's near end must not be more than 10 px in front, and
    # its strength is found at once: 60 px in 30 px.
    frames = [estimate_of(25.0, 10.0), estimate_of(70.0, 10.0)]
    found = play(ComfortPath(TELEVISION), frames, cuts=[1])
    assert (found[1].strength, found[1].convergence_px) == pytest.approx((0.5, 50.0))


def test_frames_without_depth_change_nothing_and_the_next_one_begins_the_shot():
    unsure = estimate_of(500.0, -300.0, confidence=0.1)
    frames = [estimate_of(10.0, 10.0), unsure, unsure, estimate_of(40.0, 40.0)]
    found = play(ComfortPath(TELEVISION), frames, cuts=[1])
    assert [frame.convergence_px for frame in found] == [10.0, 10.0, 10.0, 40.0]
    assert [frame.windows_px for frame in found[1:3]] == [(0.0, 0.0)] * 2


def test_a_given_convergence_stays_and_strength_follows():
    path = ComfortPath(ScreenChoice(name="television", convergence_px=30.0))
    found = play(path, [estimate_of(70.0, 10.0), estimate_of(30.0, 30.0)] + [estimate_of(40.0, 40.0)] * 9)
    assert {frame.convergence_px for frame in found} == {30.0}
    # 40 px in front of 30 px may be 10 px.
    assert found[0].strength == 0.25


def test_a_given_strength_stays():
    path = ComfortPath(ScreenChoice(name="television", strength=0.8))
    found = play(path, [estimate_of(70.0, 10.0), estimate_of(30.0, 30.0)], cuts=[1])
    assert [frame.strength for frame in found] == [0.8, 0.8]


def boxes(box_px: float) -> Estimate:
    px = np.zeros((HEIGHT, WIDTH), np.float32)
    px[:, :60] = box_px
    return Estimate(disparity_px=px, right_disparity_px=px, confidence=np.ones_like(px), occluded=px < 0)


def test_windows_follow_within_a_shot_and_change_at_once_at_a_cut():
    frames = [boxes(0.0)] + [boxes(8.0)] * 25 + [boxes(0.0)]
    found = play(ComfortPath(TELEVISION), frames, cuts=[26])
    left_px = [frame.windows_px[0] for frame in found]
    # 8 px in front of the screen, which stays at 0; the first frame goes 1 - exp(-0.04 / 0.2) of it.
    assert left_px[:2] == pytest.approx([0.0, 8 * (1 - math.exp(-0.2))])
    assert left_px[25] == pytest.approx(8.0, abs=0.1)
    assert left_px[26] == 0.0


def test_a_restored_path_gives_exactly_the_same():
    rng = np.random.default_rng(5)
    frames = [estimate_of(*sorted(rng.uniform(-20, 80, 2))[::-1]) for _ in range(40)]
    whole = ComfortPath(TELEVISION)
    expected = play(whole, frames, cuts=[7, 22])
    first = ComfortPath(TELEVISION)
    begun = play(first, frames[:20], cuts=[7, 22])
    second = ComfortPath.from_state(TELEVISION, first.state())
    assert begun + play(second, frames[20:], cuts=[7, 22], start=20) == expected
    assert second.describe(WIDTH) == whole.describe(WIDTH)


def test_a_path_of_no_frames_is_restored_too():
    path = ComfortPath.from_state(TELEVISION, ComfortPath(TELEVISION).state())
    assert path.describe(WIDTH) == "television: no depth was found, so nothing was changed"
    (first,) = play(path, [estimate_of(70.0, 10.0)])
    assert first.strength == 0.5


def test_the_description_says_what_was_given_and_what_is_too_much_for_a_moment():
    path = ComfortPath(ScreenChoice(name="television", strength=1.0))
    # 10 px come 25 px near within a frame: 1 % is 10 px, and the screen has moved by 0.4 px only.
    play(path, [estimate_of(10.0, 10.0), estimate_of(35.0, 10.0)])
    assert path.describe(WIDTH) == (
        "television: strength 1.00, convergence 10.0 to 10.4 px, depth -2.5 % to +0.0 % of the width; "
        "strength as given; comfortable would be -1.0 % to +2.0 % of the width"
    )


def test_the_description_gives_all_values():
    path = ComfortPath(TELEVISION)
    play(path, [estimate_of(70.0, 10.0), estimate_of(8.0, 8.0)], cuts=[1])
    # The second shot's middle starts 20 px behind the screen, as the first one's: at 28 px.
    assert path.describe(WIDTH) == (
        "television: strength 0.50 to 1.00, convergence 28.0 to 50.0 px, depth -1.0 % to +2.0 % of the width"
    )
