import math

import numpy as np
import pytest
import torch

from stereoweave.learn.training.warp import depth_to_disparity, reconstruct_left


def reconstructed_plainly(right, disparity_px):
    """Reconstruct pixel by pixel. Returns the image [B, C, H, W], 0 without a match, and the match mask."""
    image, exists = np.zeros_like(right), np.zeros(disparity_px.shape, bool)
    width = right.shape[3]
    for b, _, j, i in np.ndindex(disparity_px.shape):
        position_px = i - disparity_px[b, 0, j, i]
        if 0 <= position_px <= width - 1:
            before, after = math.floor(position_px), math.ceil(position_px)
            share = position_px - before
            image[b, :, j, i] = (1 - share) * right[b, :, j, before] + share * right[b, :, j, after]
            exists[b, 0, j, i] = True
    return image, exists


def row(*values):
    return torch.tensor(values, dtype=torch.float64).view(1, 1, 1, -1)


def constant(value):
    return torch.full((1, 1, 1, 1), value, dtype=torch.float64)


def test_a_pixel_is_read_its_disparity_further_left_and_between_its_neighbours():
    right = row(10, 20, 40, 80)
    image, exists = reconstruct_left(right, row(0.0, 0.25, 1.5, 1.0))
    assert exists.all()
    assert image.flatten().tolist() == [10, 17.5, 15, 40]


def test_a_pixel_exists_up_to_both_ends_of_the_row():
    _, exists = reconstruct_left(row(10, 20, 40, 80), row(0.001, 1.0, -1.0, -0.001))
    assert exists.flatten().tolist() == [False, True, True, False]


def test_the_reconstruction_equals_the_plain_one(rng):
    right = rng.uniform(size=(2, 3, 5, 17))
    disparity_px = rng.uniform(-6, 12, (2, 1, 5, 17))
    disparity_px[:, :, 2] = np.round(disparity_px[:, :, 2])
    expected, expected_exists = reconstructed_plainly(right, disparity_px)
    image, exists = reconstruct_left(torch.from_numpy(right), torch.from_numpy(disparity_px))
    np.testing.assert_array_equal(exists.numpy(), expected_exists)
    np.testing.assert_allclose(image.where(exists, 0).numpy(), expected, atol=1e-12)


def test_the_gradients_are_those_of_the_values(rng):
    right = torch.from_numpy(rng.uniform(size=(2, 3, 2, 7))).requires_grad_()
    # Away from whole pixels, where the slope jumps.
    disparity_px = torch.from_numpy(rng.integers(-3, 5, (2, 1, 2, 7)) + rng.uniform(0.1, 0.9, (2, 1, 2, 7)))
    assert torch.autograd.gradcheck(
        lambda *x: reconstruct_left(*x)[0], (right, disparity_px.requires_grad_())
    )


@pytest.mark.parametrize("disparity_px", [1e6, -1e6, 1e30, math.inf, -math.inf, math.nan])
def test_a_match_far_outside_does_not_exist_and_has_finite_value_and_no_gradient(disparity_px):
    disparities_px = row(0.5, disparity_px, 1.5, disparity_px).float().requires_grad_()
    image, exists = reconstruct_left(row(10, 20, 40, 80).float(), disparities_px)
    image.sum().backward()
    assert exists.flatten().tolist() == [False, False, True, False]
    assert image.isfinite().all()
    assert disparities_px.grad.flatten().tolist() == [0, 0, -10, 0]


def test_half_precision_disparity_does_not_blur_the_columns():
    right = torch.arange(600.0).expand(1, 1, 1, 600)
    image, exists = reconstruct_left(right, torch.full((1, 1, 1, 600), 2.0, dtype=torch.bfloat16))
    assert torch.equal(image[..., 2:], right[..., :-2])
    assert exists[..., 2:].all()


def test_disparity_is_focal_length_times_baseline_over_depth_less_doffs_for_each_sample():
    depth_m = torch.tensor([2.0, 4.0]).view(2, 1, 1, 1)
    focal_baseline_px_m = torch.tensor([100.0, 60.0]).view(2, 1, 1, 1)
    doffs_px = torch.tensor([0.0, 5.0]).view(2, 1, 1, 1)
    found_px = depth_to_disparity(depth_m, focal_baseline_px_m, doffs_px, width_px=640)
    assert found_px.flatten().tolist() == [50.0, 10.0]


@pytest.mark.parametrize("doffs_px", [0.0, 30.0, -30.0])
def test_at_depth_zero_the_disparity_is_finite_and_every_match_outside(doffs_px):
    depth_m = torch.tensor([0.0, 1e-30, 0.05, 4.0], dtype=torch.float64).view(1, 1, 1, 4).requires_grad_()
    disparity_px = depth_to_disparity(depth_m, constant(60.0), constant(doffs_px), width_px=640)
    disparity_px.sum().backward()
    near_px = disparity_px.flatten()[:3]
    assert ((near_px >= 639.5) & (near_px <= 640 + 2 * 30)).all()
    assert depth_m.grad.flatten().tolist() == [0, 0, 0, pytest.approx(-60 / 4**2)]


def test_the_gradient_of_disparity_is_that_of_its_value():
    depth_m = torch.tensor([0.01, 0.5, 3.0], dtype=torch.float64).view(1, 1, 1, 3).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda z: depth_to_disparity(z, constant(60.0), constant(2.0), 640), depth_m
    )
