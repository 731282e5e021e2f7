"""Long work of the page in Chromium: visitors at once, cancelling, leaving, and 3-D pictures and videos."""

import io
import re
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import av
import cv2
import numpy as np
import psutil
import pytest
from browsers import chromium
from heic_examples import write_heic
from page_examples import start, stop
from page_visits import Visit, visiting
from PIL import Image
from playwright.sync_api import Browser
from spatial_examples import SPATIAL
from video_examples import example_pairs, packed, write_video

from stereoweave.app.stereo_pictures import AUTOMATIC_PX, FULL_PX, KINDS, Wish, write_stereo_picture
from stereoweave.app.video_tab import label_of
from stereoweave.app.video_upload import VideoUpload, convert_upload, keep_uploads
from stereoweave.errors import FormatError, StereoweaveError
from stereoweave.io.images import read_image, write_image
from stereoweave.matching.backend import Backend
from stereoweave.matching.options import MatchOptions
from stereoweave.outputs.run import Result, run
from stereoweave.pictures.prepare import Request, prepare

TEXTURED = Path(__file__).resolve().parents[1] / "textured_pair"
WIDTH, HEIGHT = 320, 240
WAIT_S = 60
# A window reads the end of a stream of results a second late.
LATE_ENDS = """
const load = window.fetch;
window.fetch = async (...given) => {
    const answer = await load(...given);
    if (!String(given[0].url ?? given[0]).includes("/queue/data")) return answer;
    const late = new TransformStream({
        async transform(text, stream) {
            const end = text.indexOf('data: {"msg":"close_stream"');
            stream.enqueue(end < 0 ? text : text.slice(0, end));
            if (end < 0) return;
            await new Promise((wake) => setTimeout(wake, 1000));
            stream.enqueue(text.slice(end));
        },
    });
    const body = answer.body.pipeThrough(new TextDecoderStream()).pipeThrough(late);
    return new Response(body.pipeThrough(new TextEncoderStream()), answer);
};
"""
AT_WORK = re.compile("looking through the video|frame \\d")

pytestmark = [pytest.mark.system, pytest.mark.needs_chromium]


@pytest.fixture(scope="module")
def server(tmp_path_factory) -> Iterator[tuple[int, str]]:
    """Serve the page; yield the server's process ID and address."""
    server, address = start(tmp_path_factory.mktemp("page"))
    yield server.pid, address
    assert stop(server) == ""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as browser:
        yield browser


@pytest.fixture
def visit(browser, server) -> Iterator[Visit]:
    with visiting(browser, server[1]) as visit:
        yield visit


@pytest.fixture(scope="module")
def pair(tmp_path_factory) -> dict[str, Path]:
    """Write the example pair at half its size."""
    folder = tmp_path_factory.mktemp("pair")
    for side in ("left", "right"):
        whole = read_image(TEXTURED / f"{side}.png")
        write_image(folder / f"{side}.png", cv2.resize(whole, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA))
    return {side: folder / f"{side}.png" for side in ("left", "right")}


@pytest.fixture(scope="module")
def large_pair(tmp_path_factory) -> dict[str, Path]:
    """Write the example pair at 4 times its size; the finest network takes many seconds for it."""
    folder = tmp_path_factory.mktemp("large")
    for side in ("left", "right"):
        whole = read_image(TEXTURED / f"{side}.png")
        write_image(folder / f"{side}.jpg", cv2.resize(whole, (2560, 1920), interpolation=cv2.INTER_CUBIC))
    return {side: folder / f"{side}.jpg" for side in ("left", "right")}


@pytest.fixture(scope="module")
def endless_video(tmp_path_factory) -> Path:
    """Write a video of 80 s, whose conversion takes longer than any test waits for it."""
    video = tmp_path_factory.mktemp("video") / "endless.mp4"
    frames = [packed(*pair) for pair in example_pairs(50)]
    return write_video(video, frames * 40)


def workers_of(pid: int) -> set[int]:
    """Return the process IDs of a server's children."""
    return {child.pid for child in psutil.Process(pid).children()}


def worker_at_work(pid: int) -> psutil.Process:
    """Return the child of a server that uses the processor most."""
    return max(psutil.Process(pid).children(), key=lambda child: child.cpu_percent(interval=0.5))


def wait_until(condition) -> None:
    deadline_s = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < deadline_s
        time.sleep(0.05)


def ask(file: Path, start_s: float | None) -> VideoUpload:
    """Return a visitor's request for the depth of a video."""
    return VideoUpload(
        files=(file,),
        format="side_by_side",
        output="depth",
        start_s=start_s,
        backend=Backend(),
        name_of=label_of,
    )


def begin_endless(visit: Visit, video: Path, pid: int) -> set[int]:
    """Begin to convert a video without end; return the process that does it."""
    visit.open("Video")
    visit.give(video_left=video)
    before = workers_of(pid)
    visit.page.click("#video-whole")
    visit.page.locator("#video-status").get_by_text(AT_WORK).wait_for()
    return workers_of(pid) - before or workers_of(pid)


def test_two_visitors_work_at_once_and_cancelling_ends_one_job(server, browser, large_pair, pair):
    pid, address = server
    with visiting(browser, address) as patient, visiting(browser, address) as quick:
        patient.give(**large_pair)
        patient.page.get_by_label("finest").check()
        patient.page.click("#find")
        patient.page.locator("#status").get_by_text("matching 2560×1920 px").wait_for()
        worker = worker_at_work(pid)
        worker.suspend()  # so that it is still at work when it is cancelled
        quick.give(**pair)
        quick.page.get_by_label("fast").check()
        assert f"{WIDTH}×{HEIGHT} px, matched in" in quick.find()
        assert patient.page.locator("#status .notice").count() == 0  # still at work
        others = workers_of(pid) - {worker.pid}
        assert others
        patient.page.click("#cancel")
        patient.page.locator("#status").get_by_text("Cancelled").wait_for()
        wait_until(lambda: worker.pid not in workers_of(pid))
        assert others <= workers_of(pid)
        patient.take_back()
        patient.give(**pair)
        patient.page.get_by_label("fast").check()
        assert f"{WIDTH}×{HEIGHT} px, matched in" in patient.find()
        patient.page.locator("#cancel:disabled").wait_for()


def test_after_cancelling_the_result_before_stays(visit, pair, large_pair):
    visit.give(**pair)
    visit.page.get_by_label("fast").check()
    visit.find()
    visit.take_back()
    visit.give(**large_pair)
    visit.page.get_by_label("finest").check()
    visit.page.click("#find")
    visit.page.locator("#status").get_by_text("matching 2560×1920 px").wait_for()
    visit.page.click("#cancel")
    visit.page.locator("#status").get_by_text("Cancelled").wait_for()
    assert visit.move("0.25").shape == (HEIGHT, WIDTH, 3)
    visit.open("Files")
    assert visit.page.locator("#files a").count() > 5
    assert "Cancelled" in visit.page.locator("#status").inner_text()


def test_a_closed_tab_ends_its_video_and_the_next_visitor_s_begins(server, browser, endless_video, tmp_path):
    pid, address = server
    with visiting(browser, address) as leaving:
        begin_endless(leaving, endless_video, pid)
        busy = workers_of(pid)
    with visiting(browser, address) as next_one:
        wait_until(lambda: busy - workers_of(pid))
        begin_endless(next_one, endless_video, pid)
        next_one.page.click("#video-cancel")
        next_one.page.locator("#video-status").get_by_text("Cancelled").wait_for()


def test_a_waiting_job_can_be_cancelled(server, browser, endless_video):
    pid, address = server
    with visiting(browser, address) as first, visiting(browser, address) as second:
        begin_endless(first, endless_video, pid)
        second.open("Video")
        second.give(video_left=endless_video)
        second.page.click("#video-preview")
        second.page.locator("#video-status").get_by_text("queue").wait_for()
        second.page.click("#video-cancel")
        second.page.locator("#video-status").get_by_text("Cancelled").wait_for()
        first.page.locator("#video-status").get_by_text(AT_WORK).wait_for()


def test_the_newest_frame_is_shown_while_a_video_is_converted(server, browser, endless_video):
    with visiting(browser, server[1]) as visit:
        begin_endless(visit, endless_video, server[0])
        left, made = wait_for_frame(visit)
        assert (left[:12], made) == ("Left view at", "Depth in colour. Red is near, blue is far.")
        visit.page.wait_for_function(
            "before => document.querySelector('#video-frame figcaption').innerText !== before", arg=left
        )
        with visiting(browser, server[1]) as other:
            other.open("Video")
            assert other.page.locator("#video-frame img").count() == 0
        visit.choose("video-shown-as", "Side by side")
        visit.page.locator("#video-frame").get_by_text("For VR headsets").first.wait_for()
        sizes = (
            "[...document.querySelectorAll('#video-frame img')].map(i => i.naturalWidth / i.naturalHeight)"
        )
        assert visit.page.evaluate(sizes) == pytest.approx([160 / 96, 320 / 96])
        status = visit.page.locator("#video-status")
        assert re.search(
            r"frame \d+ of 2000, \d+\.\d frames/s, about \d+ (s|min|h) left", status.inner_text()
        )
        visit.page.click("#video-cancel")
        status.get_by_text("Cancelled").wait_for()
        visit.page.locator("#video-frame").wait_for(state="hidden")
        assert visit.refused == []


def wait_for_frame(visit: Visit) -> list[str]:
    """Wait for the pictures of a frame; return the lines below them."""
    visit.page.locator("#video-frame img").nth(1).wait_for()
    return visit.page.locator("#video-frame figcaption").all_inner_texts()


def test_one_frame_is_shown_at_each_time_and_as_each_output(visit, tmp_path):
    video = write_video(tmp_path / "video.mp4", [packed(*pair) for pair in example_pairs(50)])  # 2 s
    visit.open("Video")
    visit.give(video_left=video)
    visit.page.click("#video-look")
    assert wait_for_frame(visit) == ["Left view at 0:00.0", "Depth in colour. Red is near, blue is far."]
    slider = visit.page.locator("#video-time input[type=range]")
    assert slider.get_attribute("max") == "1.9"
    slider.fill("1.5")
    slider.dispatch_event("pointerup")
    frame = visit.page.locator("#video-frame")
    frame.get_by_text("Left view at 0:01.5").wait_for()
    assert visit.page.locator("#video-start input").input_value() == "1.5"
    visit.choose("video-output", "Anaglyph")
    frame.get_by_text("Look through red-cyan glasses").wait_for()
    frame.get_by_text("Left view at 0:01.5").wait_for()
    visit.page.locator("#video-start input").fill("9")
    visit.page.click("#video-look")
    visit.page.locator("#video-status").get_by_text("found 9 s; choose an earlier one").wait_for()
    frame.wait_for(state="hidden")
    assert visit.refused == []


def test_a_job_cancelled_at_once_shows_no_error(visit, endless_video):
    visit.open("Video")
    visit.give(video_left=endless_video)
    for _ in range(3):
        visit.page.click("#video-whole")
        visit.page.click("#video-cancel")
        visit.page.locator("#video-status").get_by_text("Cancelled").wait_for()
        visit.page.wait_for_timeout(1000)
        assert not visit.page.locator("#video-status .error").is_visible()


def test_a_job_that_reaches_the_server_after_cancel_does_no_work(visit, endless_video):
    late = []

    def delay(route) -> None:
        if not late and endless_video.name in (route.request.post_data or ""):
            late.append(route)
        else:
            route.continue_()

    visit.open("Video")
    visit.give(video_left=endless_video)
    visit.page.route("**/queue/join*", delay)
    visit.page.click("#video-whole")
    status = visit.page.locator("#video-status")
    visit.page.click("#video-cancel")
    status.get_by_text("Cancelled").wait_for()
    deadline_s = time.monotonic() + WAIT_S
    while not late and time.monotonic() < deadline_s:
        visit.page.wait_for_timeout(50)
    late[0].continue_()
    visit.page.wait_for_timeout(1000)
    assert status.get_by_text("Cancelled").is_visible()
    visit.page.click("#video-preview")  # one video at a time
    status.get_by_text(AT_WORK).wait_for()


# By kind: the picture's format, and its width and height.
STILLS = {
    "side_by_side": ("JPEG", (2 * WIDTH, HEIGHT)),
    "side_by_side_half": ("JPEG", (WIDTH, HEIGHT)),
    "crossed": ("JPEG", (2 * WIDTH, HEIGHT)),
    "top_bottom": ("JPEG", (WIDTH, 2 * HEIGHT)),
    "top_bottom_half": ("JPEG", (WIDTH, HEIGHT)),
    "anaglyph_dubois": ("JPEG", (WIDTH, HEIGHT)),
    "anaglyph_half_colour": ("JPEG", (WIDTH, HEIGHT)),
    "anaglyph_colour": ("JPEG", (WIDTH, HEIGHT)),
    "anaglyph_grey": ("JPEG", (WIDTH, HEIGHT)),
    "wiggle": ("GIF", (WIDTH, HEIGHT)),
    "sweep": ("WEBP", (WIDTH, HEIGHT)),
    "mpo": ("MPO", (WIDTH, HEIGHT)),
    "jps": ("JPEG", (2 * WIDTH, HEIGHT)),
    "quilt": ("JPEG", (8 * WIDTH, 6 * HEIGHT)),
    "contact_sheet": ("JPEG", (WIDTH // 3 * 3, HEIGHT // 3 * 3)),
    "rgbd": ("JPEG", (2 * WIDTH, HEIGHT)),
    "depth_map": ("PNG", (WIDTH, HEIGHT)),
    "view": ("JPEG", (WIDTH, HEIGHT)),
}
FRAMES = {"wiggle": 12, "sweep": 80, "mpo": 2}


@pytest.fixture(scope="module")
def answered(browser, server, pair) -> Iterator[Visit]:
    """Yield a visitor who has the small pair's result and looks at its 3-D pictures."""
    with visiting(browser, server[1]) as visit:
        visit.give(**pair)
        visit.page.get_by_label("fast").check()
        visit.find()
        visit.open("3-D picture")
        visit.page.locator("#picture").get_by_text("left_anaglyph_dubois").wait_for()
        yield visit


def make_picture(visit: Visit, kind: str, folder: Path) -> Path:
    """Choose a kind of 3-D picture and download it."""
    visit.choose("kind", KINDS[kind].label)
    visit.page.locator("#viewing").get_by_text(KINDS[kind].viewing).wait_for()
    visit.page.locator("#picture").get_by_text(f" left_{kind}").wait_for()
    return visit.download("picture", folder)


@pytest.mark.parametrize("kind", STILLS)
def test_each_3_d_picture_opens_with_its_format_and_size(answered, kind, tmp_path):
    with Image.open(make_picture(answered, kind, tmp_path)) as picture:
        assert (picture.format, picture.size) == STILLS[kind]
        assert getattr(picture, "n_frames", 1) == FRAMES.get(kind, 1)
    assert answered.picture("preview").std() > 10


def test_a_window_that_reads_the_end_of_a_stream_late_loses_no_results(browser, server, pair, tmp_path):
    with visiting(browser, server[1], LATE_ENDS) as visit:
        visit.give(**pair)
        visit.page.get_by_label("fast").check()
        visit.find()
        visit.open("3-D picture")
        for kind in ("depth_map", "rgbd", "side_by_side"):
            make_picture(visit, kind, tmp_path)


def test_a_3_d_picture_that_is_asked_for_twice_at_once_takes_one_process(browser, pair, tmp_path):
    server, address = start(tmp_path)
    with visiting(browser, address) as visit:
        visit.give(**pair)
        visit.page.get_by_label("fast").check()
        visit.find()
        workers = workers_of(server.pid)
        visit.open("3-D picture")
        visit.choose("kind", KINDS["sweep"].label)
        visit.open("View")
        visit.open("3-D picture")
        visit.page.locator("#picture").get_by_text(" left_sweep").wait_for()
        assert workers_of(server.pid) == workers  # none was started for the second
    assert stop(server) == ""


def test_all_kinds_of_3_d_pictures_are_tested():
    assert {*STILLS, "viewer"} == set(KINDS)


def test_a_3_d_photo_moves_in_the_page_and_is_one_file(answered, tmp_path):
    photo = make_picture(answered, "viewer", tmp_path)
    (frame,) = answered.page.frames[1:]
    frame.wait_for_function("Boolean(window.stereoweaveViewer)")
    assert frame.evaluate("stereoweaveViewer.view.scene.size_px") == [WIDTH, HEIGHT]
    answered.page.locator("#preview").wait_for(state="hidden")
    assert photo.name == "left_viewer.html"
    shown = answered.page.locator("#photo iframe").get_attribute("srcdoc")
    assert shown == photo.read_text(encoding="utf-8")


@pytest.mark.parametrize("kind", ["wiggle", "sweep"])
def test_an_animation_moves_in_its_preview(answered, kind, tmp_path):
    make_picture(answered, kind, tmp_path)
    with Image.open(io.BytesIO(answered.fetch("preview"))) as preview:
        assert getattr(preview, "n_frames", 1) == FRAMES[kind]


def test_the_halves_of_a_crossed_picture_are_the_right_and_the_left_view(answered, pair, tmp_path):
    crossed = read_image(make_picture(answered, "crossed", tmp_path)).astype(float)
    for side, half in zip(("right", "left"), np.split(crossed, 2, axis=1), strict=True):
        assert np.abs(half - read_image(pair[side])).mean() < 5


def test_a_view_is_that_of_the_slider(answered, pair, tmp_path):
    answered.move("1")
    answered.open("3-D picture")
    view = read_image(make_picture(answered, "view", tmp_path)).astype(float)
    assert np.abs(view - read_image(pair["right"])).mean() < 5


@pytest.fixture(scope="module")
def result(pair) -> Result:
    prepared = prepare(list(pair.values()), Request())
    return run(prepared, Backend().matcher(), MatchOptions())


@pytest.mark.parametrize(
    ("kind", "size_px"),
    [
        ("anaglyph_grey", (160, 120)),
        ("side_by_side", (320, 120)),
        ("wiggle", (160, 120)),
        ("view", (160, 120)),
    ],
)
def test_a_3_d_picture_of_a_smaller_size_has_smaller_views(result, kind, size_px, tmp_path):
    made = write_stereo_picture(Wish(kind=kind, longer_side_px=160), result, tmp_path / "a", lambda *_: None)
    with Image.open(made.file) as picture:
        assert picture.size == size_px


def test_a_3_d_photo_of_a_smaller_size_is_smaller(result, tmp_path):
    small, whole = (
        write_stereo_picture(
            Wish(kind="viewer", longer_side_px=side), result, tmp_path / f"{side}", lambda *_: None
        ).file.stat()
        for side in (160, AUTOMATIC_PX)
    )
    assert small.st_size < 0.7 * whole.st_size


def test_borders_are_cut_off_only_on_request_and_where_views_lie_upon_each_other(result, tmp_path):
    def width_of(kind: str, crops: bool) -> int:
        wish = Wish(kind=kind, crops=crops, position=1.5).plain()
        made = write_stereo_picture(wish, result, tmp_path / f"{kind}{crops}", lambda *_: None)
        with Image.open(made.file) as picture:
            return picture.width

    assert width_of("view", False) == WIDTH > width_of("view", True) > WIDTH - 20
    assert width_of("depth_map", True) == width_of("side_by_side", True) / 2 == WIDTH


def test_animations_are_small_enough_to_send_unless_the_full_size_is_asked_for():
    assert Wish(kind="wiggle").size_px == (800, 800)
    assert Wish(kind="wiggle", longer_side_px=FULL_PX).size_px == (FULL_PX, FULL_PX)
    assert Wish(kind="crossed").size_px == (FULL_PX, FULL_PX)


def test_a_size_and_a_crop_are_chosen_in_the_page(answered, tmp_path):
    answered.move("1.5")
    answered.open("3-D picture")
    make_picture(answered, "view", tmp_path)
    answered.page.get_by_label("Cut off borders").check()
    answered.page.wait_for_function(
        "width => document.querySelector('#preview img')?.naturalWidth < width", arg=WIDTH
    )
    answered.page.get_by_label("Cut off borders").uncheck()
    make_picture(answered, "side_by_side", tmp_path)
    answered.page.locator("#crop").wait_for(state="hidden")


def test_five_seconds_of_a_video_are_shown_as_a_preview(visit, tmp_path):
    video = write_video(tmp_path / "video.mp4", [packed(*pair) for pair in example_pairs(50)] * 4)  # 8 s
    visit.open("Video")
    visit.give(video_left=video)
    visit.choose("video-output", "Anaglyph")
    visit.page.locator("#video-start input").fill("2")
    visit.page.click("#video-preview")
    visit.page.locator("#video-status").get_by_text("125 frames of 160×96 px, 5.0 s").wait_for()
    visit.page.wait_for_function("document.querySelector('#video video')?.videoWidth === 160")
    assert visit.page.evaluate("document.querySelector('#video video').duration") == pytest.approx(
        5, abs=0.05
    )
    with av.open(str(visit.download("video-file", tmp_path))) as shown:
        frames = [frame.to_ndarray(format="rgb24") for frame in shown.decode(video=0)]
    assert len(frames) == 125
    assert visit.refused == []


def test_a_heic_file_with_both_views_is_a_pair(visit, pair, tmp_path):
    views = (read_image(pair[side]) for side in ("left", "right"))
    visit.give(left=write_heic(tmp_path / "photo.heic", *views))
    assert "a HEIC file with a left and a right view" in visit.find()


def test_a_file_that_is_no_video_is_one_line(visit, tmp_path):
    (tmp_path / "notes.mp4").write_text("no video")
    visit.open("Video")
    visit.page.click("#video-preview")
    said = visit.page.locator("#video-status .notice.problem")
    said.get_by_text("expected a video with both views, or a left and a right video, found none").wait_for()
    visit.give(video_left=tmp_path / "notes.mp4")
    visit.page.click("#video-preview")
    said.get_by_text("notes.mp4: expected ").wait_for()
    assert "/" not in said.inner_text()


def test_a_video_s_frames_and_the_time_left_are_reported(tmp_path):
    video = write_video(tmp_path / "video.mp4", [packed(*pair) for pair in example_pairs(6)])
    said: list[tuple[float, str]] = []
    made = convert_upload(ask(video, start_s=0.08), tmp_path, lambda share, what: said.append((share, what)))
    shares, texts = zip(*said, strict=True)
    assert list(shares) == sorted(shares)
    assert texts[-4] == "frame 1 of 4"
    assert re.fullmatch(r"frame 4 of 4, \d+\.\d frames/s, about \d+ (s|min|h) left", texts[-1])
    assert re.search(
        r"4 frames of 160×96 px, 0.2 s.*The whole video takes about \d+ (s|min|h)\.", made.summary
    )
    assert made.warnings == []


def test_uploads_in_use_do_not_age(tmp_path):
    upload = tmp_path / "in.mp4"
    upload.touch()
    before_ns = upload.stat().st_ctime_ns  # Gradio looks at this time
    time.sleep(0.02)
    keep_uploads([upload, tmp_path / "gone.mp4"])
    assert upload.stat().st_ctime_ns > before_ns
    assert not (tmp_path / "gone.mp4").exists()


def test_a_spatial_video_is_converted_with_a_note(tmp_path):
    wish = replace(ask(SPATIAL, start_s=0.5), format=None)
    made = convert_upload(wish, tmp_path, lambda share, what: None)
    assert "320×192 px" in made.summary
    assert [line[:38] for line in made.facts] == ["spatial video (MV-HEVC), left view fir"]
    assert made.warnings == []
    with pytest.raises(StereoweaveError, match="found side_by_side; leave it out"):
        convert_upload(ask(SPATIAL, start_s=None), tmp_path, lambda share, what: None)


@pytest.mark.parametrize("ending", ["m3u8", "mp4", "ffconcat"])
def test_a_playlist_does_not_read_another_video(tmp_path, ending):
    secret = write_video(tmp_path / "secret.mp4", [packed(*pair) for pair in example_pairs(5)])
    playlist = tmp_path / f"playlist.{ending}"
    if ending == "ffconcat":
        playlist.write_text("ffconcat version 1.0\nfile secret.mp4\n")
    else:
        playlist.write_text(f"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\n{secret}\n#EXT-X-ENDLIST\n")
    with pytest.raises(
        FormatError, match=rf"^playlist\.{ending}: expected a video \(MP4.*found another kind"
    ):
        convert_upload(ask(playlist, start_s=None), tmp_path, lambda share, what: None)


def test_pictures_that_do_not_fit_get_a_banner(visit, tmp_path):
    left, right = (read_image(TEXTURED / f"{side}.png") for side in ("left", "right"))
    write_image(tmp_path / "left.png", left)
    write_image(tmp_path / "right.png", np.roll(right, 12, axis=0))
    visit.give(left=tmp_path / "left.png", right=tmp_path / "right.png")
    visit.page.locator("#rectify input").uncheck()
    visit.find()
    banner = visit.page.locator("#status .warning")
    assert "“Align the pictures”" in banner.inner_text()
    assert banner.get_attribute("role") == "alert"
