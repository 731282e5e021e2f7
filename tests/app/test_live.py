import http.client
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest
import video_examples
from browsers import chromium
from spatial_examples import SPATIAL, psnr_db, spatial_pairs
from video_examples import example_pairs, write_streams

from stereoweave.app.capture import Capture
from stereoweave.app.live import LiveTally, compose, describe_middle, follow_range, label_values, show
from stereoweave.app.screen import Screen
from stereoweave.cameras.calibration_files import read_rig
from stereoweave.cli.live import live
from stereoweave.errors import FormatError, StereoweaveError
from stereoweave.io.colormap import colour_disparity
from stereoweave.matching.matcher import Matcher
from stereoweave.stereo import StereoCamera, StereoPair

TEXTURED = Path(__file__).resolve().parents[1] / "textured_pair"
COMMAND = [sys.executable, "-c", "import typer; from stereoweave.cli.live import live; typer.run(live)"]
_STEP = 20
# A screenshot would wait for a frame of the page, which a busy machine may not draw in time.
_COLOUR_IN_THE_MIDDLE = """() => {
    const image = document.images[0], canvas = document.createElement("canvas");
    if (!image?.naturalWidth) return null;
    [canvas.width, canvas.height] = [image.naturalWidth, image.naturalHeight];
    const pen = canvas.getContext("2d");
    pen.drawImage(image, 0, 0);
    return [...pen.getImageData(canvas.width / 2, canvas.height / 2, 1, 1).data];
}"""


def write_video(path: Path, frames: Sequence[np.ndarray], rate: float = 25) -> str:
    """Write a motion JPEG video of these RGB images, in which every frame is a key frame."""
    size_px = frames[0].shape[1], frames[0].shape[0]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), rate, size_px)
    assert writer.isOpened()
    for frame in frames:
        writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
    writer.release()
    return str(path)


def greys(count: int) -> list[np.ndarray]:
    """Return images that encode their number: each is 20 levels brighter than the previous one."""
    return [np.full((64, 96, 3), _STEP * number, np.uint8) for number in range(count)]


def number_of(picture: np.ndarray) -> int:
    return round(float(picture.mean()) / _STEP)


def example_frame() -> np.ndarray:
    """Return the example pair side by side in one frame, at a quarter of its size."""
    left, right = (cv2.imread(str(TEXTURED / name)) for name in ("left.png", "right.png"))
    both = cv2.resize(np.hstack([left, right]), (320, 120), interpolation=cv2.INTER_AREA)
    return cv2.cvtColor(both, cv2.COLOR_BGR2RGB)


def read_pictures(response: http.client.HTTPResponse) -> Iterator[np.ndarray]:
    """Yield the RGB images of a stream: each has a boundary, a header, and as many bytes as it announces."""
    boundary = response.headers.get_boundary()
    assert response.headers.get_content_type() == "multipart/x-mixed-replace"
    while line := response.readline():
        if line.strip() != f"--{boundary}".encode():
            continue
        header = http.client.parse_headers(response)
        if header["Content-Type"] is None:
            return
        assert header["Content-Type"] == "image/jpeg"
        jpeg = np.frombuffer(response.read(int(header["Content-Length"])), np.uint8)
        picture = cv2.imdecode(jpeg, cv2.IMREAD_COLOR)
        assert picture is not None
        yield cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)


def request(url: str, path: str = "/", **headers: str) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection(urlsplit(url).netloc, timeout=20)
    connection.request("GET", path, headers=headers)
    return connection.getresponse()


def read_page_url(process: subprocess.Popen[str]) -> str:
    """Return the address of the page, which the command prints first."""
    assert process.stdout is not None
    found = re.search(r"http://127\.0\.0\.1:\d+/", process.stdout.readline())
    assert found is not None
    return found[0]


def test_a_video_yields_its_frames_in_order_and_ends_after_the_last_one(tmp_path):
    last = -1
    with Capture([write_video(tmp_path / "video.avi", greys(8))]) as capture:
        while moment := capture.newest(last):
            assert moment.number > last
            assert number_of(moment.pictures[0]) == moment.number
            last = moment.number
    assert last == 7


def test_a_late_caller_gets_only_the_newest_frame(tmp_path):
    with Capture([write_video(tmp_path / "video.avi", greys(8), rate=50)]) as capture:
        assert capture.newest(6) is not None  # waits for the last one
        late = capture.newest(-1)
        assert late is not None
        assert (late.number, number_of(late.pictures[0])) == (7, 7)


def test_two_videos_are_read_in_step_until_the_shorter_one_ends(tmp_path):
    sources = [
        write_video(tmp_path / "left.avi", greys(5)),
        write_video(tmp_path / "right.avi", [255 - grey for grey in greys(9)]),
    ]
    last = -1
    with Capture(sources) as capture:
        while moment := capture.newest(last):
            left, right = moment.pictures
            assert number_of(left) == number_of(255 - right) == moment.number
            last = moment.number
    assert last == 4


def test_a_series_of_pictures_is_a_video(tmp_path):
    for number, picture in enumerate(greys(3)):
        cv2.imwrite(str(tmp_path / f"frame{number:03}.png"), picture)
    with Capture([str(tmp_path / "frame%03d.png")]) as capture:
        moment = capture.newest(1)
        assert moment is not None
        assert number_of(moment.pictures[0]) == 2
        assert capture.newest(2) is None


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("nowhere.mp4", "no such file"),
        (str(TEXTURED / "calib.txt"), "a file that OpenCV cannot open"),
        (str(TEXTURED), "a folder"),
        ("999", "no free camera with that number"),
        ("http://127.0.0.1:1/stream", "no stream at that address"),
    ],
)
def test_an_invalid_source_is_named_with_what_was_expected(source, found):
    with pytest.raises(FormatError, match=rf"^{re.escape(source)}: expected a camera number.*{found}"):
        Capture([source])


def test_a_playlist_does_not_read_the_files_that_it_names(tmp_path):
    playlist = tmp_path / "a.m3u8"
    playlist.write_text("#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\n/other/secret.ts\n")
    with pytest.raises(FormatError, match=r"a\.m3u8: expected a video, found a playlist, which names"):
        Capture([str(playlist)])


def test_more_than_two_sources_are_refused():
    with pytest.raises(StereoweaveError, match="found 3: 0 1 2"):
        Capture(["0", "1", "2"])


def test_a_picture_and_a_stream_in_a_file_are_videos_that_end(tmp_path):
    cv2.imwrite(str(tmp_path / "one.png"), greys(3)[2])
    jpegs = [cv2.imencode(".jpg", grey)[1].tobytes() for grey in greys(3)]
    (tmp_path / "camera.mjpeg").write_bytes(b"".join(jpegs))
    for name, last in (("one.png", 0), ("camera.mjpeg", 2)):
        with Capture([str(tmp_path / name)]) as capture:
            assert capture.newest(last - 1) is not None
            assert capture.newest(last) is None


def test_a_stream_that_stops_is_an_error_and_not_the_end_of_a_video():
    grey = greys(6)[5]
    with Screen(0) as screen:
        screen.show(grey)
        # OpenCV reads several images before it recognises the format of the stream.
        ended = threading.Event()
        shown = threading.Thread(target=keep_showing, args=(screen, grey, ended))
        shown.start()
        with Capture([f"{screen.url}stream"]) as capture:
            moment = capture.newest(-1)
            assert moment is not None
            assert number_of(moment.pictures[0]) == 5
            ended.set()
            shown.join()
            screen.close()
            with pytest.raises(StereoweaveError, match=r"/stream: expected frames, found the end.*check"):
                capture.newest(10**6)


def keep_showing(screen: Screen, picture: np.ndarray, ended: threading.Event) -> None:
    while not ended.wait(0.01):
        screen.show(picture)


def test_the_page_shows_a_stream_of_the_newest_images():
    first, second = greys(8)[3], greys(8)[7]
    with Screen(0) as screen:
        page = request(screen.url)
        assert page.status == 200
        assert b'<img src="/stream"' in page.read()
        screen.show(first)
        screen.show(second)
        stream = read_pictures(request(screen.url, "/stream"))
        assert number_of(next(stream)) == 7
        screen.show(first)
        # An image is sent again if no other one follows.
        assert next(number for picture in stream if (number := number_of(picture)) != 7) == 3
        screen.close()
        assert {number_of(picture) for picture in stream} <= {3}


@pytest.mark.system
@pytest.mark.needs_chromium
def test_a_browser_shows_a_single_image():
    with Screen(0) as screen, chromium() as browser:
        screen.show(np.full((64, 96, 3), 200, np.uint8))
        page = browser.new_page()
        page.goto(screen.url, wait_until="commit")  # the stream, and thus the page, is never complete
        shown = page.wait_for_function(_COLOUR_IN_THE_MIDDLE).json_value()
        assert shown == pytest.approx([200, 200, 200, 255], abs=4)
        screen.close()


def test_the_page_is_available_on_this_machine_only():
    with Screen(0) as screen:
        assert request(screen.url, Host="somewhere.example:80").status == 403
        assert request(screen.url, Host=f"localhost:{screen.server_port}").status == 200
        assert request(screen.url, Host="localhost").status == 200  # as browsers write port 80
        assert request(screen.url, "/other").status == 404
        assert request(screen.url).headers["Cross-Origin-Resource-Policy"] == "same-origin"


def test_a_port_in_use_is_named():
    with (
        Screen(0) as screen,
        pytest.raises(StereoweaveError, match=f"^port: .* found {screen.server_port}"),
    ):
        Screen(screen.server_port)


def test_the_colour_range_moves_a_tenth_of_the_way_to_a_new_one():
    near_px = np.full((40, 40), 50, np.float32)
    assert follow_range(None, near_px) == (50, 51)  # at least one pixel wide
    assert follow_range((0.0, 20.0), near_px) == pytest.approx((5, 23.1))


def test_the_disparity_is_beside_the_left_image_and_black_where_nothing_is_seen(rng):
    left = rng.integers(0, 256, (40, 60, 3), dtype=np.uint8)
    seen = np.ones((40, 60), bool)
    seen[:, :7] = False
    disparity_px = rng.uniform(0, 9, (40, 60)).astype(np.float32)
    pair = StereoPair(left=left, right=left, left_seen=seen)
    picture = compose(pair, disparity_px, (0, 9), "12.0 frames/s")
    strip, both, legend = np.split(picture, [32, 72])
    assert strip.max() > 0
    assert legend.shape == (40, 120, 3)
    rows = np.r_[0:10, 30:40]  # without the cross in the middle
    np.testing.assert_array_equal(both[rows, :60], left[rows])
    np.testing.assert_array_equal(both[rows, 67:], colour_disparity(disparity_px, (0, 9))[rows, 7:])
    assert (both[rows, 60:67] == 0).all()


def test_a_cross_marks_the_middle_of_both_pictures():
    grey = np.full((40, 60, 3), 90, np.uint8)
    disparity_px = np.linspace(0, 9, 2400, dtype=np.float32).reshape(40, 60)
    both = compose(StereoPair(left=grey, right=grey), disparity_px, (0, 9), "")[32:72]
    for column in (30, 90):
        assert (both[20, column - 3 : column + 4] == 255).all()
        assert (both[17:24, column] == 255).all()


def test_the_legend_goes_from_the_far_colour_to_the_near_one():
    grey = np.full((40, 300, 3), 90, np.uint8)
    disparity_px = np.zeros((40, 300), np.float32)
    legend = compose(StereoPair(left=grey, right=grey), disparity_px, (0, 9), "")[72:]
    ends = colour_disparity(np.array([[0, 9]], np.float32), (0, 9))[0]
    np.testing.assert_array_equal(legend[10, [0, -1]], ends)
    assert legend[20:].max() == 255  # the labels


def test_with_a_known_camera_values_are_in_metres():
    camera = StereoCamera(focal_px=600, baseline_m=0.1, cx_px=320, cy_px=240)
    assert label_values(camera, (6.0, 40.0, 0.0)) == ["10.0 m", "1.50 m", "infinity"]
    assert label_values(None, (6.0, 40.0)) == ["6.0 px", "40.0 px"]


def test_the_middle_s_depth_is_the_median_around_it():
    grey = np.full((40, 60, 3), 90, np.uint8)
    camera = StereoCamera(focal_px=600, baseline_m=0.1, cx_px=30, cy_px=20)
    disparity_px = np.full((40, 60), 6, np.float32)
    disparity_px[16:25, 26:35] = 30  # 600 * 0.1 / 30 = 2 m
    disparity_px[20, 30] = 6  # a pixel alone does not count
    pair = StereoPair(left=grey, right=grey, camera=camera)
    assert describe_middle(pair, disparity_px) == "depth at the cross: 2.00 m"


def test_a_looped_video_begins_again_at_its_end(tmp_path):
    last, seen = -1, []
    with Capture([write_video(tmp_path / "video.avi", greys(3))], loop=True) as capture:
        while last < 8:
            moment = capture.newest(last)
            assert moment is not None
            seen.append((moment.number, number_of(moment.pictures[0])))
            last = moment.number
    assert all(grey == number % 3 for number, grey in seen)


def test_a_looped_series_of_pictures_begins_again_at_its_end(tmp_path):
    for number, picture in enumerate(greys(3)):
        cv2.imwrite(str(tmp_path / f"frame{number:03}.png"), picture)
    with Capture([str(tmp_path / "frame%03d.png")], loop=True) as capture:
        moment = capture.newest(3)
        assert moment is not None
        assert number_of(moment.pictures[0]) == moment.number % 3


def test_a_tally_reports_frames_their_rate_and_their_delay(tmp_path):
    with Capture([write_video(tmp_path / "video.avi", greys(1))]) as capture:
        moment = capture.newest(-1)
    assert moment is not None
    tally = LiveTally()
    assert tally.describe() == "no frame was shown"
    for number, (taken_s, now_s) in enumerate([(0.0, 0.5), (0.75, 1.0), (2.25, 2.5)]):
        tally.add(moment._replace(number=2 * number, taken_s=taken_s), now_s)
    assert tally.rate == 1.0
    assert tally.describe() == "3 of 5 frames shown, 1.0 per second, 333 ms after capture"


def test_of_an_odd_width_the_last_column_is_dropped_and_told_once(tmp_path):
    both = example_frame()
    odd = np.hstack([both, both[:, -1:]])
    told, tally = [], LiveTally()
    cv2.imwrite(str(tmp_path / "0.png"), odd[..., ::-1])
    cv2.imwrite(str(tmp_path / "1.png"), odd[..., ::-1])
    with Screen(0) as screen, Capture([str(tmp_path / "%d.png")]) as capture:
        show(capture, screen, Matcher(), tally, format="side_by_side", tell=told.append)
    assert tally.shown > 0
    assert list(map(str, told)) == ["the last column is dropped, because the width, 321 px, is odd"]


def test_a_baseline_in_a_wrong_unit_is_told_once(tmp_path):
    calibration = "cam0=[300 0 79.5; 0 300 59.5; 0 0 1]\ncam1=[300 0 79.5; 0 300 59.5; 0 0 1]\n"
    # 0.1 m in a file that counts in millimetres.
    (tmp_path / "calib.txt").write_text(f"{calibration}doffs=0\nbaseline=0.1\nwidth=160\nheight=120\n")
    for number in range(2):
        cv2.imwrite(str(tmp_path / f"{number}.png"), example_frame()[..., ::-1])
    told, rig = [], read_rig(tmp_path / "calib.txt")
    with Screen(0) as screen, Capture([str(tmp_path / "%d.png")]) as capture:
        show(capture, screen, Matcher(), LiveTally(), format="side_by_side", rig=rig, tell=told.append)
    (note,) = [str(note) for note in told if "unlikely" in str(note)]
    assert note.startswith("unlikely depths in metres: the cameras are 0.10 mm apart")


def test_after_the_last_frame_the_picture_says_so(tmp_path, monkeypatch):
    said = []
    monkeypatch.setattr(
        "stereoweave.app.live.compose", lambda *shown: said.append(shown[3]) or compose(*shown)
    )
    cv2.imwrite(str(tmp_path / "0.png"), example_frame()[..., ::-1])
    with Screen(0) as screen, Capture([str(tmp_path / "%d.png")]) as capture:
        show(capture, screen, Matcher(), LiveTally(), format="side_by_side")
    assert [line.split(",")[0] for line in said] == ["0.0 frames/s", "the end"]


def test_two_videos_are_shown_as_the_left_image_and_its_disparity(tmp_path):
    left, right = np.split(cv2.resize(example_frame(), (640, 240)), 2, axis=1)
    sources = [write_video(tmp_path / "left.avi", [left]), write_video(tmp_path / "right.avi", [right])]
    # The calibration of the examples, scaled to half size.
    calibration = "cam0=[300 0 159.5; 0 300 119.5; 0 0 1]\ncam1=[300 0 159.5; 0 300 119.5; 0 0 1]\n"
    (tmp_path / "calib.txt").write_text(f"{calibration}doffs=0\nbaseline=100\nwidth=320\nheight=240\n")
    tally, told = LiveTally(), []
    with Screen(0) as screen, Capture(sources) as capture:
        show(capture, screen, Matcher(), tally, rig=read_rig(tmp_path / "calib.txt"), tell=told.append)
        picture = next(read_pictures(request(screen.url, "/stream")))
    assert (tally.shown, tally.last) == (1, 0)
    (note,) = told
    assert str(note).endswith("is a calibration of rectified pictures, so they are left unchanged")
    assert picture.shape == (240 + 32 + 40, 640, 3)
    assert np.abs(picture[32:272, :320].astype(int) - left).mean() < 8
    # The top of the example is far and therefore blue; its bottom is near and therefore red.
    top, bottom = picture[42:72, 340:620].mean((0, 1)), picture[242:272, 340:620].mean((0, 1))
    assert top[2] > top[0]
    assert bottom[0] > bottom[2]


def test_a_spatial_video_is_shown_with_metres_and_a_note(monkeypatch):
    told, tally, pictures = [], LiveTally(), []
    with Screen(0) as screen, Capture([str(SPATIAL)]) as capture:
        monkeypatch.setattr(screen, "show", pictures.append)
        composed = []
        monkeypatch.setattr(
            "stereoweave.app.live.compose", lambda pair, *more: composed.append(pair) or compose(pair, *more)
        )
        show(capture, screen, Matcher(), tally, tell=told.append)
    assert tally.shown + 1 == len(pictures) == len(composed) > 1  # the last one is shown twice
    assert tally.last == 49
    assert [str(note)[:43] for note in told] == ["spatial video (MV-HEVC), left view first: f"]
    left, right = spatial_pairs()[-1]
    assert psnr_db(composed[-1].left, left) > 35
    assert psnr_db(composed[-1].right, right) > 35
    # 160 * sqrt(3) px * 0.0635 m is 17.6 px m: 10 px are 1.76 m.
    assert label_values(composed[-1].camera, [10.0]) == ["1.76 m"]


def test_a_spatial_video_begins_again_with_loop():
    with Capture([str(SPATIAL)], loop=True) as capture:
        first = capture.newest(49)
    assert first.number > 49
    assert [picture.shape for picture in first.pictures] == 2 * [(192, 320, 3)]


def test_a_spatial_video_with_another_one_or_a_frame_packing_is_refused(tmp_path):
    plain = write_video(tmp_path / "video.avi", greys(3))
    for sources in ([plain, str(SPATIAL)], [str(SPATIAL), plain]):
        with pytest.raises(FormatError, match="with both views; give it alone"):
            Capture(sources)
    with (
        Screen(0) as screen,
        Capture([str(SPATIAL)]) as capture,
        pytest.raises(StereoweaveError, match="found crossed; leave it out"),
    ):
        show(capture, screen, Matcher(), LiveTally(), format="crossed")


def last_pair(monkeypatch, source, format=None):
    """Show a video, and return the last pair, the number of frames, and what was told."""
    told, tally, composed = [], LiveTally(), []
    with Screen(0) as screen, Capture([str(source)], format=format) as capture:
        monkeypatch.setattr(
            "stereoweave.app.live.compose", lambda pair, *more: composed.append(pair) or compose(pair, *more)
        )
        show(capture, screen, Matcher(), tally, format=format, tell=told.append)
    return composed[-1], tally.last + 1, " ".join(map(str, told))


def assert_views(pair, left, right):
    for eye, expected in ((pair.left, left), (pair.right, right)):
        assert np.abs(eye.astype(int) - expected).mean() < 7


@pytest.mark.parametrize("format", [None, "two_streams"])
def test_two_streams_of_a_file_are_shown_as_a_pair(tmp_path, monkeypatch, format):
    pairs = example_pairs(3)
    path = write_streams(tmp_path / "a.avi", *zip(*pairs, strict=True))
    pair, count, told = last_pair(monkeypatch, path, format)
    assert_views(pair, *pairs[-1])
    assert count == 3
    assert "two video streams of the same size and rate" in told


def test_frames_in_turn_are_shown_as_pairs(tmp_path, monkeypatch):
    pairs = example_pairs(3)
    in_turn = [eye for pair in pairs for eye in pair]
    plain = video_examples.write_video(tmp_path / "plain.mp4", in_turn, codec="libx264")
    pair, count, _ = last_pair(monkeypatch, plain, "frame_sequential")
    assert_views(pair, *pairs[-1])
    assert count == 3
    options = {"x264-params": "frame-packing=5", "g": "1"}
    declared = video_examples.write_video(tmp_path / "b.mp4", in_turn, codec="libx264", options=options)
    pair, count, told = last_pair(monkeypatch, declared)
    assert_views(pair, *pairs[-1])
    assert count == 3
    assert "frame_sequential, as the file declares" in told


def test_the_frame_packing_that_a_file_declares_is_taken(tmp_path, monkeypatch):
    pairs = example_pairs(2)
    crossed = video_examples.write_side_by_side(
        tmp_path / "a.mkv", pairs, layout="crossed", codec="libx264", stereo_mode="right_left"
    )
    pair, _, _ = last_pair(monkeypatch, crossed)
    assert_views(pair, *pairs[-1])


def test_views_apart_are_read_from_a_single_file_only(tmp_path):
    with pytest.raises(
        FormatError, match="^0: expected a video file .* two_streams, found another"
    ) as caught:
        Capture(["0"], format="two_streams")
    assert str(caught.value).endswith("; convert it to side_by_side first (video)")
    pairs = example_pairs(2)
    twins = str(write_streams(tmp_path / "a.avi", *zip(*pairs, strict=True)))
    with pytest.raises(FormatError, match=r"found a video \(two_streams\) with both views; give it alone"):
        Capture([twins, write_video(tmp_path / "b.avi", greys(2))])
    with pytest.raises(FormatError, match="expected two video streams of the same size and rate, found 1"):
        Capture([write_video(tmp_path / "c.avi", greys(2))], format="two_streams")


def test_the_command_shows_a_video_and_keeps_its_last_picture(tmp_path):
    video = write_video(tmp_path / "video.avi", 30 * [example_frame()], rate=10)
    with subprocess.Popen(
        [*COMMAND, video, "--port", "0", "--no-browser"],
        stdout=subprocess.PIPE,
        text=True,
        # If a shell starts the tests in the background, interrupts are ignored by default.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    ) as process:
        address = read_page_url(process)
        stream = read_pictures(request(address, "/stream"))
        for picture in (next(stream), next(stream)):
            assert picture.shape == (120 + 32 + 40, 320, 3)
        counted = re.fullmatch(
            rf"{re.escape(video)}: (\d+) of 30 frames shown, [\d.]+ per second, \d+ ms .*\n",
            process.stdout.readline(),
        )
        assert "last picture stays" in process.stdout.readline()
        late = read_pictures(request(address, "/stream"))
        assert next(late).shape == (120 + 32 + 40, 320, 3)
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=60) == 0
    assert counted is not None
    assert 2 <= int(counted[1]) <= 30


def test_an_interrupt_ends_the_command_cleanly(tmp_path):
    video = write_video(tmp_path / "video.avi", 20 * [example_frame()], rate=0.2)
    process = subprocess.Popen(
        [*COMMAND, video, "--port", "0", "--no-browser"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # If a shell starts the tests in the background, interrupts are ignored by default.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    with process:
        next(read_pictures(request(read_page_url(process), "/stream")))
        process.send_signal(signal.SIGINT)
        said, complaint = process.communicate(timeout=60)
    assert (process.returncode, complaint) == (0, "")
    assert "1 of 1 frames shown" in said


def test_an_unknown_frame_packing_is_refused_before_anything_is_opened():
    with pytest.raises(StereoweaveError, match=r"^format: expected one of side_by_side, .* found 'beside'"):
        live(["nowhere.mp4"], format="beside")
    with pytest.raises(
        StereoweaveError, match=r"^format: expected a single source with both views, found 0 1; omit"
    ):
        live(["0", "1"], format="crossed")


def test_a_frame_that_cannot_be_halved_is_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "frame000.png"), np.zeros((64, 61, 3), np.uint8))
    with pytest.raises(FormatError, match="found 61x64"):
        live([str(tmp_path / "frame%03d.png")], format="side_by_side", port=0, browser=False)
