"""The 3-D viewer in a browser shows what the cameras saw, and what the renderer renders between them."""

import base64
import html
import io
import json
import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from browsers import FLAGS, chromium
from PIL import Image
from playwright.sync_api import Browser, BrowserContext, Frame, Page

from stereoweave.errors import StereoweaveError
from stereoweave.outputs.viewer import make_viewer, viewer_script, write_viewer
from stereoweave.outputs.viewer_scene import POSITIONS, pack_scene
from stereoweave.rendering.renderer import Renderer
from stereoweave.stereo import Estimate, StereoPair

HEIGHT, WIDTH = 180, 320
WALL_PX, BOX_PX = 6, 30
DRAW = """async ([x, up]) => {
  const view = stereoweaveViewer.view, canvas = document.getElementById("view");
  stereoweaveViewer.stop();
  [canvas.width, canvas.height] = view.scene.shown_px.slice(2).map(Math.round);
  view.draw(x, up);
  return canvas.toDataURL("image/png");
}"""
FAILED: list[str] = []  # errors of the pages' scripts
FRAMES = """count => new Promise(done => {
  const next = () => count-- ? requestAnimationFrame(next) : done();
  next();
})"""


def texture(rng: np.random.Generator, height: int, width: int, least: int, most: int) -> np.ndarray:
    """Return an image of soft coloured blobs, which neither JPEG nor scaling changes much."""
    coarse = rng.integers(least, most, (height // 12 + 2, width // 12 + 2, 3), dtype=np.uint8)
    return np.asarray(Image.fromarray(coarse).resize((width, height), Image.Resampling.BICUBIC))


@pytest.fixture(scope="module")
def scene() -> tuple[StereoPair, Estimate]:
    """Return a dark box of disparity 30 before a bright wall of disparity 6, and its exact estimate."""
    rng = np.random.default_rng(7)
    wall, box = texture(rng, HEIGHT, WIDTH + WALL_PX, 120, 256), texture(rng, 80, 90, 30, 100)
    left, right = wall[:, :WIDTH].copy(), wall[:, WALL_PX:].copy()
    left_px, right_px = (np.full((HEIGHT, WIDTH), WALL_PX, np.float32) for _ in range(2))
    for image, disparity_px, column in ((left, left_px, 130), (right, right_px, 130 - BOX_PX)):
        image[50:130, column : column + 90] = box
        disparity_px[50:130, column : column + 90] = BOX_PX
    estimate = Estimate(
        disparity_px=left_px,
        right_disparity_px=right_px,
        confidence=np.ones_like(left_px),
        occluded=np.zeros(left_px.shape, bool),
    )
    return StereoPair(left=left, right=right), estimate


@pytest.fixture(scope="module")
def photo(scene, tmp_path_factory) -> Path:
    """Write the viewer's page of the scene. Returns its path."""
    path = tmp_path_factory.mktemp("viewer") / "photo.html"
    write_viewer(path, make_viewer(*scene, title="left.png + right.png", convergence_px=0))
    return path


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as browser:
        yield browser


def start(browser: Browser, *flags: str) -> Browser:
    """Start another Chromium with further flags."""
    return browser.browser_type.launch(executable_path=shutil.which("chromium"), args=[*FLAGS, *flags])


def open_page(place: Browser | BrowserContext, path: Path, **options) -> Page:
    """Open the page, and wait for its first frame, which sets the size of the canvas."""
    page = place.new_page(**options)
    page.on("pageerror", lambda error: FAILED.append(str(error)))
    page.goto(path.as_uri())
    wait_until(page, "Boolean(window.stereoweaveViewer)")
    page.evaluate(FRAMES, 1)
    return page


def wait_until(page: Page | Frame, condition: str) -> None:
    """Wait for a condition, frame by frame: the page's policy forbids what Playwright's own waiting does."""
    for _ in range(1000):
        if page.evaluate(condition):
            return
        page.evaluate(FRAMES, 1)
    raise AssertionError(f"never: {condition}")


@pytest.fixture(autouse=True)
def no_script_fails() -> Iterator[None]:
    FAILED.clear()
    yield
    assert FAILED == []


def seen_from(page: Page, position: float, up: float = 0.0) -> np.ndarray:
    address = page.evaluate(DRAW, [position, up])
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(address.split(",")[1]))).convert("RGB"))


def packed(path: Path) -> dict:
    return json.loads(re.search(r'id="scene">(.*?)</script>', path.read_text(encoding="utf-8"), re.DOTALL)[1])


def cut(image: np.ndarray, path: Path) -> np.ndarray:
    """Return the part of a view that the page shows, at the canvas's size."""
    left, top, width, height = packed(path)["shown_px"]
    columns = (np.arange(round(width)) + 0.5) * width / round(width) + left - 0.5
    rows = (np.arange(round(height)) + 0.5) * height / round(height) + top - 0.5
    grid = np.meshgrid(columns.astype(np.float32), rows.astype(np.float32))
    return cv2.remap(image, *grid, cv2.INTER_LINEAR)


def difference(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.abs(one.astype(float) - other).max(axis=2)


@pytest.mark.needs_chromium
def test_from_the_left_camera_the_canvas_shows_the_left_picture(browser, photo, scene):
    shown = seen_from(open_page(browser, photo), 0)
    assert difference(shown, cut(scene[0].left, photo)).mean() < 4


@pytest.mark.needs_chromium
@pytest.mark.parametrize("position", [0.5, 1.0, 1.1])
def test_from_the_right_the_canvas_shows_the_renderer_s_view(browser, photo, scene, position):
    view = Renderer(*scene, convergence_px=0.0, threads=1).view(position)
    apart = difference(seen_from(open_page(browser, photo), position), cut(view.image, photo))
    drawn = cut(view.drawn.astype(np.uint8), photo) > 0
    assert apart[drawn].mean() < 6
    assert (apart[drawn] > 60).mean() < 0.005  # the box and its edges are where they should be


@pytest.mark.needs_chromium
def test_what_the_box_uncovers_is_the_wall_that_the_right_camera_sees(browser, photo, scene):
    shown = seen_from(open_page(browser, photo), 1)
    left, top = (round(x) for x in packed(photo)["shown_px"][:2])
    # The box ends at column 130 - 30 + 90 of the right picture; 24 px of the wall beside it are new.
    uncovered = slice(60 - top, 120 - top), slice(194 - left, 212 - left)
    assert difference(shown, cut(scene[0].right, photo))[uncovered].mean() < 8


@pytest.mark.needs_chromium
@pytest.mark.parametrize(("position", "up"), [(-0.1, 0), (1.1, 0.2), (0.5, -0.2), (-0.1, 0.2)])
def test_no_view_has_a_gap_or_a_stretched_edge(browser, photo, position, up):
    shown = seen_from(open_page(browser, photo), position, up).astype(int)
    assert shown.max(axis=2).min() > 25  # the box is darker than 100, but nothing is black
    # Levels between box and wall exist only within the pixel of an edge, however far it has opened.
    grey = shown.mean(axis=2)
    between = (grey > 108) & (grey < 118)
    assert between.mean() < 0.02


@pytest.fixture(scope="module")
def speckled(scene, tmp_path_factory) -> Path:
    """Write the page of the scene with an estimate in which 200 spots of 1 to 3 px of each map are wrong."""
    pair, exact = scene
    rng = np.random.default_rng(5)
    maps_px = exact.disparity_px.copy(), exact.right_disparity_px.copy()
    for disparity_px in maps_px:
        for _ in range(200):
            row, column, size = rng.integers(40, 140), rng.integers(80, 260), rng.integers(1, 4)
            disparity_px[row : row + size, column : column + size] = rng.uniform(0, BOX_PX)
    path = tmp_path_factory.mktemp("speckled") / "photo.html"
    estimate = replace(exact, disparity_px=maps_px[0], right_disparity_px=maps_px[1])
    write_viewer(path, make_viewer(pair, estimate, convergence_px=0))
    return path


@pytest.mark.needs_chromium
@pytest.mark.parametrize(("position", "wide_px"), [(-0.1, 40), (1.1, 60)])
def test_no_dots_fly_where_the_estimate_is_wrong_in_spots(browser, speckled, scene, position, wide_px):
    shown = seen_from(open_page(browser, speckled), position)
    # The nearer camera sees the wall that this end uncovers; its picture is moved to the viewpoint.
    seen, beyond = (scene[0].right, position - 1) if position > 0.5 else (scene[0].left, position)
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float32)
    wall = cut(cv2.remap(seen, x + np.float32(beyond * WALL_PX), y, cv2.INTER_LINEAR), speckled)
    left, top = packed(speckled)["shown_px"][:2]
    end = round((220 if position > 0.5 else 130) - position * BOX_PX - left)
    columns = slice(end + 5, end + wide_px) if position > 0.5 else slice(end - wide_px, end - 5)
    rows = slice(round(40 - top), round(140 - top))
    assert (difference(shown, wall)[rows, columns] > 50).mean() < 0.001


@pytest.mark.needs_chromium
def test_a_page_opens_offline_and_requests_nothing(browser, photo):
    context = browser.new_context(offline=True)
    requested: list[str] = []
    context.on("request", lambda request: requested.append(request.url))
    page = open_page(context, photo)
    page.mouse.move(300, 200)
    page.evaluate(FRAMES, 5)
    context.close()
    assert [url for url in requested if not url.startswith("data:")] == [photo.as_uri()]


def test_the_page_allows_no_address_and_only_its_own_script(photo):
    page = photo.read_text(encoding="utf-8")
    assert "default-src 'none'; img-src data:; style-src 'sha256-" in page
    assert "unsafe" not in page
    assert "http:" not in page
    assert "https:" not in page


@pytest.mark.parametrize(
    ("setting", "value", "told"),
    [
        ("convergence_px", -1000.0, "expected -{width} to {width} px (the picture's width), got -1000.0"),
        ("strength", -1.0, "expected 0 or more, got -1.0"),
    ],
)
def test_a_page_is_refused_the_shifts_that_a_view_is_refused(scene, setting, value, told):
    with pytest.raises(StereoweaveError) as caught:
        make_viewer(*scene, **{setting: value})
    assert str(caught.value) == f"{setting}: {told.format(width=scene[0].left.shape[1])}"


def test_a_title_cannot_add_to_the_page(scene):
    page = make_viewer(*scene, title="</script><img src=x>$scene")
    assert "<img src=x>" not in page
    assert "&lt;img src=x&gt;$scene" in page


@pytest.mark.needs_chromium
def test_the_mouse_moves_the_view_to_the_right(browser, photo):
    page = open_page(browser, photo, viewport={"width": 800, "height": 600})
    page.mouse.move(790, 300)
    wait_until(page, "stereoweaveViewer.eye[0] > 0.9")
    page.mouse.move(10, 300)
    wait_until(page, "stereoweaveViewer.eye[0] < -0.9")


@pytest.mark.needs_chromium
def test_a_finger_drags_the_view_on_a_phone(browser, photo):
    phone = browser.new_context(
        viewport={"width": 390, "height": 844}, is_mobile=True, has_touch=True, reduced_motion="reduce"
    )
    page = open_page(phone, photo)
    assert page.locator("#hint").inner_text() == "Drag to look around"
    box = page.locator("#view").bounding_box()
    assert box["x"] >= 0
    assert box["x"] + box["width"] <= 390
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    touch = phone.new_cdp_session(page)
    for kind, x in (("touchStart", 250), ("touchMove", 200), ("touchMove", 120), ("touchEnd", None)):
        points = [] if x is None else [{"x": x, "y": 400}]
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
    wait_until(page, "stereoweaveViewer.eye[0] > 0.9")  # 130 px is a third of the width
    phone.close()


@pytest.mark.needs_chromium
def test_a_finger_can_hit_each_button_of_a_phone(browser, photo):
    phone = browser.new_context(viewport={"width": 390, "height": 844}, is_mobile=True, has_touch=True)
    page = open_page(phone, photo)
    for name in ("Pause motion", "Tilt to look around"):
        box = page.get_by_role("button", name=name).bounding_box()
        assert min(box["width"], box["height"]) >= 44
    phone.close()


@pytest.mark.needs_chromium
def test_tilting_a_phone_moves_the_view_once_that_is_allowed(browser, photo):
    phone = browser.new_context(
        viewport={"width": 390, "height": 844}, is_mobile=True, has_touch=True, reduced_motion="reduce"
    )
    page = open_page(phone, photo)
    held = phone.new_cdp_session(page)
    tilt = "DeviceOrientation.setDeviceOrientationOverride"
    held.send(tilt, {"alpha": 0, "beta": 40, "gamma": 0})
    page.get_by_role("button", name="Tilt to look around").click()
    page.get_by_role("button", name="Tilt to look around").wait_for(state="hidden")
    page.evaluate(FRAMES, 10)
    assert page.evaluate("stereoweaveViewer.target") == [0, 0]  # the way in which it is held is the middle
    held.send(tilt, {"alpha": 0, "beta": 40, "gamma": 9})
    wait_until(page, "stereoweaveViewer.eye[0] > 0.4")
    phone.close()


@pytest.mark.needs_chromium
def test_a_slow_graphics_processor_draws_coarsely_in_motion_and_sharply_at_rest(browser, photo):
    context = browser.new_context(viewport={"width": 800, "height": 600}, reduced_motion="reduce")
    # Frames 0.1 s apart, as a slow processor draws them.
    context.add_init_script(
        "let at_ms = 0, ask = window.requestAnimationFrame;"
        "window.requestAnimationFrame = (use) => ask.call(window, () => use((at_ms += 100)));"
    )
    page = open_page(context, photo)
    width_px = page.evaluate("document.querySelector('#view').width")
    page.evaluate("window.wander = setInterval(() => stereoweaveViewer.look(Math.random(), 0), 20)")
    wait_until(page, f"document.querySelector('#view').width < {0.7 * width_px}")
    page.evaluate("clearInterval(wander)")
    wait_until(page, f"document.querySelector('#view').width === {width_px}")
    context.close()


@pytest.mark.needs_chromium
def test_arrow_keys_move_the_view(browser, photo):
    page = open_page(browser.new_context(reduced_motion="reduce"), photo)
    page.focus("#view")
    for key in ("ArrowLeft", "ArrowLeft", "ArrowUp"):
        page.keyboard.press(key)
    assert page.evaluate("stereoweaveViewer.target") == [pytest.approx(-0.4), pytest.approx(0.2)]


@pytest.mark.needs_chromium
def test_an_idle_view_moves_by_itself_unless_less_motion_is_asked_for_or_it_is_paused(browser, photo):
    page = open_page(browser, photo)
    wait_until(page, "Math.abs(stereoweaveViewer.eye[0]) > 0.3")
    page.get_by_role("button", name="Pause motion").click()
    page.mouse.move(0, 0)
    assert page.get_by_role("button", name="Play motion").is_visible()
    assert not page.evaluate("stereoweaveViewer.sway")
    calm = open_page(browser.new_context(reduced_motion="reduce"), photo)
    calm.evaluate(FRAMES, 20)
    assert calm.evaluate("stereoweaveViewer.eye") == [0, 0]


@pytest.mark.needs_chromium
def test_without_webgl_or_scripts_the_left_picture_is_shown_with_the_reason(browser, photo, scene):
    def still_on(page: Page) -> np.ndarray:
        shown = Image.open(io.BytesIO(page.locator("#still").screenshot())).convert("RGB")
        left, top, width, height = packed(photo)["shown_px"]
        return np.asarray(shown.resize((round(width), round(height))))

    plain = start(browser, "--disable-3d-apis")
    page = plain.new_page()
    page.goto(photo.as_uri())
    wait_until(page, "document.getElementById('hint').textContent.includes('has no WebGL')")
    assert not page.locator("#view").is_visible()
    assert difference(still_on(page), cut(scene[0].left, photo)).mean() < 12
    plain.close()
    page = browser.new_context(java_script_enabled=False).new_page()
    page.goto(photo.as_uri())
    assert "needs JavaScript and WebGL" in page.locator("#hint").inner_text()
    assert difference(still_on(page), cut(scene[0].left, photo)).mean() < 12


@pytest.mark.needs_chromium
def test_webgl_1_is_enough(browser, photo, scene):
    old = start(browser, "--disable-webgl2")
    page = open_page(old, photo)
    assert page.evaluate("stereoweaveViewer.view.gl.constructor.name") == "WebGLRenderingContext"
    assert difference(seen_from(page, 0), cut(scene[0].left, photo)).mean() < 4
    old.close()


@pytest.mark.needs_chromium
def test_the_view_comes_back_after_the_system_took_the_graphics_away(browser, photo, scene):
    page = open_page(browser, photo)
    page.evaluate(
        """() => new Promise(done => {
          const canvas = document.getElementById("view");
          const graphics = stereoweaveViewer.view.gl.getExtension("WEBGL_lose_context");
          canvas.addEventListener("webglcontextlost", () => setTimeout(() => graphics.restoreContext()));
          canvas.addEventListener("webglcontextrestored", done);
          graphics.loseContext();
        })"""
    )
    assert difference(seen_from(page, 0), cut(scene[0].left, photo)).mean() < 4


@pytest.mark.needs_chromium
def test_the_page_works_in_a_frame_of_a_page_with_a_policy_of_its_own(browser, photo, tmp_path):
    policy = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
    (tmp_path / "outer.html").write_text(
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        f'<iframe srcdoc="{html.escape(photo.read_text(encoding="utf-8"))}"></iframe>',
        encoding="utf-8",
    )
    page = browser.new_page()
    page.goto((tmp_path / "outer.html").as_uri())
    wait_until(page.frames[1], "Boolean(window.stereoweaveViewer)")


@pytest.mark.needs_chromium
def test_another_page_shows_a_packed_scene_on_its_own_canvas(browser, scene):
    packed_scene = pack_scene(*scene, convergence_px=0)
    page = browser.new_page()
    page.set_content(
        f"<canvas width={WIDTH} height={HEIGHT}></canvas><script>{viewer_script()}</script>"
        f"<script>const scene = {json.dumps(packed_scene)};</script>"
    )
    address = page.evaluate(
        """async () => {
          const canvas = document.querySelector("canvas");
          scene.shown_px = [0, 0, ...scene.size_px];
          const view = await StereoweaveViewer.makeView(canvas, scene);
          view.draw(0, 0);
          return canvas.toDataURL("image/png");
        }"""
    )
    shown = np.asarray(Image.open(io.BytesIO(base64.b64decode(address.split(",")[1]))).convert("RGB"))
    assert difference(shown, scene[0].left).mean() < 4


def test_a_page_of_a_noisy_pair_of_12_megapixels_has_less_than_3_mb():
    rng = np.random.default_rng(3)
    photograph = rng.integers(0, 256, (3000, 4000, 3), dtype=np.uint8)
    ramp_px = np.linspace(0, 300, 4000, dtype=np.float32) + rng.normal(0, 0.3, (3000, 4000)).astype(
        np.float32
    )
    estimate = Estimate(
        disparity_px=ramp_px,
        right_disparity_px=ramp_px,
        confidence=np.ones_like(ramp_px),
        occluded=np.zeros(ramp_px.shape, bool),
    )
    pair = StereoPair(left=photograph, right=photograph)
    assert len(make_viewer(pair, estimate).encode()) < 3e6


def test_strength_widens_the_viewpoints_about_the_middle(scene):
    assert pack_scene(*scene)["positions"] == pytest.approx(list(POSITIONS))
    assert pack_scene(*scene, strength=0.5)["positions"] == pytest.approx([0.2, 0.8])


def test_a_large_picture_is_packed_at_1600_px_and_a_small_one_at_its_size(scene):
    assert pack_scene(*scene)["size_px"] == [WIDTH, HEIGHT]
    assert pack_scene(*scene, size_px=(160, 160))["size_px"] == [160, 90]
    pair = StereoPair(left=np.zeros((1000, 2000, 3), np.uint8), right=np.zeros((1000, 2000, 3), np.uint8))
    flat_px = np.full((1000, 2000), 8, np.float32)
    estimate = Estimate(
        disparity_px=flat_px,
        right_disparity_px=flat_px,
        confidence=np.ones_like(flat_px),
        occluded=np.zeros(flat_px.shape, bool),
    )
    assert pack_scene(pair, estimate, size_px=(9000, 9000))["size_px"] == [1600, 800]
