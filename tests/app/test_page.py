"""The page in a browser: the command serves it, and Chromium loads it without requests to other servers."""

import io
import re
import shutil
import struct
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from browsers import chromium
from page_examples import start, stop
from PIL import Image
from playwright.sync_api import Browser

from stereoweave.app.session import Uploads, match_uploads, write_cloud, zip_files
from stereoweave.errors import StereoweaveError
from stereoweave.io.colormap import colour_disparity, find_colour_range_px
from stereoweave.io.images import read_image
from stereoweave.io.maps import read_pfm
from stereoweave.matching.backend import Backend
from stereoweave.outputs.point_cloud import make_point_cloud
from stereoweave.outputs.results import FILES
from stereoweave.pictures.prepare import Request

TEXTURED = Path(__file__).resolve().parents[1] / "textured_pair"
EXAMPLES = Path(__file__).resolve().parents[2] / "examples"  # with a far horizon
SIZE = (640, 480)
UNDRAWN = "cannot draw in 3-D"
WINDOW = {"width": 1280, "height": 1000}
# Without compiled kernels in the cache, they are compiled first.
PATIENCE_MS = 60_000

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


class Visit:
    """One visitor's window; `asked` are the URLs that it requested, `refused` those that failed."""

    def __init__(self, browser: Any, address: str) -> None:
        self.asked: list[str] = []
        self.refused: list[str] = []
        self._context = browser.new_context(viewport=WINDOW)
        self.page = self._context.new_page()
        self.page.set_default_timeout(PATIENCE_MS)
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.on("response", lambda answer: answer.ok or self.refused.append(answer.url))
        self.page.goto(address)
        self.page.locator("#find").wait_for()

    def give(self, **files: Path) -> None:
        """Put files into the fields of these names."""
        for field, file in files.items():
            self.page.locator(f"#{field} input[type=file]").set_input_files(file)
            self.page.locator(f"#{field}").get_by_text(file.name.rsplit(".", 1)[0]).first.wait_for()

    def take_back(self) -> None:
        """Clear the fields for pictures."""
        for _ in range(self.page.get_by_label("Clear").count()):
            self.page.get_by_label("Clear").first.click()

    def find(self) -> str:
        """Find depth, wait until the notice has changed and all files exist, and return the notice."""
        said = self.page.locator("#status .notice")
        before = said.inner_text() if said.count() else ""
        self.page.click("#find")
        self.page.wait_for_function(
            "before => (document.querySelector('#status .notice')?.innerText ?? before) !== before",
            arg=before,
        )
        if said.get_attribute("role") == "status":
            self.page.get_by_role("tab", name="Files").click()
            self.page.locator("#files a").first.wait_for()
            self.page.get_by_role("tab", name="View and depth").click()
        return said.inner_text()

    def move(self, position: str) -> np.ndarray:
        """Move the slider and return the new view."""
        self.page.get_by_role("tab", name="View and depth").click()
        self.page.locator("#position input[type=range]").fill(position)
        self.page.locator("#where").get_by_text(re.compile(f"^{re.escape(position)}, ")).wait_for()
        return self.picture("view")

    def picture(self, name: str) -> np.ndarray:
        shown = self.page.locator(f"#{name} img")
        shown.wait_for()
        answer = self._context.request.get(shown.get_attribute("src"))
        assert answer.ok, (answer.status, answer.url, answer.text())
        return np.asarray(Image.open(io.BytesIO(answer.body())).convert("RGB"))

    def close(self) -> None:
        self._context.close()


@pytest.fixture
def visit(browser, address) -> Iterator[Visit]:
    visit = Visit(browser, address)
    yield visit
    visit.close()


@pytest.fixture(scope="module")
def hasty_visit(browser, address) -> Iterator[Visit]:
    visit = Visit(browser, address)
    yield visit
    visit.close()


@pytest.fixture
def hasty(hasty_visit) -> Visit:
    """Return a visitor who repeatedly uploads something other than a pair."""
    hasty_visit.take_back()
    return hasty_visit


@pytest.fixture(scope="module")
def answered(browser, address) -> Iterator[Visit]:
    """Yield a visitor who has uploaded the example pair and has its result."""
    visit = Visit(browser, address)
    visit.give(left=TEXTURED / "left.png", right=TEXTURED / "right.png")
    visit.page.get_by_text("More about the pictures").click()
    visit.give(calibration=TEXTURED / "calib.txt")
    assert "640×480 px" in visit.find()
    yield visit
    visit.close()


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
    answered.page.get_by_role("tab", name="Files").click()
    with answered.page.expect_download() as waiting:
        answered.page.click("#all")
    waiting.value.save_as(tmp_path / "all.zip")
    with zipfile.ZipFile(tmp_path / "all.zip") as archive:
        archive.extractall(tmp_path)
    assert {file.name for file in tmp_path.iterdir()} == {"all.zip", *FILES}
    disparity_px = read_pfm(tmp_path / "disparity.pfm")
    assert disparity_px.shape == SIZE[::-1]
    # 600 px * 100 mm
    np.testing.assert_allclose(np.load(tmp_path / "depth.npy"), 60 / disparity_px, rtol=1e-5)
    expected = colour_disparity(disparity_px, find_colour_range_px(disparity_px))
    answered.page.get_by_role("tab", name="View and depth").click()
    assert difference(answered.picture("depth"), expected) < 6


def test_two_clicks_measure_a_distance(answered):
    answered.page.get_by_role("tab", name="Measure").click()
    box = answered.page.locator("#clickable img").bounding_box()
    for count, (across, down) in enumerate(((0.3, 0.45), (0.7, 0.6)), start=1):
        answered.page.mouse.click(box["x"] + across * box["width"], box["y"] + down * box["height"])
        answered.page.locator("#measured p").get_by_text("disparity").nth(count - 1).wait_for()
        answered.page.wait_for_function("document.querySelector('#clickable img').complete")
    said = answered.page.locator("#measured").inner_text()
    answered.page.get_by_role("tab", name="View and depth").click()
    points = []
    for column, row, disparity_px in re.findall(r"\((\d+), (\d+)\): disparity ([\d.]+) px", said):
        depth_m = 60 / float(disparity_px)
        points.append(np.array([int(column) - 319.5, int(row) - 239.5, 600]) / 600 * depth_m)
    assert len(points) == 2
    found_m = float(re.search(r"Between the two: ([\d.]+) m ± ", said)[1])
    assert found_m == pytest.approx(np.linalg.norm(points[1] - points[0]), rel=0.02)


def test_the_point_cloud_is_drawn(answered):
    answered.page.get_by_role("tab", name="Point cloud").click()
    canvas = answered.page.locator("canvas")
    canvas.wait_for()

    def drawn_percent() -> float:
        shown = np.asarray(Image.open(io.BytesIO(canvas.screenshot())).convert("RGB")).astype(int)
        return 100 * float((np.abs(shown - shown[-20, 20]).max(axis=2) > 20).mean())

    for _ in range(60):
        if drawn_percent() > 4:
            break
        answered.page.wait_for_timeout(500)
    assert drawn_percent() > 4
    assert answered.page.get_by_text(UNDRAWN).count() == 0


def test_visitors_do_not_see_each_others_results(answered, visit, tmp_path):
    assert not visit.page.locator("#view").is_visible()
    left, right = (read_image(TEXTURED / f"{side}.png")[::-1] for side in ("left", "right"))
    Image.fromarray(np.hstack([left, right])).save(tmp_path / "upside_down.png")
    visit.give(left=tmp_path / "upside_down.png")
    visit.find()
    assert difference(visit.move("0"), left) < 4
    assert difference(answered.move("0"), left[::-1]) < 4


def test_the_sample_needs_one_click_and_has_metres(visit):
    visit.page.click("#sample")
    visit.page.locator("#status").get_by_text("depth from").wait_for()


def test_an_invalid_focal_length_is_reported(hasty):
    hasty.give(left=TEXTURED / "left.png", right=TEXTURED / "right.png")
    hasty.page.get_by_text("More about the pictures").click()
    for name in ("focal", "baseline"):
        field = hasty.page.locator(f"#{name} input")
        field.click()
        field.press("ControlOrMeta+a")
        field.press_sequentially("-600")
        field.press("Tab")
    assert "expected a number above 1e-09, found -600" in hasty.find()
    for name in ("focal", "baseline"):
        hasty.page.locator(f"#{name} input").fill("0")


def test_the_page_fits_a_telephone(answered):
    answered.page.set_viewport_size({"width": 390, "height": 800})
    answered.page.wait_for_timeout(200)
    width = answered.page.evaluate("document.documentElement.scrollWidth")
    answered.page.set_viewport_size(WINDOW)
    assert width == 390


def test_a_browser_without_webgl_gets_a_notice(browser, address):
    with_none = browser.browser_type.launch(
        executable_path=shutil.which("chromium"), args=["--no-sandbox", "--disable-3d-apis"]
    )
    page = Visit(with_none, address).page
    page.click("#sample")
    page.get_by_role("tab", name="Point cloud").click()
    page.get_by_text(UNDRAWN).wait_for()
    with_none.close()


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
        match_uploads(uploads, tmp_path, lambda share, what: None)


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
    assert hasty.find() == "expected a left and a right picture, or one file with both views, found none"


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


def test_a_far_horizon_does_not_shrink_the_viewers_point_cloud(tmp_path):
    uploads = Uploads(
        pictures=(EXAMPLES / "left.png", EXAMPLES / "right.png"),
        request=Request(calibration=EXAMPLES / "calib.txt"),
        backend=Backend(),
    )
    session = match_uploads(uploads, tmp_path, lambda share, what: None)
    drawn = trimesh.load(write_cloud(tmp_path / "drawn.glb", session.result), force="scene").to_geometry()
    depth_m = -drawn.vertices[:, 2]
    everything_m = make_point_cloud(session.result.pair, session.result.estimate).points_m[:, 2]
    assert depth_m.max() <= 4 * np.median(everything_m) < 50 < everything_m.max()
    assert len(depth_m) > 0.8 * len(everything_m)
