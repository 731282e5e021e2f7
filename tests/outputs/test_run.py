from pathlib import Path

import numpy as np
import pytest

from stereoweave.matching.backend import Backend
from stereoweave.matching.matcher import Matcher
from stereoweave.matching.options import MatchOptions
from stereoweave.outputs.run import run, run_many
from stereoweave.pictures.prepare import Prepared, Request, prepare

TEXTURED = Path(__file__).resolve().parents[1] / "textured_pair"
PICTURES = (TEXTURED / "left.png", TEXTURED / "right.png")


@pytest.fixture(scope="module")
def matcher() -> Matcher:
    return Backend(threads=1).matcher()


@pytest.fixture(scope="module")
def prepared() -> Prepared:
    return prepare(PICTURES, Request(focal_px=995.0, baseline_m=0.193))


def test_a_result_has_the_matcher_s_estimate_a_summary_and_the_pictures_notes(matcher, prepared):
    result = run(prepared, matcher, MatchOptions(raw=True))
    own = matcher.estimate(prepared.pair.left, prepared.pair.right, raw=True)
    np.testing.assert_array_equal(result.estimate.disparity_px, own.disparity_px)
    assert result.pair is prepared.pair
    assert result.notes == prepared.notes
    assert result.summary.pictures == ("left.png", "right.png")
    assert result.summary.model == "small"
    assert result.summary.disparity_max_px == pytest.approx(own.disparity_px.max(), abs=0.01)
    assert result.threads == 1


def test_pairs_matched_together_have_the_results_of_each_alone_and_share_the_time(matcher, prepared):
    together = run_many([prepared, prepared], matcher, MatchOptions())
    alone = run(prepared, matcher, MatchOptions())
    for result in together:
        np.testing.assert_array_equal(result.estimate.disparity_px, alone.estimate.disparity_px)
    assert len({result.summary.estimate_ms for result in together}) == 1
    assert together[0].summary.estimate_ms > 0


def test_a_good_pair_has_no_warnings_and_a_swapped_pair_has_one(matcher, prepared):
    assert run(prepared, matcher, MatchOptions()).warnings() == []
    swapped = prepare(PICTURES[::-1], Request(rectify=False))
    assert run(swapped, matcher, MatchOptions()).warnings() != []
