import math

import pytest
import torch
from torch import nn

from stereoweave.learn.models.layers import (
    DilatedDense,
    Halve,
    HalveImage,
    Residual,
    correlate_nearby,
    correlate_warped,
    correlation_volume,
    cost_volume,
    expected_step,
    gather_neighbours,
    local_soft_argmax,
    mean_around,
    mirror,
    pixel_shuffle,
    sample_at_match,
    soft_argmin,
    upsample_convex,
    upsample_to_a_side,
)


def cost_volume_plain(left, right, levels, stride=1):
    batch, channels, height, width = left.shape
    volume = torch.zeros(batch, 2 * channels, levels, height, width)
    for level in range(levels):
        volume[:, :channels, level] = left
        for x in range(stride * level, width):
            volume[:, channels:, level, :, x] = right[:, :, :, x - stride * level]
    return volume


@pytest.fixture(autouse=True)
def same_draws():
    torch.manual_seed(0)


def correlation_volume_plain(first, second, levels):
    batch, _, height, width = first.shape
    volume = torch.zeros(batch, levels, height, width)
    for level in range(levels):
        for x in range(level, width):
            volume[:, level, :, x] = (first[:, :, :, x] * second[:, :, :, x - level]).sum(1)
    return volume


def nearby_matches_plain(first, second, disparity, radius):
    batch, _, height, width = first.shape
    matches = torch.zeros(batch, 2 * radius + 1, height, width)
    for b in range(batch):
        for y in range(height):
            for x in range(width):
                for k in range(-radius, radius + 1):
                    column = x - float(disparity[b, 0, y, x]) - k
                    before, share = math.floor(column), column - math.floor(column)
                    products = [
                        float(first[b, :, y, x] @ second[b, :, y, min(max(c, 0), width - 1)])
                        for c in (before, before + 1)
                    ]
                    matches[b, k + radius, y, x] = (1 - share) * products[0] + share * products[1]
    return matches


def warped_matches_plain(first, second, disparity, radius):
    batch, _, height, width = first.shape
    warped, matches = torch.zeros(second.shape), torch.zeros(batch, 2 * radius + 1, height, width)
    for b in range(batch):
        for y in range(height):
            for x in range(width):
                column = min(max(x - float(disparity[b, 0, y, x]), 0), width - 1)
                before, share = math.floor(column), column - math.floor(column)
                after = min(before + 1, width - 1)
                warped[b, :, y, x] = (1 - share) * second[b, :, y, before] + share * second[b, :, y, after]
            for x in range(width):
                for k in range(-radius, radius + 1):
                    if 0 <= x - k < width:
                        matches[b, k + radius, y, x] = first[b, :, y, x] @ warped[b, :, y, x - k]
    return matches


def scores(levels, **likelihood):
    """Return one pixel's scores: the log of a likelihood at the named levels, almost none elsewhere."""
    logits = torch.full((1, levels, 1, 1), -30.0)
    for level, value in likelihood.items():
        logits[0, int(level[1:])] = math.log(value)
    return logits


def as_pixels(maps):
    """Return maps [B, C, H, W] with the channels of a pixel side by side [B, H, W, C]."""
    return maps.permute(0, 2, 3, 1)


@pytest.mark.parametrize("width", [4, 9, 12])
@pytest.mark.parametrize("levels", [1, 4, 9, 13])
def test_the_fast_correlation_equals_the_plain_one(levels, width):
    first, second = torch.randn(2, 2, 5, 3, width)
    expected = correlation_volume_plain(first, second, levels)
    found = correlation_volume(as_pixels(first), as_pixels(second), levels)
    torch.testing.assert_close(found, expected)


def test_the_correlation_is_greatest_at_the_shift_between_the_maps():
    first = nn.functional.normalize(torch.randn(1, 16, 4, 20), dim=1)
    second = first.roll(-3, 3)  # column x of `first` is at x - 3 in `second`
    volume = correlation_volume(as_pixels(first), as_pixels(second), 8)
    assert (volume.argmax(1)[..., 3:] == 3).all()


@pytest.mark.parametrize("radius", [1, 2])
def test_nearby_matches_equal_the_plain_loop_between_columns_and_beyond_the_borders(radius):
    first, second = torch.randn(2, 2, 4, 2, 7)
    disparity = torch.tensor([0.0, 1.25, 2.5, -1.75, 5.999, 100.3, -40.5]).expand(2, 1, 2, 7)
    expected = nearby_matches_plain(first, second, disparity, radius)
    found = correlate_nearby(as_pixels(first), as_pixels(second), disparity, radius)
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=1e-4)


def test_nearby_matches_at_whole_disparities_are_those_of_the_correlation_volume():
    first, second = torch.randn(2, 1, 4, 2, 12)
    first, second = as_pixels(first), as_pixels(second)
    volume = correlation_volume(first, second, 7)
    found = correlate_nearby(first, second, torch.full((1, 1, 2, 12), 4.0), radius=2)
    torch.testing.assert_close(found[..., 6:], volume[:, 2:7, :, 6:])


@pytest.mark.parametrize("radius", [1, 2])
def test_warped_matches_equal_the_plain_loop_between_columns_and_beyond_the_borders(radius):
    first, second = torch.randn(2, 2, 4, 2, 7)
    disparity = torch.tensor([0.0, 1.25, 2.5, -1.75, 5.999, 100.3, -40.5]).expand(2, 1, 2, 7)
    expected = warped_matches_plain(first, second, disparity, radius)
    found = correlate_warped(as_pixels(first), as_pixels(second), disparity, radius)
    torch.testing.assert_close(found, expected)


@pytest.mark.parametrize("matches", [correlate_nearby, correlate_warped])
def test_columns_are_found_in_bfloat16_too_which_cannot_represent_their_indices(matches):
    first, second = torch.randn(2, 1, 1, 600, 4).bfloat16()
    disparity = torch.full((1, 1, 1, 600), 3.0, dtype=torch.bfloat16)
    expected = matches(first.float(), second.float(), disparity.float(), 1)
    torch.testing.assert_close(matches(first, second, disparity, 1).float(), expected, atol=0.1, rtol=0.02)


@pytest.mark.parametrize(("levels", "stride"), [(1, 1), (4, 1), (7, 1), (9, 1), (3, 3), (4, 2), (1, 3)])
def test_the_cost_volume_equals_the_plain_one(levels, stride):
    torch.manual_seed(0)
    left, right = torch.rand(2, 2, 3, 4, 7)
    found = cost_volume(left, right, levels, stride)
    assert torch.equal(found, cost_volume_plain(left, right, levels, stride))


def test_features_shifted_by_two_columns_are_equal_at_level_two():
    torch.manual_seed(0)
    scene = torch.rand(1, 3, 4, 12)
    volume = cost_volume(scene[..., :-2], scene[..., 2:], levels=4)
    left, right = volume.chunk(2, dim=1)
    different = (left - right).abs().amax((0, 1, 3))[:, 4:].amax(1)
    assert different[2] == 0
    assert (different[[0, 1, 3]] > 0).all()


@pytest.mark.parametrize(
    ("costs", "disparity_px"),
    [
        ([5.0, 5.0, 5.0], 1.0),
        ([60.0, 60.0, 0.0], 2.0),
        ([0.0, math.log(3), 60.0], 0.25),  # three to one
        ([math.log(2), 0.0, math.log(2)], 1.0),
        ([0.0, math.log(2), math.log(4)], 4 / 7),  # shares of 4, 2 and 1 sevenths
    ],
)
def test_soft_argmin_is_the_expected_candidate(costs, disparity_px):
    expected = soft_argmin(torch.tensor(costs).view(1, -1, 1, 1))
    torch.testing.assert_close(expected, torch.full((1, 1, 1, 1), disparity_px))


def test_the_expected_step_is_the_mean_of_the_steps():
    logits = torch.tensor([1.0, 1.0, 1.0, 1.0, 4.0]).log().view(1, 5, 1, 1)
    assert expected_step(logits).item() == pytest.approx((-2 - 1 + 0 + 1 + 2 * 4) / 8)


def test_two_equal_neighbours_give_the_level_between_them():
    assert local_soft_argmax(scores(12, l5=1, l6=1)).item() == pytest.approx(5.5)


@pytest.mark.parametrize(("one", "other", "expected"), [(0, 1, 0.5), (10, 11, 10.5)])
def test_the_ends_of_the_volume_do_not_pull_the_estimate(one, other, expected):
    assert local_soft_argmax(scores(12, **{f"l{one}": 1, f"l{other}": 1})).item() == pytest.approx(expected)


def test_a_lone_peak_at_an_end_is_found_there():
    assert local_soft_argmax(scores(12, l0=1)).item() == pytest.approx(0)
    assert local_soft_argmax(scores(12, l11=1)).item() == pytest.approx(11)


def test_the_window_fades_out_over_three_levels_and_rests_on_its_own_mean():
    # Levels 5 and 6 have weights of 4 and 2. Around 5 + c they fade to 4 (1 - c/3) and 2 (2/3 + c/3), and the
    # mean is 5 + c where c (16 - 2c) = 4 + 2c.
    c = (7 - 41**0.5) / 2
    assert local_soft_argmax(scores(12, l5=4, l6=2)).item() == pytest.approx(5 + c, abs=1e-3)


def test_a_far_second_peak_does_not_pull_the_estimate():
    assert local_soft_argmax(scores(24, l4=1, l20=0.99)).item() == pytest.approx(4, abs=1e-6)


def test_the_level_hardly_jumps_where_rounding_decides_which_one_is_best():
    one, other = (local_soft_argmax(scores(12, l4=0.5, l5=a, l6=b)) for a, b in ((1, 0.999), (0.999, 1)))
    assert abs(one - other).item() < 0.01


def test_upsampling_keeps_a_constant():
    flat = torch.full((2, 1, 3, 5), 7.25)
    torch.testing.assert_close(
        upsample_convex(flat, torch.randn(2, 36, 3, 5) * 5), torch.full((2, 1, 6, 10), 7.25)
    )


def test_upsampled_values_lie_within_those_of_the_nine_neighbours():
    x, weights = torch.randn(1, 1, 4, 6) * 10, torch.randn(1, 36, 4, 6) * 20
    around = nn.functional.pad(x, (1, 1, 1, 1), mode="replicate")
    highest = nn.functional.max_pool2d(around, 3, stride=1).repeat_interleave(2, 2).repeat_interleave(2, 3)
    lowest = -nn.functional.max_pool2d(-around, 3, stride=1).repeat_interleave(2, 2).repeat_interleave(2, 3)
    fine = upsample_convex(x, weights)
    assert (fine <= highest + 1e-5).all()
    assert (fine >= lowest - 1e-5).all()


def test_the_weights_say_which_neighbour_a_new_pixel_takes():
    x = torch.arange(12.0).view(1, 1, 3, 4)
    weights = torch.full((1, 9, 2, 2, 3, 4), -30.0)
    weights[:, 1, 0, 0] = 30  # upper left new pixel: the old pixel above
    weights[:, 4, 0, 1] = 30  # upper right: the old one itself
    weights[:, 6, 1, 0] = 30  # lower left: the old one below on the left
    weights[:, 5, 1, 1] = 30  # lower right: the old one on the right
    fine = upsample_convex(x, weights.view(1, 36, 3, 4))[0, 0]
    # Old pixel (1, 1) is 5. Above it is 1, below on the left 8, on the right 6. Shares of 1e-4 hardly matter.
    torch.testing.assert_close(fine[2:4, 2:4], torch.tensor([[1.0, 5.0], [8.0, 6.0]]), atol=0.01, rtol=0)


def test_if_all_neighbours_are_rejected_the_result_is_their_mean():
    x = torch.arange(9.0).view(1, 1, 3, 3)
    fine = upsample_convex(x, torch.full((1, 36, 3, 3), -1000.0))
    assert fine[0, 0, 2, 2].item() == pytest.approx(4)


@pytest.mark.parametrize("kernel", [2, 4])
def test_halving_keeps_the_grid_its_own_mirror_image(kernel):
    halve = Halve(3, 4, kernel=kernel).eval()
    with torch.no_grad():
        halve[0].weight += mirror(halve[0].weight.clone())
    image = torch.rand(1, 3, 8, 12)
    assert halve(image).shape == (1, 4, 4, 6)
    torch.testing.assert_close(halve(mirror(image)), mirror(halve(image)))


def test_halving_an_image_is_halving_its_values_mapped_to_both_sides_of_zero():
    image = torch.rand(2, 3, 8, 10)
    layer = HalveImage(3, 5, kernel=4).eval()
    assert torch.equal(layer(image), nn.Sequential(*layer)(2 * image - 1))


@pytest.mark.parametrize("channels", [4, 28])
def test_the_pixels_of_four_channels_are_interleaved_as_by_pytorch(channels):
    x = torch.randn(2, channels, 3, 5)
    assert torch.equal(pixel_shuffle(x), nn.functional.pixel_shuffle(x, 2))


def test_dense_blocks_pass_on_their_input_before_the_channels_that_they_add():
    dense = DilatedDense(5, narrow=3, growth=2, dilations=(1, 2, 4)).eval()
    x = torch.randn(1, 5, 6, 6)
    assert dense(x).shape == (1, dense.outputs, 6, 6) == (1, 11, 6, 6)
    torch.testing.assert_close(dense(x)[:, :5], x)


def test_a_residual_block_with_zero_weights_returns_its_input():
    residual = Residual(3).eval()
    nn.init.zeros_(residual.second[0].weight)
    x = torch.rand(1, 3, 5, 5)
    torch.testing.assert_close(residual(x), x)


def upsampled_corner(upsample, neighbours, logits):
    """Return the first of the four new pixels that replace the centre of 3x3 weighted old pixels."""
    x = torch.tensor(neighbours).view(1, 1, 3, 3)
    weights = torch.tensor(logits).view(1, 9, 1, 1, 1).expand(1, 9, 4, 3, 3).reshape(1, 36, 3, 3)
    return upsample(x, weights)[0, 0, 2, 2].item()


TWO_SURFACES = [10.0, 10.0, 50.0, 11.0, 10.0, 50.0, 10.0, 10.0, 10.0]


@pytest.mark.parametrize(
    ("logits", "expected"),
    [([0.0] * 9, 71 / 7), ([-9.0, -9.0, 0.0, -9.0, -9.0, 0.0, -9.0, -9.0, -9.0], 50)],
)
def test_a_mixture_of_two_surfaces_becomes_the_one_with_a_share_of_three_quarters(logits, expected):
    found = upsampled_corner(upsample_to_a_side, TWO_SURFACES, logits)
    assert found == pytest.approx(expected, abs=0.1)


def test_the_plain_mixture_of_two_surfaces_is_on_neither():
    assert upsampled_corner(upsample_convex, TWO_SURFACES, [0.0] * 9) == pytest.approx(171 / 9, abs=1e-3)


def test_the_mixture_of_a_slanted_surface_does_not_snap():
    slant = [float(i) / 2 for i in range(9)]
    logits = torch.linspace(-1, 1, 9).tolist()
    mixed = upsampled_corner(upsample_convex, slant, logits)
    assert upsampled_corner(upsample_to_a_side, [s / 2 for s in slant], logits) == pytest.approx(mixed / 2)


@pytest.mark.parametrize("logit", [-1000.0, -89.0, 0.0, 1000.0])
def test_the_gradient_of_the_upsampling_is_finite_even_for_extreme_logits(logit):
    # Below -88 exp(-logit) is infinite in float32: trained weights have reached -92.
    x = torch.arange(9.0).view(1, 1, 3, 3).requires_grad_()
    weights = torch.full((1, 36, 3, 3), logit).requires_grad_()
    upsample_convex(x, weights).sum().backward()
    assert x.grad.isfinite().all()
    assert weights.grad.isfinite().all()


def test_a_map_is_sampled_at_the_match_between_two_columns_and_at_the_border():
    other = torch.tensor([10.0, 20.0, 40.0, 80.0]).view(1, 1, 1, 4)
    disparity = torch.tensor([0.0, 0.25, 5.0, -3.0]).view(1, 1, 1, 4)
    # Columns 0, 0.75, -3 and 6.
    assert sample_at_match(other, disparity).flatten().tolist() == pytest.approx([10, 17.5, 10, 80])


def test_neighbours_are_the_values_at_the_offsets_and_outside_the_map_those_of_the_border():
    x = torch.arange(12.0).view(1, 1, 3, 4)
    below, left_far = gather_neighbours(x, [(1, 0), (0, -5)])[0]
    assert below.tolist() == [[4, 5, 6, 7], [8, 9, 10, 11], [8, 9, 10, 11]]
    assert left_far.tolist() == [[0] * 4, [4] * 4, [8] * 4]


def test_the_mean_around_a_pixel_is_over_the_part_of_its_window_inside_the_map():
    x = torch.tensor([[1.0, 2, 3, 4], [5, 6, 7, 8], [9, 10, 11, 12]])[None, None]
    found = mean_around(x, 3)[0, 0]
    assert found[1, 1] == pytest.approx(6)  # nine pixels
    assert found[0, 0] == pytest.approx((1 + 2 + 5 + 6) / 4)
    assert found[2, 1] == pytest.approx((5 + 6 + 7 + 9 + 10 + 11) / 6)
    torch.testing.assert_close(mean_around(x, 9), torch.full((1, 1, 3, 4), 6.5))
