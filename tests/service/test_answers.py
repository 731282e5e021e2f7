import io
import re
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from heic_examples import write_heic
from lif_examples import tablet_photo
from PIL import Image
from service_examples import BOTH, TEXTURED
from vr180_examples import make_vr180

import stereoweave as sw
from stereoweave.io.images import read_pair, write_image
from stereoweave.matching.matcher import Matcher
from stereoweave.matching.options import MatchOptions
from stereoweave.pictures.prepare import Request
from stereoweave.service.answers import ServiceJob, TooLargeError, answer_many, check_pixels


@pytest.fixture(scope="module")
def photos() -> tuple[np.ndarray, np.ndarray]:
    pair = read_pair(TEXTURED / "left.png", TEXTURED / "right.png")
    return pair.left, pair.right


@pytest.fixture(scope="module")
def estimate(photos) -> sw.Estimate:
    return sw.estimate(*photos, model="small")


def job(folder: Path, left: bytes = BOTH["left"], **said: Any) -> ServiceJob:
    """Make a folder with a pair, and return a job for the pair's disparity.npy."""
    folder.mkdir()
    (folder / "left").write_bytes(left)
    (folder / "right").write_bytes(BOTH["right"])
    return ServiceJob(
        folder=folder, pictures=(folder / "left", folder / "right"), file="disparity.npy", **said
    )


def test_jobs_matched_together_get_the_same_answers_as_alone(estimate, tmp_path):
    jobs = [
        job(tmp_path / "first"),
        job(tmp_path / "damaged", left=b"no picture"),
        job(tmp_path / "second"),
        job(tmp_path / "with a range", options=MatchOptions(range_px=(8, 16))),
        job(tmp_path / "with an invalid range", options=MatchOptions(range_px=(5000, 6000))),
    ]
    first, damaged, second, within, beyond = answer_many(Matcher("small"), jobs)
    for answer in (first, second):
        np.testing.assert_allclose(np.load(io.BytesIO(answer.content)), estimate.disparity_px, atol=1e-3)
    assert np.load(io.BytesIO(within.content)).max() == 16
    assert "expected a picture" in str(damaged)
    assert "range_px" in str(beyond)


def test_a_png_of_swapped_pictures_is_refused_with_the_cause(tmp_path):
    swapped = replace(job(tmp_path / "swapped"), file="disparity.png")
    swapped = replace(swapped, pictures=swapped.pictures[::-1])
    (error,) = answer_many(Matcher("small"), [swapped])
    assert re.fullmatch(
        r"disparity\.png: expected disparities from 0 to 255\.99 px, the range of a PNG, found -\d+\.\d\d to "
        r"-?\d+\.\d\d px; left and right are swapped; give them the other way round; or request pfm, npy "
        "or tiff",
        str(error),
    )


def test_no_files_remain_if_the_client_disconnects_during_matching(tmp_path):
    folder = tmp_path / "pictures"

    class MatcherAtThatMoment(Matcher):
        def estimate_many(self, pairs: Sequence[sw.StereoPair], **how: bool) -> list[sw.Estimate]:
            shutil.rmtree(folder)
            return super().estimate_many(pairs, **how)

    answer_many(MatcherAtThatMoment("small"), [job(folder)])
    assert not folder.exists()


@pytest.fixture
def halves(photos, tmp_path) -> ServiceJob:
    """Return a job with two views of 1280x480 px at half width, which only the file's name reveals."""
    write_image(tmp_path / "both_half_LR.png", np.hstack(photos))
    return ServiceJob(folder=tmp_path, pictures=(tmp_path / "both_half_LR.png",), file="disparity.npy")


def jps_of(picture: Image.Image, flags: int) -> bytes:
    """Return a JPS file of two views side by side. Source: VRex's JPS format, as `ExifTool` reads it."""
    segment = b"\xff\xe3\x00\x12_JPSJPS_\x00\x04" + bytes([0, flags, 2, 1]) + bytes(2)
    stored = io.BytesIO()
    picture.save(stored, "JPEG", extra=segment)
    return stored.getvalue()


def test_half_views_named_in_the_request_are_measured_from_the_pictures_header(halves):
    named = replace(halves, request=Request(format="side_by_side_half"))
    assert check_pixels(named) == 2 * 1280 * 480 / 1e6
    assert check_pixels(replace(named, most_megapixels=0.62)) == 2 * 1280 * 480 / 1e6
    with pytest.raises(TooLargeError, match=r"expected at most 0\.6 megapixels, found 1280x480"):
        check_pixels(replace(named, most_megapixels=0.6))


def test_both_views_of_a_heic_file_are_measured_and_matched(photos, estimate, tmp_path):
    path = write_heic(tmp_path / "photo.heic", *photos)
    spatial = ServiceJob(folder=tmp_path, pictures=(path,), file="disparity.npy")
    assert check_pixels(spatial) == 2 * 640 * 480 / 1e6
    with pytest.raises(TooLargeError, match=r"expected at most 0\.3 megapixels, found 640x480"):
        check_pixels(replace(spatial, most_megapixels=0.3))
    (answer,) = answer_many(Matcher("small"), [spatial])
    # The second image of the file is off by up to a level of grey.
    off_px = np.abs(np.load(io.BytesIO(answer.content)) - estimate.disparity_px)
    assert np.median(off_px) < 0.05


def test_detected_half_views_are_measured_again(halves):
    least = replace(halves, most_megapixels=0.6)
    assert check_pixels(least) == 1280 * 480 / 1e6
    (refusal,) = answer_many(Matcher("small"), [least])
    assert isinstance(refusal, TooLargeError)
    assert "expected at most 0.6 megapixels, found 1280x480" in str(refusal)


@pytest.mark.parametrize(("flags", "views"), [(4, 1), (4 | 2, 2), (4 | 1, 1)])
def test_half_views_declared_in_a_jps_file_are_measured_from_its_header(photos, tmp_path, flags, views):
    (tmp_path / "both").write_bytes(jps_of(Image.fromarray(np.hstack(photos)), flags))
    both = ServiceJob(folder=tmp_path, pictures=(tmp_path / "both",), file="disparity.npy")
    assert check_pixels(both) == views * 1280 * 480 / 1e6


def test_both_pictures_of_one_file_are_measured(photos, tmp_path):
    left, right = map(Image.fromarray, photos)
    left.save(tmp_path / "both", "MPO", save_all=True, append_images=[right])
    both = ServiceJob(
        folder=tmp_path, pictures=(tmp_path / "both",), file="disparity.npy", most_megapixels=0.31
    )
    assert check_pixels(both) == 2 * 640 * 480 / 1e6
    with pytest.raises(TooLargeError, match=r"expected at most 0\.3 megapixels, found 640x480"):
        check_pixels(replace(both, most_megapixels=0.3))


@pytest.mark.parametrize("pack", [make_vr180, tablet_photo])
def test_views_embedded_in_a_picture_are_measured_by_their_own_headers(photos, tmp_path, pack):
    left, right = photos
    path = tmp_path / "both.jpg"
    job = ServiceJob(folder=tmp_path, pictures=(path,), file="disparity.npy", most_megapixels=0.31)
    path.write_bytes(pack(left, right))
    assert check_pixels(job) == 2 * 640 * 480 / 1e6
    path.write_bytes(pack(left, np.tile(right, (2, 2, 1))))
    with pytest.raises(TooLargeError, match=r"expected at most 0\.31 megapixels, found 1280x960"):
        check_pixels(job)
