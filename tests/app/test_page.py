"""The page in a browser: the command serves it, and Chromium loads it without requests to other servers."""

import io
import re
import struct
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from browsers import chromium
from page_examples import start, stop
from page_visits import WINDOW, Visit, visiting
from PIL import Image
from playwright.sync_api import Browser

from stereoweave.app.session import Uploads, match_uploads, open_session, zip_files
from stereoweave.cameras.content import find_content
from stereoweave.errors import StereoweaveError
from stereoweave.io.colormap import colour_disparity, find_colour_range_px
from stereoweave.io.images import read_image, write_image
from stereoweave.io.maps import read_pfm
from stereoweave.matching.backend import Backend
from stereoweave.outputs.results import FILES
from stereoweave.pictures.prepare import Request

TEXTURED = Path(__file__).resolve().parents[1] / "textured_pair"
EXAMPLES = Path(__file__).resolve().parents[2] / "examples"  # with a far horizon
SIZE = (640, 480)

pytestmark = [pytest.mark.system, pytest.mark.needs_chromium]


@pytest.fixture(scope="module")
def address(tmp_path_factory) -> Iterator[str]:
    folder = tmp_path_factory.mktemp("page")
    server, address = start(folder)
    yield address
    assert stop(server) == ""
    assert list(folder.glob("stereoweave-page-*")) == []


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as browser:
        yield browser


@pytest.fixture
def visit(browser, address) -> Iterator[Visit]:
    with visiting(browser, address) as visit:
        yield visit


@pytest.fixture(scope="module")
def hasty_visit(browser, address) -> Iterator[Visit]:
    with visiting(browser, address) as visit:
        yield visit


@pytest.fixture
def hasty(hasty_visit) -> Visit:
    """Return a visitor who repeatedly uploads something other than a pair."""
    hasty_visit.take_back()
    return hasty_visit


@pytest.fixture(scope="module")
def answered(browser, address) -> Iterator[Visit]:
    """Yield a visitor who has uploaded the example pair and has its result."""
    with visiting(browser, address) as visit:
        visit.give(left=TEXTURED / "left.png", right=TEXTURED / "right.png")
        visit.page.get_by_text("Layout and calibration").click()
        visit.give(calibration=TEXTURED / "calib.txt")
        visit.page.get_by_label("fast").check()
        assert "640×480 px" in visit.find()
        yield visit


def difference(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.abs(one.astype(float) - other).mean())


def test_the_slider_moves_from_the_left_image_to_the_right_one(answered):
    left, right = (read_image(TEXTURED / f"{side}.png") for side in ("left", "right"))
    assert difference(left, right) > 20
    assert difference(answered.move("0"), left) < 4
    assert difference(answered.move("1"), right) < 4
    halfway = answered.move("0.5")
    assert min(difference(halfway, left), difference(halfway, right)) > 8


def test_keys_move_the_slider(answered):
    answered.move("0.25")
    answered.page.locator("#position input[type=range]").press("ArrowRight")
    answered.page.locator("#where").get_by_text("0.3, between the cameras").wait_for()


def test_the_files_are_those_of_the_command(answered, tmp_path):
    answered.open("Files")
    packed = answered.download("all", tmp_path)
    with zipfile.ZipFile(packed) as archive:
        archive.extractall(tmp_path)
    assert {file.name for file in tmp_path.iterdir()} == {packed.name, *FILES}
    disparity_px = read_pfm(tmp_path / "disparity.pfm")
    assert disparity_px.shape == SIZE[::-1]
    # 600 px * 100 mm
    np.testing.assert_allclose(np.load(tmp_path / "depth.npy"), 60 / disparity_px, rtol=1e-5)
    expected = colour_disparity(disparity_px, find_colour_range_px(disparity_px))
    answered.open("View")
    assert difference(answered.picture("depth"), expected) < 6


def test_two_clicks_measure_a_distance(answered):
    answered.open("Measure")
    # Until its picture is there, the page takes no click, and has another layout.
    answered.page.wait_for_function("document.querySelector('#clickable img')?.naturalWidth > 0")
    box = answered.page.locator("#clickable img").bounding_box()
    for count, (across, down) in enumerate(((0.3, 0.45), (0.7, 0.6)), start=1):
        answered.page.mouse.click(box["x"] + across * box["width"], box["y"] + down * box["height"])
        answered.page.locator("#measured p").get_by_text("disparity").nth(count - 1).wait_for()
        answered.page.wait_for_function("document.querySelector('#clickable img').complete")
    said = answered.page.locator("#measured").inner_text()
    answered.open("View")
    points = []
    for column, row, disparity_px in re.findall(r"\((\d+), (\d+)\): disparity ([\d.]+) px", said):
        depth_m = 60 / float(disparity_px)
        points.append(np.array([int(column) - 319.5, int(row) - 239.5, 600]) / 600 * depth_m)
    assert len(points) == 2
    found_m = float(re.search(r"Between the two: ([\d.]+) m ± ", said)[1])
    assert found_m == pytest.approx(np.linalg.norm(points[1] - points[0]), rel=0.02)


def test_the_report_is_shown_and_turns_the_scene(visit, tmp_path):
    # Without a graphics card, Chromium takes seconds to draw the scene of a large picture, again and again.
    for eye in ("left", "right"):
        with Image.open(TEXTURED / f"{eye}.png") as picture:
            picture.reduce(4).save(tmp_path / f"{eye}.png")
    visit.give(left=tmp_path / "left.png", right=tmp_path / "right.png")
    visit.page.get_by_label("fast").check()
    assert "160×120 px" in visit.find()
    visit.open("Explore")
    report = visit.page.frame_locator("#report iframe")
    report.get_by_role("radio", name="3-D").check(force=True)
    scene = report.locator("#mesh")
    scene.wait_for()

    def drawn_percent() -> float:
        shown = np.asarray(Image.open(io.BytesIO(scene.screenshot())).convert("RGB")).astype(int)
        return 100 * float((np.abs(shown - shown[-2, 2]).max(axis=2) > 20).mean())

    for _ in range(60):
        if drawn_percent() > 50:
            break
        visit.page.wait_for_timeout(500)
    assert drawn_percent() > 50
    report.get_by_text("Point at or touch one of these three images").wait_for()
    assert report.get_by_text("These files are in the folder of this page").count() == 0


def test_visitors_do_not_see_each_others_results(answered, visit, tmp_path):
    assert not visit.page.locator("#view").is_visible()
    left, right = (read_image(TEXTURED / f"{side}.png")[::-1] for side in ("left", "right"))
    Image.fromarray(np.hstack([left, right])).save(tmp_path / "upside_down.png")
    visit.give(left=tmp_path / "upside_down.png")
    visit.page.get_by_label("fast").check()
    visit.find()
    assert difference(visit.move("0"), left) < 4
    assert difference(answered.move("0"), left[::-1]) < 4


def test_the_sample_needs_one_click_and_has_metres(visit):
    visit.page.click("#sample")
    visit.page.locator("#status").get_by_text("depth from").wait_for()


def test_an_invalid_focal_length_is_reported(hasty):
    hasty.give(left=TEXTURED / "left.png", right=TEXTURED / "right.png")
    hasty.page.get_by_text("Layout and calibration").click()
    for name in ("focal", "baseline"):
        field = hasty.page.locator(f"#{name} input")
        field.click()
        field.press("ControlOrMeta+a")
        field.press_sequentially("-600")
        field.press("Tab")
    assert "“Focal length, px”: expected a number from 0 to 1,000,000" in hasty.find()
    for name in ("focal", "baseline"):
        hasty.page.locator(f"#{name} input").fill("0")


def test_the_page_fits_a_telephone(answered):
    answered.page.set_viewport_size({"width": 390, "height": 800})
    answered.page.wait_for_timeout(200)
    width = answered.page.evaluate("document.documentElement.scrollWidth")
    answered.page.set_viewport_size(WINDOW)
    assert width == 390


def test_an_expired_upload_is_requested_again(tmp_path):
    request = Request(calibration=tmp_path / "calib.txt")
    uploads = Uploads(
        pictures=(TEXTURED / "left.png", TEXTURED / "right.png"), request=request, backend=Backend()
    )
    with pytest.raises(
        StereoweaveError,
        match=r"^calib.txt: expected an upload from the last hour, found an expired one; upload the file "
        r"again$",
    ):
        match_uploads(uploads, lambda share, what: None)


def test_views_of_an_aligned_pair_have_no_borders(tmp_path):
    left, right = (read_image(TEXTURED / f"{side}.png") for side in ("left", "right"))
    write_image(tmp_path / "left.png", left[30:450, 40:600])
    write_image(tmp_path / "right.png", right[36:456, 40:600])  # 6 rows lower
    uploads = Uploads(
        pictures=(tmp_path / "left.png", tmp_path / "right.png"),
        request=Request(rectify=True),
        backend=Backend(),
    )
    result = match_uploads(uploads, lambda share, what: None)
    session = open_session(result, tmp_path)
    assert result.pair.left_seen is not None
    assert result.pair.left.shape == (420, 560, 3)
    height, width = session.renderer.view(0.5).image.shape[:2]
    assert 400 < height < 420
    assert 480 < width <= 560
    assert session.pair.left.shape[:2] == (height, width) == session.estimate.disparity_px.shape
    assert session.pair.left_seen is None
    # A click on the first and the last shown pixel is one on the corners of the content.
    rows, columns = find_content(result.pair)
    assert session.given_px((0, 0)) == (columns.start, rows.start)
    assert session.given_px((width - 1, height - 1)) == (columns.stop - 1, rows.stop - 1)
    shown = session.pair.left[height // 2, width // 2]
    column, row = session.given_px((width // 2, height // 2))
    assert (shown == result.pair.left[row, column]).all()


def test_large_files_are_not_zipped(tmp_path):
    small, large = tmp_path / "small.npy", tmp_path / "large.npy"
    for file, size in ((small, 9), (large, 301 * 1024**2)):
        with file.open("wb") as opened:
            opened.truncate(size)
    assert zip_files(tmp_path / "all.zip", [small, large]) is None
    assert not (tmp_path / "all.zip").exists()
    assert zip_files(tmp_path / "all.zip", [small]) == tmp_path / "all.zip"


def test_an_invalid_picture_is_named_without_its_folder(hasty, tmp_path):
    (tmp_path / "notes.txt").write_text("no picture")
    hasty.give(left=tmp_path / "notes.txt", right=TEXTURED / "right.png")
    said = hasty.find()
    assert said.startswith("notes.txt: expected ")
    assert "/" not in said
    assert hasty.page.locator("#status .notice").get_attribute("role") == "alert"


def test_a_form_without_pictures_is_reported(hasty):
    assert hasty.find().startswith("expected a left and a right picture, or one file with both views")


def test_what_is_said_comes_into_the_window(hasty, tmp_path):
    (tmp_path / "left.png").write_bytes(b"")
    hasty.give(left=tmp_path / "left.png")
    hasty.page.set_viewport_size({"width": 1280, "height": 300})
    top = "document.querySelector('#status').getBoundingClientRect().top"
    hasty.page.locator("#sample").scroll_into_view_if_needed()
    hasty.page.wait_for_function(f"{top} < 0")
    hasty.find()
    hasty.page.wait_for_function(f"{top} >= 0")
    hasty.page.set_viewport_size(WINDOW)


def test_a_picture_of_800_megapixels_is_refused(hasty, tmp_path):
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", 32_000, 25_000, 8, 2, 0, 0, 0)
    png = (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(b""))
        + chunk(b"IEND", b"")
    )
    (tmp_path / "bomb.png").write_bytes(png)
    hasty.give(left=tmp_path / "bomb.png")
    said = hasty.find()
    assert said.startswith("bomb.png: expected ")
    assert len(said.splitlines()) == 1


def test_a_file_of_more_than_200_megabytes_is_refused(hasty, tmp_path):
    with (tmp_path / "large.tiff").open("wb") as file:
        file.truncate(201 * 1024**2)
    hasty.page.locator("#left input[type=file]").set_input_files(tmp_path / "large.tiff")
    hasty.page.get_by_text(re.compile("exceed the maximum allowed size of 200")).first.wait_for()


def test_the_page_sends_requests_only_to_its_server(answered, address):
    elsewhere = [url for url in answered.asked if not url.startswith((address, "data:", "blob:"))]
    assert len(answered.asked) > 50
    assert elsewhere == []
    assert answered.refused == []
