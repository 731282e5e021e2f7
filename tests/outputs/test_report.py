import base64
import io
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from browsers import chromium
from PIL import Image
from playwright.sync_api import Browser, Page

from stereoweave.outputs.report import POSITIONS, Summary, downscale, summarize, write_report
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
    write_report(tmp_path / "report.html", pair, estimate, summary, threads=1)
    assert "value / 256 - 269 px" in (tmp_path / "report.html").read_text()
    assert summary_of(pair, estimate, "a.png").disparity_scale_px is None


def test_a_depth_is_none_without_a_camera_and_at_infinity(rng):
    photograph = texture(rng, 40, 100)
    pair, estimate = wall(photograph, SHIFT_PX, None)
    assert summary_of(pair, estimate, "a.png").depth_min_m is None
    toed_in = StereoCamera(focal_px=400, baseline_m=0.04, cx_px=0, cy_px=0, doffs_px=-SHIFT_PX)
    assert summary_of(*wall(photograph, SHIFT_PX, toed_in), "a.png").depth_max_m is None


def test_each_view_of_the_report_is_the_wall_seen_from_its_position(rng, tmp_path):
    photograph = texture(rng, 120, 320 + SHIFT_PX)
    pair, estimate = wall(photograph, SHIFT_PX, CAMERA)
    write_report(tmp_path / "report.html", pair, estimate, summary_of(pair, estimate, "a.png"))
    pictures = pictures_in((tmp_path / "report.html").read_text(encoding="utf-8"))
    for position in (0.0, 0.25, 0.5, 1.0):
        moved_px = int(position * SHIFT_PX)
        expected = photograph[:, moved_px : moved_px + 320]
        assert difference(pictures[f"View at position {position}"], expected) < 3


def test_a_large_picture_is_downscaled_with_its_disparity(rng, tmp_path):
    photograph = texture(rng, 160, 2000 + 80)
    pair, estimate = wall(photograph, 80, None)
    write_report(tmp_path / "report.html", pair, estimate, summary_of(pair, estimate, "a.png"))
    pictures = pictures_in((tmp_path / "report.html").read_text(encoding="utf-8"))
    halfway = np.asarray(Image.fromarray(photograph[:, 40:2040]).resize((1000, 80)))
    assert pictures["Left image"].shape == (80, 1000, 3)
    assert difference(pictures["View at position 0.5"], halfway) < 5


def test_depth_is_black_outside_the_left_image_s_content(rng, tmp_path):
    pair, estimate = wall(texture(rng, 120, 320 + SHIFT_PX), SHIFT_PX, CAMERA)
    seen = np.ones((120, 320), bool)
    seen[:, :80] = False
    pair = replace(pair, left_seen=seen)
    write_report(tmp_path / "report.html", pair, estimate, summary_of(pair, estimate, "a.png"))
    depth = pictures_in((tmp_path / "report.html").read_text(encoding="utf-8"))["Depth in colour"]
    assert depth[:, :72].max() < 8
    assert depth[:, 88:].max(axis=2).min() > 40
    shown, _ = downscale(pair, estimate, 160)
    assert (shown.left_seen == seen[::2, ::2]).all()


def test_the_page_is_one_file_that_refers_to_no_other(rng, tmp_path):
    pair, estimate = wall(texture(rng, 120, 352), SHIFT_PX, CAMERA)
    write_report(tmp_path / "report.html", pair, estimate, summary_of(pair, estimate, "a.png", "b.png"))
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert [file.name for file in tmp_path.iterdir()] == ["report.html"]
    assert "http:" not in page
    assert "https:" not in page
    addresses = re.findall(r'(?:src|href)="([^"]*)"', page)
    assert len(addresses) == len(POSITIONS) + 4
    assert all(address.startswith("data:") for address in addresses)


def test_a_file_name_cannot_add_to_the_page(rng, tmp_path):
    pair, estimate = wall(texture(rng, 60, 132), SHIFT_PX, None)
    summary = summary_of(pair, estimate, "<img src=x>$title.png", "</script>")
    write_report(tmp_path / "report.html", pair, estimate, summary)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "&lt;img src=x&gt;$title.png + &lt;/script&gt;" in page
    assert "<img src=x>" not in page


def test_the_legend_is_in_metres_with_a_camera_and_in_pixels_without(rng, tmp_path):
    photograph = texture(rng, 60, 132)
    for camera, legend in ((CAMERA, "<span>0.500 m</span>"), (None, "<span>32.0 px</span>")):
        pair, estimate = wall(photograph, SHIFT_PX, camera)
        write_report(tmp_path / "report.html", pair, estimate, summary_of(pair, estimate, "a.png"))
        assert legend in (tmp_path / "report.html").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as browser:
        yield browser


@pytest.fixture
def photograph(rng) -> np.ndarray:
    return texture(rng, 240, 320 + SHIFT_PX)


@pytest.fixture
def report(photograph, tmp_path) -> Path:
    """Write a report on a wall 0.5 m away. Returns its path."""
    pair, estimate = wall(photograph, SHIFT_PX, CAMERA)
    write_report(tmp_path / "report.html", pair, estimate, summary_of(pair, estimate, "a.png", "b.png"))
    return tmp_path / "report.html"


@pytest.fixture
def page(browser) -> Iterator[Page]:
    """Yield an empty browser page; the test fails if one of its scripts does."""
    page = browser.new_page(viewport={"width": 1200, "height": 1600})
    errors: list[str] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    yield page
    page.close()
    assert errors == []


@pytest.mark.needs_chromium
def test_the_slider_changes_the_picture(page, report, photograph):
    def seen_from(position: float) -> float:
        """Return the difference between the displayed image and the wall seen from `position`."""
        shown = np.asarray(Image.open(io.BytesIO(page.locator("#stage").screenshot())).convert("RGB"))
        moved_px = round(position * SHIFT_PX)
        expected = Image.fromarray(photograph[:, moved_px : moved_px + 320]).resize(shown.shape[1::-1])
        return difference(shown, np.asarray(expected))

    page.goto(report.as_uri())
    assert seen_from(0.5) < 4
    assert seen_from(0.75) > 12

    for key in ("Tab", "ArrowRight", "ArrowRight"):
        page.keyboard.press(key)
    assert page.text_content("#where").startswith("0.75, between the cameras")
    assert seen_from(0.75) < 4
    assert seen_from(0.5) > 12

    slider = page.locator("#position").bounding_box()
    left_end = page.locator(".ends span").first.bounding_box()
    page.mouse.click(left_end["x"] + left_end["width"] / 2, slider["y"] + slider["height"] / 2)
    assert page.text_content("#where").startswith("0, at the left camera")
    assert seen_from(0) < 4


@pytest.mark.needs_chromium
def test_pointing_at_the_depth_reads_it(page, report):
    page.goto(report.as_uri())
    depth = page.locator("#depth").bounding_box()
    page.mouse.move(depth["x"] + depth["width"] / 4, depth["y"] + depth["height"] / 2)
    # 400 px * 0.04 m / 32 px
    assert page.text_content("#reading") == "(80, 120): disparity 32.00 px, depth 0.500 m"


@pytest.mark.needs_chromium
def test_opening_the_report_requests_only_its_own_file(page, report):
    requested: list[str] = []
    page.on("request", lambda request: requested.append(request.url))
    page.goto(report.as_uri())
    for key in ("Tab", "ArrowRight"):
        page.keyboard.press(key)
    assert [url for url in requested if not url.startswith("data:")] == [report.as_uri()]
