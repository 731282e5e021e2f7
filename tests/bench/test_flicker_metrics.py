from dataclasses import replace

import numpy as np
import pytest

from stereoweave.bench.flicker import (
    CARRIED,
    FRAME_BY_FRAME,
    STEADY,
    FlickerRow,
    average_rows,
    score_flicker,
)
from stereoweave.bench.flicker_metrics import find_seen_again, find_thin, flicker, jumps_share
from stereoweave.bench.flicker_videos import (
    LEFT,
    MIDDLE,
    NOISE_LEVELS,
    RenderedVideo,
    add_noise,
    add_passing_oval,
    expose,
    freeze,
    render_panning,
    reproject,
)
from stereoweave.errors import StereoweaveError
from stereoweave.stereo import StereoCamera, StereoPair
from stereoweave.synth.sets.pair_rendering import RenderSpec
from stereoweave.synth.viewpoints import PosedRig

REST = np.zeros((1, 4, 2), np.float32)
ALL = np.ones((1, 4), bool)
LENS = StereoCamera(focal_px=100, baseline_m=0.1, cx_px=20, cy_px=15)
RIG = PosedRig(camera=LENS, size_px=(41, 31), position_m=np.zeros(3), axes=np.eye(3))


def row(*values):
    return np.array([values], np.float32)


def to_the_right(*px):
    return np.stack([row(*px), row(*np.zeros(4))], axis=-1)


def test_flicker_at_rest_is_the_mean_absolute_change():
    assert flicker(row(1, 2, 3, 4), row(2, 2, 1, 5), REST, ALL) == 1.0  # of 1, 0, 2, 1


def test_true_motion_is_no_flicker():
    before, after = row(7, 9, 1, 1), row(1, 7, 9, 1)
    visible = np.array([[True, True, True, False]])
    assert flicker(before, after, to_the_right(1, 1, 1, 1), visible) == 0.0
    assert flicker(before, after, REST, visible) == (6 + 2 + 8) / 3


def test_half_a_pixel_of_motion_is_interpolated():
    visible = np.array([[True, False, False, False]])
    assert flicker(row(5, 0, 0, 0), row(4, 8, 0, 0), to_the_right(0.5, 0, 0, 0), visible) == 1.0  # of 6 and 5


def test_a_true_change_of_disparity_is_no_flicker_and_neither_is_an_error_that_stays():
    truth_px = row(10, 10, 20, 20)
    nearing_px = row(0, 0, 3, 3)
    assert flicker(truth_px + 1, truth_px + nearing_px + 1, REST, ALL, nearing_px) == 0.0
    assert flicker(truth_px, truth_px, REST, ALL, nearing_px) == 1.5  # of 0, 0, 3, 3


def test_flicker_of_an_image_is_the_mean_over_its_channels():
    before = np.zeros((1, 4, 3), np.uint8)
    after = before.copy()
    after[0, 1] = 3, 6, 9
    assert flicker(before, after, REST, ALL) == 18 / 12
    assert flicker(before, after, REST, np.array([[False, True, False, False]])) == 6.0


def test_flicker_and_jumps_without_points_are_nan():
    assert np.isnan(flicker(row(1, 2, 3, 4), row(1, 2, 3, 4), REST, ~ALL))
    assert np.isnan(jumps_share(row(1, 2, 3, 4), row(1, 2, 3, 4), REST, ~ALL))


def test_a_jump_is_a_change_that_is_off_by_more_than_two_pixels():
    before_px, after_px = row(5, 5, 5, 5), row(7, 7.5, 2, 9)
    assert jumps_share(before_px, after_px, REST, ALL) == 3 / 4
    # The first and the last point came 2 and 4 px nearer, which is true of the last one alone.
    assert jumps_share(before_px, after_px, REST, ALL, row(0, 0, 0, 4)) == 2 / 4
    visible = np.array([[True, True, True, False]])
    assert jumps_share(row(9, 1, 1, 1), row(0, 9, 1, 1), to_the_right(1, 1, 1, 1), visible) == 0
    assert jumps_share(row(9, 1, 1, 1), row(0, 9, 1, 1), REST, visible) == 2 / 3


def test_thin_things_are_those_in_front_into_which_no_square_of_seven_pixels_fits():
    truth_px = np.full((40, 60), 10, np.float32)
    truth_px[:, 5:11] = 30  # a post 6 px wide
    truth_px[10:17, 20:50] = 30  # a beam 7 px high
    truth_px[30:33, 20:50] = 12  # a thin thing that is hardly in front
    truth_px[20:24, 20:24] = 2  # a hole
    np.testing.assert_array_equal(np.unique(np.nonzero(find_thin(truth_px))[1]), np.arange(5, 11))


def test_frames_of_two_sizes_and_points_that_leave_are_refused(without_shape_checks):
    with pytest.raises(StereoweaveError, match="of the same size, found .*1, 4.*1, 3"):
        flicker(row(1, 2, 3, 4), row(1, 2, 3), REST, ALL)
    with pytest.raises(StereoweaveError, match="found 1 that leave it"):
        flicker(row(1, 2, 3, 4), row(1, 2, 3, 4), to_the_right(0, 0, 0, 1), ALL)


def test_a_point_is_seen_again_inside_and_where_its_own_surface_is():
    before_px, after_px = row(5, 5, 5, 5), row(5, 9, 5, 5)
    found = find_seen_again(before_px, after_px, to_the_right(0, 0, 0, 1), row(0, 0, 0, 0))
    np.testing.assert_array_equal(found, [[True, False, True, False]])  # stays; is covered; stays; leaves
    # Between two pixels, both must show the surface.
    found = find_seen_again(before_px, after_px, to_the_right(0.5, 1, 0.5, 0), row(0, 0, 0, 0))
    np.testing.assert_array_equal(found, [[False, True, True, True]])
    assert find_seen_again(before_px, after_px, REST, row(4, 4, 4, 4)).tolist() == [
        [False, True, False, False]
    ]


def at(change, x, y):
    motion_px, change_px = change
    return [*motion_px[y, x], change_px[y, x]]


def test_a_camera_that_steps_aside_moves_points_by_their_share_of_the_baseline():
    # Half a baseline to the right: half the disparity to the left.
    aside = replace(RIG, position_m=np.array([0.05, 0, 0]))
    disparity_px = np.full((31, 41), 8, np.float32)
    disparity_px[0, 0] = 0
    change = reproject(disparity_px, RIG, aside, LEFT)
    np.testing.assert_allclose(at(change, 30, 20), [-4, 0, 0], atol=1e-5)
    np.testing.assert_allclose(at(change, 0, 0), [0, 0, 0], atol=1e-5)  # the sky


@pytest.mark.parametrize("position", [LEFT, MIDDLE])
def test_a_camera_that_moves_half_way_to_a_wall_doubles_disparity_and_size(position):
    nearer = replace(RIG, position_m=np.array([0, 0, 0.5]))
    change = reproject(np.full((31, 41), 10, np.float32), RIG, nearer, position)  # 1 m away
    np.testing.assert_allclose(at(change, 30, 12), [10, -3, 10], atol=1e-5)


def test_a_camera_that_turns_moves_even_the_sky():
    right, down, forward = np.array([0.8, 0, -0.6]), np.array([0, 1, 0]), np.array([0.6, 0, 0.8])
    turned = replace(RIG, axes=np.stack([right, down, forward]))
    change = reproject(np.zeros((31, 41), np.float32), RIG, turned, LEFT)
    np.testing.assert_allclose(at(change, 20, 15), [-75, 0, 0], atol=1e-4)  # tan = 0.6 / 0.8


@pytest.fixture
def three_frames(rng):
    """Return a video of three frames; the first, which `freeze` and `add_passing_oval` use, is a plane."""
    image = rng.integers(0, 256, (96, 128, 3), dtype=np.uint8)
    flat_px = np.full((96, 128), 4, np.float32)
    return RenderedVideo(
        name="any",
        pairs=[StereoPair(left=image, right=np.roll(image, -4, axis=1))] * 3,
        gains=[1.0] * 3,
        disparities_px=[{LEFT: flat_px, MIDDLE: flat_px}] * 3,
        moving=[np.zeros((96, 128), bool)] * 3,
        change=lambda frame, other, position: (np.zeros((96, 128, 2)), np.zeros((96, 128))),
    )


def test_a_still_video_does_not_change_and_its_noise_does(three_frames):
    video = freeze(three_frames)
    assert len(video.pairs) == 3
    motion_px, _ = video.change(0, 2, LEFT)
    assert video.find_seen_again(0, 2, LEFT).all()
    assert (
        flicker(video.pairs[0].left, video.pairs[2].left, motion_px, video.find_seen_again(0, 2, LEFT)) == 0
    )
    grey = StereoPair(left=np.full((96, 128, 3), 99, np.uint8), right=np.full((96, 128, 3), 99, np.uint8))
    one, other = (add_noise(grey, np.random.default_rng(seed)) for seed in (1, 2))
    for a, b in ((one.left, one.right), (one.left, other.left), (one.right, other.right)):
        assert np.std(a.astype(float) - b) == pytest.approx(np.sqrt(2) * NOISE_LEVELS, rel=0.03)


def test_the_passing_oval_is_where_its_truth_says(three_frames):
    video = add_passing_oval(three_frames, "passing", (4.0, 2.0), nearing_px=2.0)
    assert not video.moving[0].all()
    for frame, near_px in enumerate((12, 14, 16)):
        oval = video.moving[frame]
        np.testing.assert_array_equal(video.disparities_px[frame][LEFT], np.where(oval, near_px, 4))
        rows, columns = np.nonzero(oval)
        # An oval of 32 x 24 px, whose rim pixels are mixed with the background.
        assert len(rows) == pytest.approx(np.pi / 4 * 32 * 24, rel=0.1)
        middle = (np.abs(rows - rows.mean()) < 6) & (np.abs(columns - columns.mean()) < 8)
        rows, columns = rows[middle], columns[middle]
        pair = video.pairs[frame]
        np.testing.assert_array_equal(pair.left[rows, columns], pair.right[rows, columns - near_px])
        if frame:
            earlier = video.pairs[frame - 1].left
            np.testing.assert_array_equal(pair.left[rows, columns], earlier[rows - 2, columns - 4])


def test_the_passing_oval_covers_and_uncovers_the_background(three_frames):
    video = add_passing_oval(three_frames, "passing", (4.0, 0.0))
    before, after = video.moving[0], video.moving[1]
    np.testing.assert_array_equal(video.find_seen_again(0, 1, LEFT) | (after & ~before), np.ones_like(before))
    np.testing.assert_array_equal(video.find_seen_again(1, 0, LEFT), ~(before & ~after))
    motion_px, change_px = video.change(0, 2, LEFT)
    np.testing.assert_array_equal(motion_px[before], np.tile([8, 0], (before.sum(), 1)))
    assert not motion_px[~before].any() and not change_px.any()


def test_an_oval_that_comes_nearer_moves_less_to_the_right_in_the_middle_view(three_frames):
    video = add_passing_oval(three_frames, "nearing", (3.25, 0.0), nearing_px=0.5)
    motion_px, change_px = video.change(0, 1, MIDDLE)
    assert motion_px[..., 0].max() == 3.0
    assert change_px.max() == 0.5


def test_an_exposure_multiplies_the_brightness_up_to_white(three_frames):
    (pair, *_) = three_frames.pairs
    first, second, third = (expose(pair, gain).left.astype(float) for gain in (1.0, 0.5, 1.5))
    np.testing.assert_array_equal(first, pair.left)
    assert np.abs(second - 0.5 * first).max() <= 0.5
    np.testing.assert_array_equal(third[first > 170], 255)


@pytest.mark.needs_egl
def test_a_rendered_pan_looks_the_same_along_its_true_motion():
    video = render_panning(RenderSpec(scene="ship", seed=4, size_px=(160, 120), frames=12), 2)
    motion_px, change_px = video.change(0, 1, LEFT)
    visible = video.find_seen_again(0, 1, LEFT)
    assert visible.mean() > 0.8
    before_px, after_px = (maps[LEFT] for maps in video.disparities_px)
    at_rest_px = flicker(before_px, after_px, 0 * motion_px, visible)
    assert flicker(before_px, after_px, motion_px, visible, change_px) < 0.05 * at_rest_px
    before, after = (pair.left for pair in video.pairs)
    assert flicker(before, after, motion_px, visible) < 0.5 * flicker(before, after, 0 * motion_px, visible)


@pytest.mark.needs_egl
def test_the_rows_show_the_effect_of_the_temporal_filter():
    rows = list(score_flicker(["rooms"], frames=8, size_px=(160, 120), seed=3, threads=1))
    assert [row.film for row in rows[::3]] == ["still", "passing", "nearing", "panning", "flash", "fade"]
    assert [row.method for row in rows] == [FRAME_BY_FRAME, STEADY, CARRIED] * 6
    for by_frame, steady, carried in zip(rows[::3], rows[1::3], rows[2::3], strict=True):
        assert carried.flicker_px < steady.flicker_px < by_frame.flicker_px
        assert max(carried.jumps_share, steady.jumps_share) < by_frame.jumps_share
        assert steady.epe_px < 1.01 * by_frame.epe_px
        assert carried.epe_px < 1.03 * by_frame.epe_px
        assert min(steady.time_ms, carried.time_ms) > 0
    by_frame_px, steady_px, carried_px = (np.mean([row.epe_px for row in rows[i::3]]) for i in range(3))
    assert carried_px < steady_px < by_frame_px
    # Views are rendered without the exposure, so a fade alone changes none.
    assert rows[15].view_flicker_levels < 1.5 * rows[9].view_flicker_levels
    passing_by_frame, passing_steady = rows[3:5]
    assert passing_steady.moving_epe_px <= 1.01 * passing_by_frame.moving_epe_px
    assert np.isnan(rows[0].moving_epe_px) and np.isnan(rows[0].uncovered_epe_px)


def test_a_video_of_one_frame_is_refused():
    with pytest.raises(StereoweaveError, match="frames: expected at least 2"):
        list(score_flicker(["rooms"], frames=1))


def test_means_are_over_the_scenes_of_a_video_and_a_method():
    def row(scene, method, value):
        names = "jumps_share view_flicker_levels epe_px moving_epe_px outline_epe_px uncovered_epe_px"
        numbers = dict.fromkeys([*names.split(), "edge_epe_px", "bad2_percent"], value)
        return FlickerRow(
            film="still", scene=scene, model="small", method=method, width_px=8, height_px=6, frames=3,
            noise_levels=4.0, flicker_px=value, thin_epe_px=float("nan") if scene == "b" else value,
            time_ms=float("nan"), **numbers,
        )  # fmt: skip

    found = average_rows([row("a", STEADY, 1.0), row("a", FRAME_BY_FRAME, 5.0), row("b", STEADY, 2.0)])
    assert [(mean.film, mean.scene, mean.flicker_px) for mean in found] == [
        ("still, steady", "mean", 1.5),
        ("still, frame by frame", "mean", 5.0),
    ]
    assert found[0].thin_epe_px == 1.0 and np.isnan(found[0].time_ms)
