import numpy as np
import pytest

from stereoweave.learn.paint import REACH_PX
from stereoweave.learn.shapes import SHAPES, Place, below, everywhere, rods


@pytest.mark.parametrize("draw", [*SHAPES.values(), rods])
def test_a_silhouette_stays_on_the_canvas_wherever_it_is_put(draw):
    rng = np.random.default_rng(0)
    for x, y, radius_px in [(50, 40, 20), (0, 0, 30), (99, 79, 5), (50, 40, 300), (-50, -50, 10)]:
        patch = draw(rng, Place(x, y, radius_px, 100, 80))
        height, width = patch.field.shape
        assert 0 <= patch.left <= patch.left + width <= 100
        assert 0 <= patch.top <= patch.top + height <= 80
        assert patch.field.dtype == np.float32
        assert np.abs(patch.field).max(initial=0) <= REACH_PX


@pytest.mark.parametrize("draw", [*SHAPES.values(), rods])
def test_a_silhouette_in_the_middle_of_the_canvas_is_seen_and_ends_within_its_patch(draw):
    for seed in range(10):
        patch = draw(np.random.default_rng(seed), Place(100, 100, 40, 200, 200))
        assert (patch.field >= 0).sum() > 10
        border = [patch.field[0], patch.field[-1], patch.field[:, 0], patch.field[:, -1]]
        assert max(edge.max() for edge in border) < 0


def test_the_far_wall_covers_everything_and_the_floor_what_is_below_its_line():
    assert (everywhere(30, 20).field == REACH_PX).all()
    floor = below(10, 0.5, 30, 20)
    # At column 4 the line is at height 12.
    assert floor.field[11:14, 4].tolist() == [-1, 0, 1]
