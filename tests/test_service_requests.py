import io
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from service_examples import BOTH, EXAMPLES

import stereoweave as sw
from stereoweave.io import read_pair, write_image
from stereoweave.matcher import Matcher
from stereoweave.preparing import Request
from stereoweave.service_requests import Order, TooLargeError, answer_many, check_pixels


@pytest.fixture(scope="module")
def photos() -> tuple[np.ndarray, np.ndarray]:
    pair = read_pair(EXAMPLES / "left.png", EXAMPLES / "right.png")
    return pair.left, pair.right


@pytest.fixture(scope="module")
def estimate(photos) -> sw.Estimate:
    return sw.estimate(*photos, model="small")


def order(folder: Path, left: bytes = BOTH["left"], **said: Any) -> Order:
    """For disparity.npy of a pair, in a folder that is made."""
    folder.mkdir()
    (folder / "left").write_bytes(left)
    (folder / "right").write_bytes(BOTH["right"])
    return Order(folder=folder, pictures=(folder / "left", folder / "right"), file="disparity.npy", **said)


def test_those_that_are_matched_together_get_what_each_gets_alone(estimate, tmp_path):
    orders = [
        order(tmp_path / "first"),
        order(tmp_path / "damaged", left=b"no picture"),
        order(tmp_path / "second"),
        order(tmp_path / "with a range", range_px=(8, 16)),
        order(tmp_path / "with a range that is none", range_px=(5000, 6000)),
    ]
    first, damaged, second, within, beyond = answer_many(Matcher("small"), orders)
    for answer in (first, second):
        np.testing.assert_allclose(np.load(io.BytesIO(answer.content)), estimate.disparity_px, atol=1e-3)
    assert np.load(io.BytesIO(within.content)).max() == 16
    assert "expected a picture" in str(damaged)
    assert "range_px" in str(beyond)


def test_nothing_is_left_of_a_request_whose_client_goes_away_while_it_is_matched(tmp_path):
    folder = tmp_path / "pictures"

    class MatcherAtThatMoment(Matcher):
        def estimate_many(self, pairs: Sequence[sw.StereoPair], **how: bool) -> list[sw.Estimate]:
            shutil.rmtree(folder)
            return super().estimate_many(pairs, **how)

    answer_many(MatcherAtThatMoment("small"), [order(folder)])
    assert not folder.exists()


def test_a_view_is_measured_again_where_the_head_of_its_file_does_not_say_its_size(photos, tmp_path):
    write_image(tmp_path / "both.png", np.hstack(photos))
    halves = Order(
        folder=tmp_path,
        pictures=(tmp_path / "both.png",),
        file="disparity.npy",
        request=Request(arrangement="side_by_side_half"),
        most_megapixels=0.5,
    )
    assert check_pixels(halves) == 2 * 1280 * 480 / 1e6  # two views of 1280x480 px are matched
    (refusal,) = answer_many(Matcher("small"), [halves])
    assert isinstance(refusal, TooLargeError)
    assert "expected at most 0.5 megapixels, found 1280x480" in str(refusal)


def test_both_pictures_of_one_file_are_measured(photos, tmp_path):
    left, right = map(Image.fromarray, photos)
    left.save(tmp_path / "both", "MPO", save_all=True, append_images=[right])
    both = Order(folder=tmp_path, pictures=(tmp_path / "both",), file="disparity.npy")
    assert check_pixels(both) == 2 * 640 * 480 / 1e6
