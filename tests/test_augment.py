import numpy as np
import pytest

from stereoweave.learn.augment import augment, erased, mirrored, recoloured, rescaled_cut, upside_down
from stereoweave.stereo import Sample

HEIGHT, WIDTH = 96, 144
NEAR_PX, SLOPE = 5.0, 0.05


def picture(x, y):
    """A smooth pattern at places of the surface, so that a resampled picture is the pattern once more."""
    waves = [np.sin(x / 7 + y / 11 + phase) + np.sin(x / 13 - y / 9 + 2 * phase) for phase in (0, 1, 2)]
    return np.round(127.5 + 60 * np.stack(waves, -1)).astype(np.uint8)


@pytest.fixture
def sample():
    """A slanted wall: column x of the left view has 5 + x / 20 px, so the right one shows (x + 5) / 0.95."""
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    seen = (x + NEAR_PX) / (1 - SLOPE)
    return Sample(
        left=picture(x, y),
        right=picture(seen, y),
        disparity_px=NEAR_PX + SLOPE * x,
        right_disparity_px=seen - x,
        occluded=x < NEAR_PX + SLOPE * x,
        right_occluded=seen > WIDTH - 1,
    )


def looked_up(values, columns):
    """Rows of `values` at fractional columns, linearly, and where those lie inside."""
    before = np.clip(np.floor(columns).astype(int), 0, values.shape[1] - 2)
    share = (columns - before).reshape(*columns.shape, *[1] * (values.ndim - 2))
    rows = np.arange(len(values))[:, None]
    inside = (columns >= 0) & (columns <= values.shape[1] - 1)
    return (1 - share) * values[rows, before] + share * values[rows, before + 1], inside


def assert_views_agree(sample, grey_levels):
    """The right view looked up at the left one's matches is the left view, and the other way round."""
    columns = np.arange(sample.left.shape[1])
    for here, there, matches in (
        (sample.left, sample.right, columns - sample.disparity_px),
        (sample.right, sample.left, columns + sample.right_disparity_px),
    ):
        found, inside = looked_up(there.astype(float), matches)
        assert inside.mean() > 0.5
        assert np.abs(found - here)[inside].max() <= grey_levels


def assert_same(one, other):
    for name, value in vars(one).items():
        np.testing.assert_array_equal(value, getattr(other, name), err_msg=name)


def test_the_example_itself_is_exact(sample):
    assert_views_agree(sample, 2)


@pytest.mark.parametrize("seed", range(8))
def test_a_scaled_cut_stays_exact(sample, seed):
    cut = rescaled_cut(sample, 64, 80, np.random.default_rng(seed))
    assert cut.left.shape == cut.right.shape == (64, 80, 3)
    assert_views_agree(cut, 4)


def test_cuts_are_scaled_up_and_down(sample):
    # The slope of the wall is the same at any scale; its disparity at the left border tells the scale.
    spans = [
        np.ptp(rescaled_cut(sample, 64, 80, np.random.default_rng(seed)).disparity_px) for seed in range(40)
    ]
    assert np.ptp(spans) < 0.2
    nearest = [rescaled_cut(sample, 64, 80, np.random.default_rng(s)).disparity_px.min() for s in range(40)]
    assert min(nearest) < 0.9 * NEAR_PX
    assert max(nearest) > 1.2 * NEAR_PX


def test_a_mirrored_sample_stays_exact(sample):
    assert_views_agree(mirrored(sample), 2)
    np.testing.assert_array_equal(mirrored(sample).left, sample.right[:, ::-1])
    np.testing.assert_array_equal(mirrored(sample).occluded, sample.right_occluded[:, ::-1])


def test_a_sample_upside_down_stays_exact(sample):
    assert_views_agree(upside_down(sample), 2)


@pytest.mark.parametrize("change", [mirrored, upside_down])
def test_what_is_turned_twice_is_as_before(sample, change):
    assert_same(change(change(sample)), sample)


@pytest.mark.parametrize("seed", range(8))
def test_an_augmented_sample_has_matching_disparities_and_the_size_asked_for(sample, seed):
    augmented = augment(sample, 64, 80, np.random.default_rng(seed))
    assert augmented.left.shape == augmented.right.shape == (64, 80, 3)
    assert augmented.left.dtype == augmented.right.dtype == np.uint8
    assert augmented.disparity_px.dtype == np.float32
    assert augmented.occluded.dtype == bool
    columns = np.arange(80)
    found_px, inside = looked_up(augmented.right_disparity_px, columns - augmented.disparity_px)
    np.testing.assert_allclose(found_px[inside], augmented.disparity_px[inside], atol=0.15)


def test_the_same_draws_give_the_same_sample(sample):
    one, other = (augment(sample, 64, 80, np.random.default_rng(3)) for _ in range(2))
    assert_same(one, other)


def test_both_views_keep_one_order_of_colours():
    image = np.full((4, 4, 3), (200, 100, 0), np.uint8)
    darkest = []
    for seed in range(20):
        left, right = recoloured(image, image, np.random.default_rng(seed))
        assert left[0, 0].argmin() == right[0, 0].argmin()
        darkest.append(left[0, 0].argmin())
    assert len(set(darkest)) > 1


def test_views_are_recoloured_much_alike():
    ramp = np.tile(np.arange(0, 240, 10, dtype=np.uint8)[None, :, None], (2, 1, 3))
    changes = []
    for seed in range(20):
        left, right = (image.astype(int) for image in recoloured(ramp, ramp, np.random.default_rng(seed)))
        # Own gains within 5 %, own gammas within 4 % of at most 1.4, which is steepest at 1 / e of white.
        assert np.abs(left - right).max() < 60
        changes.append(np.abs(left - ramp).mean())
    assert max(changes) > 30


def test_erasing_puts_flat_patches_into_a_copy(rng):
    image = rng.integers(0, 256, (80, 100, 3), dtype=np.uint8)
    before = image.copy()
    found = erased(image, rng)
    np.testing.assert_array_equal(image, before)
    changed = (found != image).any(2)
    assert 15 * 15 <= changed.sum() <= 2 * 63 * 63
    assert np.unique(found[changed], axis=0).shape[0] <= 3
