import numpy as np
import pytest
from plain_trees import plain_growth, plain_similarities

from stereoweave.bench.classical import tree_kernels as kernels
from stereoweave.bench.classical.label_kernels import label_fronts
from stereoweave.bench.classical.trees import grow_forest

# The pixels of an image of 2x3 with the levels 10 12 40 / 11 30 41: its edges in ascending order of weight.
ENDS = np.array([[0, 3], [2, 5], [0, 1], [4, 5], [1, 4], [3, 4], [1, 2]], np.int32)
WEIGHTS = np.array([1, 1, 2, 11, 18, 19, 28], np.uint8)


def grow(ends, weights, spread, least_pixels, most_pixels, pixels):
    chosen = np.zeros(len(weights), bool)
    kernels.grow_trees(ends, weights, float(spread), least_pixels, most_pixels, pixels, chosen)
    return chosen


def order(ends, weights, chosen, pixels):
    found, parents = np.empty(pixels, np.int32), np.empty(pixels, np.int32)
    to_parent = np.empty(pixels, np.uint8)
    kernels.order_trees(ends, weights, chosen, found, parents, to_parent)
    return found, parents, to_parent


@pytest.mark.parametrize(
    ("spread", "least", "most", "trees"),
    [
        (1000, 1, 6, [[0, 3, 1, 4, 5, 2]]),  # all but the two heaviest edges: the minimum spanning tree
        # 11 is within 1 + 30 / 2, but 18 is not within 2 + 30 / 3.
        (30, 1, 6, [[0, 3, 1], [2, 5, 4]]),
        (1, 1, 6, [[0, 3], [1], [2, 5], [4]]),
        (1, 2, 6, [[0, 3, 1], [2, 5, 4]]),  # single pixels join a neighbour
        (1000, 1, 2, [[0, 3], [1, 4], [2, 5]]),
    ],
)
def test_trees_of_two_rows_of_three_pixels(spread, least, most, trees):
    chosen = grow(ENDS, WEIGHTS, spread, least, most, 6)
    found, parents, to_parent = order(ENDS, WEIGHTS, chosen, 6)
    starts = np.flatnonzero(parents < 0)
    assert [part.tolist() for part in np.split(found, starts[1:])] == trees
    weights = {frozenset(ends): weight for ends, weight in zip(ENDS.tolist(), WEIGHTS, strict=True)}
    for place, parent in enumerate(parents):
        ways = 0 if parent < 0 else weights[frozenset((found[place], found[parent]))]
        assert to_parent[place] == ways


def test_costs_of_two_rows_of_three_pixels_come_together_along_the_tree():
    # The tree is the path 3 - 0 - 1 - 4 - 5 - 2 with the root 0; each edge halves.
    found, parents, _ = order(ENDS, WEIGHTS, grow(ENDS, WEIGHTS, 1000, 1, 6, 6), 6)
    assert found.tolist() == [0, 3, 1, 4, 5, 2]
    costs = np.zeros((6, 2), np.uint8)
    costs[found == 3, 0], costs[found == 2, 1] = 64, 32
    similarity = np.array([0, 0.5, 0.5, 0.5, 0.5, 0.5], np.float32)
    labels, least = np.empty((6, 3), np.float32), np.empty(6, np.float32)
    label_fronts(costs, parents, similarity, np.array([0, 6]), labels, least)
    # 64 of pixel 3 arrives as 32, 64, 16, 8, 4, 2, in that order; 32 of pixel 2 as 2, 1, 4, 8, 16, 32.
    assert labels[:, 2].tolist() == [1, 1, 1, 0, 0, 0]
    assert least.tolist() == [2, 1, 4, 8, 4, 2]
    assert (labels[:, :2] == 0).all()


def test_the_fast_growth_equals_the_plain_one(rng):
    numbers = np.arange(48).reshape(6, 8)
    across = np.stack([numbers[:, :-1].ravel(), numbers[:, 1:].ravel()], 1)
    down = np.stack([numbers[:-1].ravel(), numbers[1:].ravel()], 1)
    ends = np.concatenate([across, down]).astype(np.int32)
    weights = np.sort(rng.integers(0, 30, len(ends), dtype=np.uint8))
    ends = ends[rng.permutation(len(ends))]
    for limits in ((10, 1, 48), (60, 4, 20), (1000, 1, 7)):
        np.testing.assert_array_equal(
            grow(ends, weights, *limits, 48), plain_growth(ends, weights, *limits, 48)
        )


def test_a_forest_has_a_tree_for_each_area_of_one_colour():
    image = np.zeros((30, 40, 3), np.uint8)
    image[:, 25:] = 200
    forest = grow_forest(image)
    assert forest.starts.tolist() == [0, 30 * 25, 30 * 40]
    assert (forest.order[: 30 * 25] % 40 < 25).all()
    assert sorted(forest.order) == list(range(1200))
    places = np.arange(1200)
    assert (forest.parents < places).all()
    assert np.flatnonzero(forest.parents < 0).tolist() == forest.starts[:-1].tolist()
    # Equal colours are as similar as can be, over any distance.
    assert (plain_similarities(forest.parents, forest.similarity, 0, 750) == 1).all()
