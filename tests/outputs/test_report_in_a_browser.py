"""The report as its readers use it: in Chromium, by mouse, keyboard and finger."""

import io
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from browsers import chromium
from PIL import Image
from playwright.sync_api import Browser, Page

from stereoweave.outputs.report import Context, summarize, write_report
from stereoweave.stereo import Estimate, StereoCamera, StereoPair

pytestmark = pytest.mark.needs_chromium

CAMERA = StereoCamera(focal_px=400, baseline_m=0.04, cx_px=160, cy_px=60, doffs_px=0)
SHIFT_PX = 32


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as browser:
        yield browser


@pytest.fixture
def photograph(rng) -> np.ndarray:
    """Return soft coloured blobs, which neither JPEG nor scaling changes much."""
    coarse = rng.integers(0, 256, (17, 24, 3), dtype=np.uint8)
    blobs = Image.fromarray(coarse).resize((320 + SHIFT_PX, 240), Image.Resampling.BICUBIC)
    return np.asarray(blobs)


@pytest.fixture
def report(photograph, tmp_path) -> Path:
    """Write a report on a wall 0.5 m away, whose right half is occluded and 25 % confident."""
    pair = StereoPair(left=photograph[:, :-SHIFT_PX], right=photograph[:, SHIFT_PX:], camera=CAMERA)
    return write(tmp_path / "report.html", pair, np.full((240, 320), SHIFT_PX, np.float32))


@pytest.fixture
def step(photograph, tmp_path) -> Path:
    """Write a report on a wall of 32 px above a farther one of 0 px."""
    disparity_px = np.full((240, 320), SHIFT_PX, np.float32)
    disparity_px[144:] = 0
    left = photograph[:, :-SHIFT_PX]
    right = np.vstack([photograph[:144, SHIFT_PX:], photograph[144:, :-SHIFT_PX]])
    return write(tmp_path / "step.html", StereoPair(left=left, right=right), disparity_px)


def write(path: Path, pair: StereoPair, disparity_px: np.ndarray) -> Path:
    right = np.tile(np.arange(320) >= 160, (240, 1))
    estimate = Estimate(
        disparity_px=disparity_px,
        right_disparity_px=disparity_px,
        confidence=np.where(right, 0.25, 1).astype(np.float32),
        occluded=right,
    )
    summary = summarize(pair, estimate, pictures=("a.png", "b.png"), model="small", estimate_ms=12.34)
    path.with_name("disparity.pfm").write_bytes(b"Pf")
    context = Context(
        warnings=("<b>the sides are swapped</b>",),
        command="stereoweave depth a.png b.png",
        files=(path.with_name("disparity.pfm"),),
    )
    write_report(path, pair, estimate, summary, context)
    return path


@pytest.fixture
def page(browser) -> Iterator[Page]:
    """Yield an empty browser page; the test fails if one of its scripts does."""
    yield from open_page(browser, width=1200, height=1600)


@pytest.fixture
def phone(browser) -> Iterator[Page]:
    """Yield a page as narrow as a phone's, with a touch screen and reduced motion."""
    yield from open_page(browser, width=390, height=844, has_touch=True, reduced_motion="reduce")


def open_page(browser: Browser, width: int, height: int, **options) -> Iterator[Page]:
    page = browser.new_page(viewport={"width": width, "height": height}, **options)
    page.set_default_timeout(10_000)
    errors: list[str] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("console", lambda said: errors.append(said.text) if said.type == "error" else None)
    yield page
    page.close()
    assert errors == []


def visit(page: Page, report: Path) -> None:
    """Open a report, and wait until it can be read out."""
    page.goto(report.as_uri())
    page.evaluate("unpacked.then(() => null)")


def wait_until(page: Page, condition: str) -> None:
    """Wait for a condition in JavaScript; the page forbids Playwright's own way, which calls eval."""
    page.evaluate(
        "new Promise((met) => {"
        f"  const look = () => {condition} ? met() : requestAnimationFrame(look);"
        "  look();"
        "})"
    )


def choose(page: Page, kind: str) -> None:
    page.get_by_role("radio", name=kind).check()


def choose_3_d(page: Page) -> None:
    """Choose the 3-D view, and wait until it can be turned."""
    choose(page, "3-D")
    wait_until(page, "mesh")


def shown(page: Page, what: str) -> np.ndarray:
    """Return what the browser shows of an element, without the button over it."""
    page.add_style_tag(content=".enlarge { display: none !important; }")
    return np.asarray(Image.open(io.BytesIO(page.locator(what).screenshot())).convert("RGB")).astype(float)


def moves_px(before: np.ndarray, after: np.ndarray) -> tuple[float, float]:
    """Return how far the upper and the lower part of the picture move to the right, in px of the pair."""
    height, width = before.shape[:2]
    parts = slice(height // 20, int(0.5 * height)), slice(int(0.7 * height), int(0.95 * height))
    found = []
    for rows in parts:
        greys = [np.ascontiguousarray(image[rows].mean(axis=2)) for image in (before, after)]
        window = cv2.createHanningWindow(greys[0].shape[::-1], cv2.CV_64F)
        found.append(cv2.phaseCorrelate(*greys, window)[0][0] * 320 / width)
    return found[0], found[1]


def put_slider(page: Page, position: float) -> np.ndarray:
    """Move the slider, and return what the browser then shows."""
    page.locator("#position").fill(str(position))
    assert page.text_content("#where").startswith(f"{position:g}, ")
    page.evaluate("new Promise((drawn) => requestAnimationFrame(() => requestAnimationFrame(drawn)))")
    return shown(page, "#stage")


def test_the_slider_moves_the_viewpoint_smoothly_about_the_middle_of_the_scene(page, step):
    """From 0.25 to 0.77 what is 32 px farther than the median moves by 0.52 * 32 px."""
    visit(page, step)
    page.wait_for_selector("#photo")
    near, far = moves_px(put_slider(page, 0.25), put_slider(page, 0.77))
    assert near == pytest.approx(0, abs=0.5)
    assert far == pytest.approx(0.52 * SHIFT_PX, abs=1.5)
    page.keyboard.press("ArrowRight")
    assert page.text_content("#where") == "0.78, between the cameras"


def test_without_webgl_the_slider_shows_the_nearest_of_five_views(page, step):
    page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    visit(page, step)
    near, far = moves_px(put_slider(page, 0.27), put_slider(page, 0.77))
    assert near == pytest.approx(0, abs=0.5)
    assert far == pytest.approx(0.5 * SHIFT_PX, abs=1)
    choose(page, "3-D")
    page.get_by_text("has no WebGL 2").wait_for()


def test_a_browser_that_cannot_decompress_shows_all_but_the_read_out_and_the_3_d_view(page, report):
    page.add_init_script("delete window.DecompressionStream")
    visit(page, report)
    page.locator("#depth").hover()
    assert page.locator(".reading").nth(1).text_content() == "Far is blue, near is red."
    choose(page, "3-D")
    page.get_by_text("This browser is too old for the 3-D view").wait_for()
    choose(page, "Viewpoint")
    assert page.locator("#photo").is_visible()


def test_without_scripts_the_report_shows_the_middle_view_and_no_controls(browser, step):
    page = browser.new_page(java_script_enabled=False)
    page.goto(step.as_uri())
    assert page.get_by_alt_text("View at position 0.5").is_visible()
    assert page.get_by_role("radio").count() + page.get_by_role("slider").count() == 0
    page.close()


def test_the_marks_below_the_slider_are_at_the_cameras(page, report):
    visit(page, report)
    slider = page.locator("#position").bounding_box()
    for mark, position in zip(page.locator(".ends span").all(), (0, 1), strict=True):
        box = mark.bounding_box()
        page.mouse.click(box["x"] + box["width"] / 2, slider["y"] + slider["height"] / 2)
        assert abs(float(page.input_value("#position")) - position) <= 0.01


def test_dragging_the_picture_moves_the_viewpoint_and_does_not_enlarge_it(page, report):
    visit(page, report)
    stage = page.locator("#stage").bounding_box()
    page.mouse.move(stage["x"] + stage["width"] / 2, stage["y"] + stage["height"] / 2)
    page.mouse.down()
    # Eleven twelfths of the way from -0.1 to 1.1; half-way to the upper border is half-way up.
    page.mouse.move(stage["x"] + stage["width"] * 11 / 12, stage["y"] + stage["height"] / 4, steps=4)
    page.mouse.up()
    assert page.text_content("#where") == "1, at the right camera"
    assert page.evaluate("shownFrom.up / data.photo.up") == pytest.approx(0.5, abs=0.01)
    assert not page.evaluate("full.open")


@pytest.mark.parametrize(
    ("share", "ending"), [(0.25, "confidence 100 %"), (0.75, "confidence 25 %, occluded")]
)
def test_pointing_at_a_picture_reads_disparity_depth_and_confidence(page, report, share, ending):
    visit(page, report)
    pictures = page.locator(".frame").all()
    assert len(pictures) == 3
    for picture in pictures:
        box = picture.bounding_box()
        page.mouse.move(box["x"] + box["width"] * share, box["y"] + box["height"] / 2)
        # 400 px * 0.04 m / 32 px
        expected = f"({round(320 * share)}, 120): disparity 32.00 px, depth 0.500 m, {ending}"
        assert page.locator(".reading").all_text_contents() == [expected] * 3


def test_the_arrow_keys_read_pixel_by_pixel_and_say_what_they_read(page, report):
    visit(page, report)
    page.focus("#depth")
    page.keyboard.press("ArrowLeft")
    assert page.text_content("#spoken").startswith("(159, 120): disparity 32.00 px")
    page.keyboard.press("Shift+ArrowDown")
    assert page.text_content("#spoken").startswith("(159, 140): disparity 32.00 px")


def test_a_click_enlarges_a_picture_with_its_read_out_and_escape_puts_it_back(page, report):
    visit(page, report)
    before = page.locator("#depth").bounding_box()
    page.locator("#depth").click(position={"x": 20, "y": 20})
    large = page.locator("dialog #depth").bounding_box()
    assert large["width"] > 2.5 * before["width"]
    page.mouse.move(large["x"] + large["width"] / 4, large["y"] + large["height"] / 2)
    assert page.text_content("dialog .reading").startswith("(80, 120): disparity 32.00 px")
    page.keyboard.press("Escape")
    page.wait_for_selector("dialog .card", state="detached")
    assert page.locator("#depth").bounding_box() == before


def test_each_picture_is_enlarged_by_keyboard_and_the_focus_returns(page, report):
    visit(page, report)
    buttons = page.get_by_role("button", name="Enlarge: ")
    names = [button.get_attribute("aria-label") for button in buttons.all()]
    assert names == [f"Enlarge: {name}" for name in ("New views", "Left image", "Depth", "Confidence")]
    for name in names:
        page.get_by_role("button", name=name).press("Enter")
        assert page.get_by_role("dialog", name=name.removeprefix("Enlarge: ")).is_visible()
        page.keyboard.press("Escape")
        page.wait_for_selector("dialog .card", state="detached")
        assert page.evaluate("document.activeElement.getAttribute('aria-label')") == name


def test_a_finger_enlarges_a_picture_on_a_phone_which_shows_all_without_scrolling_sideways(phone, report):
    visit(phone, report)
    assert phone.evaluate("document.documentElement.scrollWidth") <= 390
    phone.locator("#depth").tap()
    assert phone.get_by_role("dialog", name="Depth").is_visible()
    phone.get_by_role("button", name="Close").tap()
    phone.wait_for_selector("dialog .card", state="detached")


def test_an_enlarged_picture_takes_most_of_a_phone_held_sideways(phone, report):
    phone.set_viewport_size({"width": 844, "height": 390})
    visit(phone, report)
    phone.get_by_role("button", name="Enlarge: Depth").tap()
    # 70 % of the height, and in proportion
    box = phone.locator("#depth").bounding_box()
    assert (box["width"], box["height"]) == (pytest.approx(364, abs=1), pytest.approx(273, abs=1))


def test_the_wiggle_moves_by_itself_until_it_is_paused(page, report):
    visit(page, report)
    choose(page, "Wiggle")
    wait_until(page, "shownFrom.position !== 0.5")
    page.get_by_role("button", name="Pause").click()
    paused = page.evaluate("shownFrom.position")
    page.evaluate("new Promise((go) => requestAnimationFrame(() => requestAnimationFrame(go)))")
    assert page.evaluate("shownFrom.position") == paused
    assert page.get_by_role("button", name="Play").is_visible()


def test_nothing_moves_by_itself_where_reduced_motion_is_asked_for(phone, report):
    visit(phone, report)
    choose(phone, "Wiggle")
    assert phone.get_by_role("button", name="Play").is_visible()
    assert phone.evaluate("wiggling") == 0


def test_the_anaglyph_is_shown_on_request(page, report):
    visit(page, report)
    before = shown(page, "#stage")
    choose(page, "Anaglyph")
    assert page.locator("#anaglyph").is_visible()
    assert np.abs(shown(page, "#stage") - before).mean() > 5
    assert page.get_by_text("red-cyan glasses").is_visible()
    choose(page, "Viewpoint")
    assert not page.locator("#anaglyph").is_visible()


def test_the_3_d_view_starts_as_the_left_image_and_turns_about_the_middle_of_the_scene(
    page, report, photograph
):
    """The wall is a plane at the distance about which it turns, so each view is a homography of it."""
    page.emulate_media(reduced_motion="reduce")
    visit(page, report)
    choose_3_d(page)
    left = photograph[:, :-SHIFT_PX]
    assert difference_from_turned(page, left, turned=0.0, away=1.0) < 4

    page.focus("#mesh")
    for _ in range(4):
        page.keyboard.press("ArrowRight")
    assert difference_from_turned(page, left, turned=0.4, away=1.0) < 4
    assert difference_from_turned(page, left, turned=-0.4, away=1.0) > 12

    page.get_by_role("button", name="Start again").click()
    for _ in range(3):
        page.get_by_role("button", name="Zoom out").click()
    assert difference_from_turned(page, left, turned=0.0, away=1.15**3) < 5
    assert difference_from_turned(page, left, turned=0.0, away=1.0) > 12
    assert shown(page, "#stage")[-30:-15].max() < 40  # below the wall there is nothing


def difference_from_turned(page: Page, left: np.ndarray, turned: float, away: float) -> float:
    """Return how the 3-D view differs from the wall turned so that what is near moves right.

    `turned` is an angle in radians, and `away` the wall's distance in multiples of its first distance. Only
    what the turned wall covers, less a margin, is compared.
    """
    page.evaluate("new Promise((drawn) => requestAnimationFrame(() => requestAnimationFrame(drawn)))")
    found = shown(page, "#stage")
    height, width = found.shape[:2]
    to_given = np.diag([320 / width, 240 / height, 1.0])
    # A point c px right of and r px below the principal point: c / f and r / f, in distances of the wall.
    inner = np.array([[1 / 400, 0, -160 / 400], [0, 1 / 400, -60 / 400], [0, 0, 1]])
    turn = np.array([[np.cos(turned), 0, 0], [0, 1, 0], [np.sin(turned), 0, away]])
    matrix = np.linalg.inv(to_given) @ np.linalg.inv(inner) @ turn @ inner
    expected = cv2.warpPerspective(left, matrix, (width, height)).astype(float)
    covered = cv2.erode(cv2.warpPerspective(np.ones_like(left), matrix, (width, height)), np.ones((21, 21)))
    assert covered.mean() > 0.2
    return float(np.abs(found - expected)[covered > 0].mean())


def test_dragging_the_3_d_view_turns_it_and_does_not_enlarge_it(page, report):
    page.emulate_media(reduced_motion="reduce")
    visit(page, report)
    choose_3_d(page)
    box = page.locator("#mesh").bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] * 0.75, box["y"] + box["height"] / 2, steps=4)
    page.mouse.up()
    # The whole width would turn it by 2 radians.
    assert page.evaluate("mesh.pose.yaw") == pytest.approx(-0.5, abs=0.01)
    assert page.evaluate("mesh.pose.pitch") == 0
    assert not page.evaluate("full.open")


def test_triangles_join_one_surface_and_leave_out_what_the_left_image_does_not_cover(page, report):
    visit(page, report)
    maps = "{ levels: [10, 11, 30, 10, 11, 30], percents: [99, 99, 99, 99, 255, 99] }"
    whole = maps.replace("255", "99")
    all_corners = [0, 3, 1, 1, 3, 4, 1, 4, 2, 2, 4, 5]
    for given, steepest_px, corners in (
        (maps, 100, [0, 3, 1]),
        (whole, 100, all_corners),
        (whole, 1, all_corners[:6]),
    ):
        map_ = "{ width: 3, height: 2, step_px: 1 }"
        assert page.evaluate(f"[...triangulate({given}, {map_}, {steepest_px})]") == corners


def test_a_warning_stands_above_the_pictures_as_text(page, report):
    visit(page, report)
    banner = page.locator(".banner")
    assert banner.inner_text().splitlines()[-1] == "<b>the sides are swapped</b>"
    assert banner.bounding_box()["y"] < page.locator("#stage").bounding_box()["y"]


def test_a_link_opens_the_file_beside_the_report(page, report):
    visit(page, report)
    page.get_by_role("link", name="disparity.pfm").click()
    page.wait_for_url("**/disparity.pfm")
    assert page.inner_text("body") == "Pf"


def test_opening_the_report_requests_only_its_own_file(page, report):
    requested: list[str] = []
    page.on("request", lambda request: requested.append(request.url))
    visit(page, report)
    choose(page, "Wiggle")
    choose(page, "Anaglyph")
    assert [url for url in requested if not url.startswith("data:")] == [report.as_uri()]


def test_the_report_runs_no_script_but_its_own(browser, report):
    hostile = report.read_text(encoding="utf-8").replace(
        "</header>", "<script>window.ran = true</script></header>"
    )
    report.with_name("hostile.html").write_text(hostile, encoding="utf-8")
    refused: list[str] = []
    other = browser.new_page()
    other.on("console", lambda said: refused.append(said.text))
    other.goto(report.with_name("hostile.html").as_uri())
    assert other.evaluate("window.ran") is None
    assert other.text_content("#where").startswith("0.5, halfway")
    assert "Content Security Policy" in refused[0]
    other.close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_contrasts_with_its_background_by_at_least_4_5(page, report, scheme):
    page.emulate_media(color_scheme=scheme)
    visit(page, report)
    colours = page.evaluate(
        "(names) => names.map((name) => getComputedStyle(document.body).getPropertyValue(name).trim())",
        ["--text", "--quiet", "--accent", "--card", "--page", "--warn-text", "--warn"],
    )
    text, quiet, accent, card, ground, warn_text, warn = map(luminance, colours)
    for front, back in [*((f, b) for f in (text, quiet, accent) for b in (card, ground)), (warn_text, warn)]:
        assert (max(front, back) + 0.05) / (min(front, back) + 0.05) >= 4.5


def luminance(colour: str) -> float:
    """Return the relative luminance of a colour such as #1b1f27 (WCAG 2.2)."""
    share = np.array([int(colour[at : at + 2], 16) for at in (1, 3, 5)]) / 255
    light = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return float(light @ (0.2126, 0.7152, 0.0722))
