import base64
import io
import json
import re
import zlib
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import stereoweave
from stereoweave.outputs.report import POSITIONS, Context, Summary, summarize, write_report
from stereoweave.outputs.report_parts import CONTENTS, pack_map
from stereoweave.outputs.results import FILES
from stereoweave.stereo import Estimate, StereoCamera, StereoPair

CAMERA = StereoCamera(focal_px=400, baseline_m=0.04, cx_px=160, cy_px=60, doffs_px=0)
SHIFT_PX = 32


def texture(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """Return an image of soft coloured blobs, which neither JPEG nor scaling changes much."""
    coarse = rng.integers(0, 256, (height // 16 + 2, width // 16 + 2, 3), dtype=np.uint8)
    return np.asarray(Image.fromarray(coarse).resize((width, height), Image.Resampling.BICUBIC))


def wall(photograph: np.ndarray, shift_px: int, camera: StereoCamera | None) -> tuple[StereoPair, Estimate]:
    """Return a pair that shows a wall of constant disparity `shift_px`, and its estimate."""
    pair = StereoPair(left=photograph[:, :-shift_px], right=photograph[:, shift_px:], camera=camera)
    disparity_px = np.full(pair.left.shape[:2], shift_px, np.float32)
    return pair, Estimate(
        disparity_px=disparity_px,
        right_disparity_px=disparity_px,
        confidence=np.ones_like(disparity_px),
        occluded=np.zeros(disparity_px.shape, bool),
    )


def summary_of(pair: StereoPair, estimate: Estimate, *pictures: str) -> Summary:
    return summarize(pair, estimate, pictures=pictures, model="small", estimate_ms=12.34)


def pictures_in(page: str) -> dict[str, np.ndarray]:
    """Return the images of the page by their alternative text."""
    tags = re.findall(r'src="data:image/jpeg;base64,([^"]+)" alt="([^"]+)"', page)
    return {alt: np.asarray(Image.open(io.BytesIO(base64.b64decode(jpeg)))) for jpeg, alt in tags}


def difference(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.abs(one.astype(float) - other).mean())


def test_the_summary_matches_the_estimate():
    disparity_px = np.array([[1, 2, 4, 8, 16]] * 32, np.float32)
    estimate = Estimate(
        disparity_px=disparity_px,
        right_disparity_px=disparity_px,
        confidence=np.array([[0.1, 0.49, 0.5, 0.9, 1.0]] * 32, np.float32),
        occluded=np.array([[True, False, False, False, False]] * 32),
    )
    picture = np.zeros((32, 5, 3), np.uint8)
    summary = summary_of(StereoPair(left=picture, right=picture, camera=CAMERA), estimate, "a.png", "b.png")
    assert (summary.width_px, summary.height_px) == (5, 32)
    assert (summary.disparity_min_px, summary.disparity_median_px, summary.disparity_max_px) == (1, 4, 16)
    # 400 px * 0.04 m = 16 px m
    assert (summary.depth_min_m, summary.depth_median_m, summary.depth_max_m) == (1, 4, 16)
    assert summary.occluded_percent == 20
    assert summary.confident_percent == 60
    assert summary.estimate_ms == 12.3


def test_a_few_outliers_are_outside_the_range_that_the_summary_calls_the_1st_to_the_99th_percentile():
    disparity_px = np.full((100, 200), 8, np.float32)
    disparity_px[:, :20] = 4
    disparity_px.flat[:100] = -70  # half a percent
    disparity_px.flat[-100:] = 500
    picture = np.zeros((100, 200, 3), np.uint8)
    estimate = Estimate(
        disparity_px=disparity_px,
        right_disparity_px=disparity_px,
        confidence=np.ones_like(disparity_px),
        occluded=np.zeros(disparity_px.shape, bool),
    )
    summary = summary_of(StereoPair(left=picture, right=picture, camera=CAMERA), estimate, "a.png")
    assert (summary.disparity_min_px, summary.disparity_max_px) == (-70, 500)
    assert (summary.disparity_p1_px, summary.disparity_p99_px) == (4, 8)
    assert (summary.depth_p1_m, summary.depth_p99_m) == (2, 4)


def test_the_report_says_how_to_read_disparities_that_only_the_scaled_picture_holds(rng, tmp_path):
    pair, estimate = wall(texture(rng, 40, 100), SHIFT_PX, None)
    below = replace(estimate, disparity_px=estimate.disparity_px - 300)
    summary = summary_of(pair, below, "a.png")
    # From an offset of -269 px, 1 px below the least disparity, -268 px.
    assert (summary.disparity_scale_px, summary.disparity_offset_px) == (1 / 256, -269)
    write_report(tmp_path / "report.html", pair, estimate, summary, Context())
    assert "value / 256 - 269 px" in (tmp_path / "report.html").read_text()
    assert summary_of(pair, estimate, "a.png").disparity_scale_px is None


def test_a_depth_is_none_without_a_camera_and_at_infinity(rng):
    photograph = texture(rng, 40, 100)
    pair, estimate = wall(photograph, SHIFT_PX, None)
    assert summary_of(pair, estimate, "a.png").depth_min_m is None
    toed_in = StereoCamera(focal_px=400, baseline_m=0.04, cx_px=0, cy_px=0, doffs_px=-SHIFT_PX)
    assert summary_of(*wall(photograph, SHIFT_PX, toed_in), "a.png").depth_max_m is None


def test_what_has_the_median_disparity_stays_in_place_in_all_views_of_the_report(rng, tmp_path):
    photograph = texture(rng, 120, 320 + SHIFT_PX)
    pair, estimate = wall(photograph, SHIFT_PX, CAMERA)
    write_report(tmp_path / "report.html", pair, estimate, summary_of(pair, estimate, "a.png"), Context())
    pictures = pictures_in((tmp_path / "report.html").read_text(encoding="utf-8"))
    for position in POSITIONS:
        # The cameras' views are moved by half of the wall's disparity each, to meet in the middle.
        view = pictures[f"View at position {position}"]
        assert difference(view[:, 16:-16], photograph[:, 32:320]) < 3


def test_a_large_picture_is_downscaled_with_its_disparity(rng, tmp_path):
    photograph = texture(rng, 160, 2000 + 80)
    pair, estimate = wall(photograph, 80, None)
    write_report(tmp_path / "report.html", pair, estimate, summary_of(pair, estimate, "a.png"), Context())
    pictures = pictures_in((tmp_path / "report.html").read_text(encoding="utf-8"))
    halfway = np.asarray(Image.fromarray(photograph[:, 40:2040]).resize((1000, 80)))
    assert pictures["Left image"].shape == (80, 1000, 3)
    assert difference(pictures["View at position 0.5"], halfway) < 5


def test_depth_is_black_outside_the_left_image_s_content(rng, tmp_path):
    pair, estimate = wall(texture(rng, 120, 320 + SHIFT_PX), SHIFT_PX, CAMERA)
    seen = np.ones((120, 320), bool)
    seen[:, :80] = False
    pair = replace(pair, left_seen=seen)
    write_report(tmp_path / "report.html", pair, estimate, summary_of(pair, estimate, "a.png"), Context())
    depth = pictures_in((tmp_path / "report.html").read_text(encoding="utf-8"))["Depth in colour"]
    assert depth[:, :72].max() < 8
    assert depth[:, 88:].max(axis=2).min() > 40


def test_the_page_is_one_file_that_refers_to_no_other(rng, tmp_path):
    pair, estimate = wall(texture(rng, 120, 352), SHIFT_PX, CAMERA)
    write_report(
        tmp_path / "report.html", pair, estimate, summary_of(pair, estimate, "a.png", "b.png"), Context()
    )
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert [file.name for file in tmp_path.iterdir()] == ["report.html"]
    assert "http:" not in page
    assert "https:" not in page
    addresses = re.findall(r'(?:src|href)="([^"]*)"', page)
    assert len(addresses) == len(POSITIONS) + 5
    assert all(address.startswith("data:") for address in addresses)


def test_a_file_name_cannot_add_to_the_page(rng, tmp_path):
    pair, estimate = wall(texture(rng, 60, 132), SHIFT_PX, None)
    summary = summary_of(pair, estimate, "<img src=x>$title.png", "</script>")
    write_report(tmp_path / "report.html", pair, estimate, summary, Context())
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "&lt;img src=x&gt;$title.png + &lt;/script&gt;" in page
    assert "<img src=x>" not in page


def test_the_legend_is_in_metres_with_a_camera_and_in_pixels_without(rng, tmp_path):
    photograph = texture(rng, 60, 132)
    for camera, legend in ((CAMERA, "<span>0.500 m</span>"), (None, "<span>32.0 px</span>")):
        pair, estimate = wall(photograph, SHIFT_PX, camera)
        write_report(tmp_path / "report.html", pair, estimate, summary_of(pair, estimate, "a.png"), Context())
        assert legend in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_the_report_says_what_a_disparity_is_and_how_to_get_metres_only_without_a_camera(rng, tmp_path):
    photograph = texture(rng, 60, 132)
    texts = "how many pixels apart the two pictures show a point", "For depth in metres, give a calibration"
    for camera in (CAMERA, None):
        pair, estimate = wall(photograph, SHIFT_PX, camera)
        write_report(tmp_path / "report.html", pair, estimate, summary_of(pair, estimate, "a.png"), Context())
        page = (tmp_path / "report.html").read_text(encoding="utf-8")
        assert [text in page for text in texts] == [camera is None] * 2


def test_a_file_name_in_a_note_or_in_the_command_cannot_add_to_the_page(rng, tmp_path):
    pair, estimate = wall(texture(rng, 60, 132), SHIFT_PX, None)
    hostile = "<script>alert(1)</script>$title & \"'"
    context = Context(warnings=(hostile,), notes=(hostile,), command=f"stereoweave depth {hostile}")
    write_report(tmp_path / "report.html", pair, estimate, summary_of(pair, estimate, "a.png"), context)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "<script>alert" not in page
    assert page.count("&lt;script&gt;alert(1)&lt;/script&gt;$title &amp; &quot;&#x27;") == 3


def test_the_report_says_how_it_was_made_and_what_is_wrong(rng, tmp_path):
    pair, estimate = wall(texture(rng, 60, 132), SHIFT_PX, None)
    context = Context(
        warnings=("the sides are swapped",),
        notes=("two pictures in one file",),
        command="stereoweave depth 'my pair.jps'",
        date=datetime(2026, 11, 23, 13, 5, tzinfo=UTC),
    )
    write_report(tmp_path / "report.html", pair, estimate, summary_of(pair, estimate, "a.png"), context)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert '<section class="banner"><h2>Warnings</h2><ul><li>the sides are swapped</li></ul>' in page
    assert "<li>two pictures in one file</li>" in page
    assert "stereoweave depth &#x27;my pair.jps&#x27;" in page
    assert f"Stereoweave {stereoweave.__version__}" in page
    assert "2026-11-23 13:05 UTC" in page
    write_report(tmp_path / "report.html", pair, estimate, summary_of(pair, estimate, "a.png"), Context())
    assert "Warnings" not in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_equal_results_have_equal_reports(rng, tmp_path):
    pair, estimate = wall(texture(rng, 60, 132), SHIFT_PX, CAMERA)
    for name in ("one.html", "two.html"):
        write_report(tmp_path / name, pair, estimate, summary_of(pair, estimate, "a.png"), Context())
    assert (tmp_path / "one.html").read_bytes() == (tmp_path / "two.html").read_bytes()


def test_the_report_links_to_the_files_beside_it(rng, tmp_path):
    pair, estimate = wall(texture(rng, 60, 132), SHIFT_PX, None)
    (tmp_path / "disparity.pfm").write_bytes(bytes(2_345_678))
    (tmp_path / "occluded.png").write_bytes(bytes(1234))
    context = Context(files=(tmp_path / "disparity.pfm", tmp_path / "occluded.png"))
    write_report(tmp_path / "report.html", pair, estimate, summary_of(pair, estimate, "a.png"), context)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert re.findall(r'href="([^"]*)" download>', page) == ["disparity.pfm", "occluded.png"]
    assert "<span>2.3 MB</span>" in page
    assert "<span>1 kB</span>" in page


@pytest.mark.parametrize(("reach_px", "exact_px"), [(40.0, 1 / 128), (9000.0, 9000 / 131070)])
def test_the_packed_map_holds_disparity_confidence_and_occlusion(rng, reach_px, exact_px):
    disparity_px = rng.uniform(-reach_px / 4, 3 * reach_px / 4, (6, 9)).astype(np.float32)
    confidence = rng.uniform(0, 1, (6, 9)).astype(np.float32)
    confidence[0, :3] = np.nan
    occluded = rng.uniform(0, 1, (6, 9)) < 0.5
    packed = pack_map(disparity_px, confidence, occluded)
    planes = np.frombuffer(zlib.decompress(base64.b64decode(packed["packed"])), np.uint8).reshape(3, 6, 9)
    levels = np.cumsum(planes[0] + 256 * planes[1].astype(int), axis=1) % 65536
    found_px = packed["low_px"] + packed["step_px"] * levels
    np.testing.assert_allclose(found_px, disparity_px, atol=exact_px * 1.01)
    assert (planes[2][0, :3] == 255).all()
    known = ~np.isnan(confidence)
    np.testing.assert_allclose(planes[2][known] % 128 / 100, confidence[known], atol=0.0051)
    np.testing.assert_array_equal(planes[2][known] >= 128, occluded[known])


def scene_of(folder: Path, pair: StereoPair, estimate: Estimate) -> dict[str, float]:
    write_report(folder / "report.html", pair, estimate, summary_of(pair, estimate, "a.png"), Context())
    page = (folder / "report.html").read_text(encoding="utf-8")
    (data,) = re.findall(r'id="data">(.*?)</script>', page)
    return json.loads(data)["scene"]


def test_the_3_d_view_turns_about_the_middle_of_the_disparities_in_baselines(rng, tmp_path):
    photograph = texture(rng, 60, 132)
    with_camera = scene_of(tmp_path, *wall(photograph, SHIFT_PX, CAMERA))
    # 400 px / 32 px, and four times that
    assert (with_camera["middle"], with_camera["farthest"]) == (12.5, 50)
    assert with_camera["least_px"] == SHIFT_PX / 4
    without = scene_of(tmp_path, *wall(photograph, SHIFT_PX, None))
    assert (without["focal_px"], without["cx_px"], without["doffs_px"]) == (100, 49.5, 0)
    assert without["middle"] == 100 / 32


def test_a_scene_that_is_infinitely_far_for_its_camera_is_shown_as_without_a_camera(rng, tmp_path):
    toed_in = StereoCamera(focal_px=400, baseline_m=0.04, cx_px=0, cy_px=0, doffs_px=-SHIFT_PX)
    scene = scene_of(tmp_path, *wall(texture(rng, 60, 132), SHIFT_PX, toed_in))
    assert (scene["focal_px"], scene["middle"]) == (100, 100 / 32)
    pair, estimate = wall(texture(rng, 60, 132), SHIFT_PX, None)
    estimate = replace(estimate, disparity_px=estimate.disparity_px - 72)
    assert scene_of(tmp_path, pair, estimate)["doffs_px"] == 41  # the whole wall at -40 px: moved to 1 px


def test_each_file_of_a_result_is_described_in_the_report():
    assert set(CONTENTS) == set(FILES) - {"report.html"}
