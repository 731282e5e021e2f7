import numpy as np
import pytest

from experiments.search_extents.scoring import EXTENTS, NOWHERE, score_extents
from stereoweave.bench.metrics import bad_percent
from stereoweave.data.readers import read_scenes
from stereoweave.matching.matcher import Matcher
from stereoweave.matching.refine import NARROW

pytestmark = pytest.mark.testdata


@pytest.fixture(scope="module")
def folder(testdata, tmp_path_factory):
    """Return a folder of one real pair."""
    pairs = tmp_path_factory.mktemp("extents") / "pairs"
    pairs.mkdir()
    (pairs / "cones").symlink_to(testdata.resolve() / "stereo" / "pairs" / "cones")
    return pairs


@pytest.fixture(scope="module")
def rows(folder):
    return score_extents(folder, "small")


def test_there_is_a_row_for_each_extent_and_a_wider_one_searches_more(rows):
    assert [(row.confidence, row.reach_px, row.both_views, row.in_colour) for row in rows] == list(EXTENTS)
    assert {(row.folder, row.pairs) for row in rows} == {("pairs", 1)}
    assert rows[EXTENTS.index(NOWHERE)].searched_percent == 0
    searched = {(row.confidence, row.reach_px): row.searched_percent for row in rows}
    for (confidence, reach_px), percent in searched.items():
        wider = [each for each in searched if each[0] >= confidence and each[1] >= reach_px]
        assert all(searched[each] > percent for each in wider if each != (confidence, reach_px))


def test_a_search_lowers_the_errors_of_a_real_pair(rows):
    nowhere, narrow = (rows[EXTENTS.index(extent)] for extent in (NOWHERE, NARROW))
    assert narrow.bad1_percent < nowhere.bad1_percent
    assert narrow.bad2_percent < nowhere.bad2_percent


def test_the_narrow_search_is_that_of_the_matcher(rows, folder):
    scene = next(read_scenes(folder))
    found = Matcher("small").estimate(scene.pair.left, scene.pair.right)
    expected = bad_percent(found.disparity_px, scene.truth_px, 1)
    np.testing.assert_allclose(rows[EXTENTS.index(NARROW)].bad1_percent, expected, rtol=1e-6)
