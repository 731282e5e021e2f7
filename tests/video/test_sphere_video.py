import re
import struct
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest
from conversions import frames_of, times_of
from rich.console import Console
from spatial_examples import box, psnr_db, with_boxes
from video_examples import write_side_by_side

from experiments.sphere_windows.room import look_equirectangular, look_fisheye, render_fixed, render_turning
from stereoweave.cameras.alignment import check_pair
from stereoweave.cameras.spherical import Projection, SphereRequest
from stereoweave.cli.root import main
from stereoweave.errors import StereoweaveError
from stereoweave.matching.backend import Backend
from stereoweave.video.convert import convert_video
from stereoweave.video.job import VideoJob
from stereoweave.video.mp4_marks import VideoMarks, write_marks
from stereoweave.video.reader import open_video

VR180 = {"packing": "side_by_side", "projection": "half_equirectangular"}


@pytest.fixture(scope="session")
def half_scene():
    return render_fixed(look_equirectangular((256, 256)))


@pytest.fixture(scope="session")
def round_scene():
    return render_turning((512, 256))


def write_film(path, scene, *, layout="side_by_side", count=5, marks=None, **more):
    # Each frame is a little darker.
    pairs = [((scene.left - 2 * step), (scene.right - 2 * step)) for step in range(count)]
    pairs = [tuple(np.clip(eye, 0, 255).astype(np.uint8) for eye in pair) for pair in pairs]
    write_side_by_side(path, pairs, layout=layout, codec="libx264", **more)
    if marks:
        write_marks(path, VideoMarks(**marks))
    return path


def run(*words):
    return main([*map(str, words)])


def first_frame(video):
    return next(iter(video.frames()))


def test_a_marked_vr180_film_opens_as_a_window_with_its_baseline(tmp_path, half_scene):
    video = open_video([write_film(tmp_path / "a.mp4", half_scene, marks=VR180 | {"baseline_m": 0.063})])
    # 256 px over 180 degrees: 81.5 px of focal length, and a window of twice that.
    assert video.size_px == (162, 162) and video.frame_packing == "side_by_side"
    assert video.camera.focal_px == pytest.approx(256 / np.pi) and video.camera.baseline_m == 0.063
    frame = first_frame(video)
    assert frame.left.shape == (162, 162, 3)
    assert check_pair(frame.left, frame.right).vertical_error_95_px < 0.7
    assert str(video.notes[-1]).startswith("half_equirectangular of 180x180 degrees; shown: a window at 0,0")


def test_a_marked_360_degree_film_is_cut_behind_the_camera(tmp_path, round_scene):
    marks = {"packing": "top_bottom", "projection": "equirectangular"}
    film = write_film(tmp_path / "a.mp4", round_scene, layout="top_bottom", marks=marks)
    video = open_video([film], sphere=SphereRequest(look_deg=(180, 0), fov_deg=80))
    frame = first_frame(video)
    found = check_pair(frame.left, frame.right)
    assert found.vertical_error_95_px < 0.7 and not found.defects


def test_bounds_of_a_part_of_the_sphere_are_read(tmp_path, half_scene):
    # A film of 135 degrees from top to bottom: 32 of 256 rows are cut off above and below.
    part = half_scene._replace(left=half_scene.left[32:224], right=half_scene.right[32:224])
    marks = VR180 | {"vertical_field_of_view_deg": 135.0}
    video = open_video([write_film(tmp_path / "a.mp4", part, marks=marks)])
    whole = open_video([write_film(tmp_path / "b.mp4", half_scene, marks=VR180)])
    assert video.sphere.projection.pitch_deg == (-67.5, 67.5)
    assert psnr_db(first_frame(video).left, first_frame(whole).left) > 30


def test_an_unmarked_film_is_shown_by_the_projection_that_the_user_gives(tmp_path):
    scene = render_fixed(look_fisheye(256, 190.0))
    film = write_film(tmp_path / "a.mp4", scene)
    request = SphereRequest(projection="fisheye", lens_fov_deg=190)
    frame = first_frame(open_video([film], "side_by_side", sphere=request))
    assert check_pair(frame.left, frame.right).vertical_error_95_px < 0.7
    assert open_video([film], "side_by_side").sphere is None


def test_a_name_states_the_projection_of_a_film(tmp_path, half_scene):
    video = open_video([write_film(tmp_path / "a_180x180_LR.mp4", half_scene)])
    assert "half_equirectangular of 180x180 degrees, detected from the name" in str(video.notes[-1])


def test_a_film_that_declares_to_be_ordinary_is_so_whatever_its_name(tmp_path, half_scene):
    boxes = box(b"vexu", box(b"proj", box(b"prji", bytes(4) + b"rect")))
    film = write_film(tmp_path / "a_180_LR.mp4", half_scene, count=1)
    assert open_video([film]).sphere is not None
    film.write_bytes(with_boxes(film.read_bytes(), boxes))
    for layout in (None, "side_by_side"):
        video = open_video([film], layout)
        assert video.sphere is None and video.size_px[1] == 256
    chosen = open_video([film], "side_by_side", sphere=SphereRequest(projection="half_equirectangular"))
    assert chosen.sphere.projection.yaw_deg == (-90, 90)


def test_a_window_of_a_film_is_converted_with_its_times(tmp_path, half_scene, capsys):
    times_ms = [0, 40, 90, 130, 200]
    film = write_film(tmp_path / "a.mp4", half_scene, marks=VR180, times_ms=times_ms, sound=True)
    out = tmp_path / "b.mp4"
    assert run("video", film, "--layout", "anaglyph_grey", "--fov", 60, "-o", out) == 0
    assert "; shown: a window at 0,0 degrees, 94x94 px" in capsys.readouterr().err
    assert times_of(out) == [Fraction(time, 1000) for time in times_ms]
    with av.open(str(out)) as container:
        assert (container.streams.video[0].width, container.streams.video[0].height) == (94, 94)
        assert container.streams.audio


def test_the_maps_of_a_film_are_computed_once(tmp_path, half_scene, monkeypatch):
    film = write_film(tmp_path / "a.mp4", half_scene, marks=VR180)
    located = []
    locate = Projection.locate
    monkeypatch.setattr(Projection, "locate", lambda *given: located.append(1) or locate(*given))
    assert len(list(open_video([film]).frames())) == 5
    assert len(located) == 1


@pytest.mark.parametrize(
    ("layout", "packing"), [("side_by_side", "side_by_side"), ("top_bottom", "top_bottom")]
)
def test_the_whole_of_a_film_becomes_vr180_again(tmp_path, half_scene, layout, packing):
    # Chroma of half resolution loses fine colours, whatever else is done.
    left, right = (cv2.GaussianBlur(eye, (0, 0), 3) for eye in (half_scene.left, half_scene.right))
    smooth = half_scene._replace(left=left, right=right)
    film = write_film(tmp_path / "a.mp4", smooth, marks=VR180 | {"baseline_m": 0.063})
    assert run("video", film, "--whole", "--layout", layout, "-o", tmp_path / "b.mp4") == 0
    [out] = tmp_path.glob("b*.mp4")
    again = open_video([out])
    assert again.frame_packing == layout and again.declared_sphere.baseline_m == 0.063
    assert again.sphere.projection == Projection.named("half_equirectangular")
    one, other = (frames_of(path, "rgb24")[2] for path in (film, out))
    if layout == "top_bottom":
        one = np.vstack(np.split(one, 2, axis=1))
    middle = np.s_[40:216, 40:216]
    assert psnr_db(other[middle], one[middle]) > 30


@pytest.mark.parametrize(
    ("words", "baseline_m"),
    [(["--strength", 0.5], 0.0315), (["--convergence", 2], None), (["--screen", "headset"], None)],
)
def test_the_baseline_of_a_whole_film_is_that_of_its_new_views(tmp_path, half_scene, words, baseline_m):
    film = write_film(tmp_path / "a.mp4", half_scene, marks=VR180 | {"baseline_m": 0.063}, count=1)
    words = "--whole", "--layout", "side_by_side", *words, "--threads", 1
    assert run("video", film, *words, "-o", tmp_path / "b.mp4") == 0
    [out] = tmp_path.glob("b*.mp4")
    assert open_video([out]).declared_sphere.baseline_m == baseline_m


def test_the_colours_of_a_whole_film_are_explained_as_nearness(tmp_path, half_scene):
    film = write_film(tmp_path / "a.mp4", half_scene, marks=VR180, count=1)
    assert run("video", film, "--whole", "--depth", "--threads", 1, "-o", tmp_path / "b.mp4") == 0
    with av.open(str(tmp_path / "b.mp4")) as container:
        comment = container.metadata["comment"]
    # 256 px over 180 degrees: 81.4873 px a radian.
    assert re.sub(r"\d[\d.]* px is", "N px is", comment) == (
        "nearness in the left view: N px is blue, N px is red; distance = 81.4873 / px baselines; 0 px where "
        "the baseline vanishes"
    )


def test_a_view_and_the_depth_of_a_whole_film_have_one_eye(tmp_path, half_scene):
    film = write_film(tmp_path / "a.mp4", half_scene, marks=VR180)
    for index, words in enumerate((["--position", 0.5], ["--depth"])):
        out = tmp_path / f"{index}.mp4"
        assert run("video", film, "--whole", *words, "-o", out) == 0
        frames = frames_of(out, "rgb24")
        assert len(frames) == 5 and frames[0].shape == (256, 256, 3)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--layout", "quilt"], "expected one of side_by_side, crossed, top_bottom"),
        (["--layout", "side_by_side_half"], "for the whole field of view, found side_by_side_half"),
        (["--depth16"], "found more; leave them out (--depth10, --depth16, --bits)"),
        (["--depth", "--fov", "60"], "--fov: expected only for a window, found with the whole"),
        (["--depth", "--projection", "cube"], "rectilinear, equirectangular, half_equirectangular, fisheye"),
        (["--depth", "--projection", "rectilinear"], "--whole: expected only for VR180 and 360-degree files"),
    ],
)
def test_what_the_whole_cannot_show_is_refused_in_one_line(tmp_path, half_scene, capsys, words, said):
    film = write_film(tmp_path / "a.mp4", half_scene, marks=VR180, count=1)
    assert run("video", film, "--whole", *words, "-o", tmp_path / "b.mkv") != 0
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert said in error


def stop_after_a_part(film, out, **sphere):
    """Convert the left views of a film of 0.8 s a frame until the sixth, and leave a part of five frames."""
    video = open_video([film], "side_by_side", sphere=SphereRequest(**sphere))

    def stop(number):
        if number == 6 and any(out.parent.glob("*.parts/*.nut")):
            raise StereoweaveError("stopped")

    video.on_frame = stop
    job = VideoJob(position=0, backend=Backend(threads=1))
    with pytest.raises(StereoweaveError, match="stopped"):
        convert_video(video, [film], out, job, Console(quiet=True))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ["--projection", "rectilinear"],
            "made with --projection half_equirectangular, with --look 5,0, with --fov 60.0; remove",
        ),
        (["--look", "5,1", "--fov", 60], "made with --look 5,0; remove"),
        (["--look", "5,0"], "made with --fov 60.0; remove"),
        (["--whole"], ", with --look 5,0, with --fov 60.0, without --whole; remove"),
    ],
)
def test_a_conversion_of_another_window_is_not_resumed(tmp_path, half_scene, capsys, words, said):
    film = write_film(tmp_path / "a.mp4", half_scene, marks=VR180, count=7, times_ms=range(0, 5600, 800))
    stop_after_a_part(film, tmp_path / "b.mp4", look_deg=(5.0, 0.0), fov_deg=60.0)
    given = ["--position", 0, "--format", "side_by_side", "--threads", 1]
    assert run("video", film, *given, *words, "-o", tmp_path / "b.mp4") != 0
    [line] = [line for line in capsys.readouterr().err.splitlines() if line.startswith("stereoweave")]
    assert said in line


def sv3d(projection):
    head = box(b"svhd", bytes(4) + b"a\0")
    return box(b"sv3d", head + box(b"proj", box(b"prhd", bytes(16)) + projection))


def equi(top, bottom, left, right):
    return box(b"equi", bytes(4) + struct.pack(">4L", top, bottom, left, right))


STEREO = box(b"st3d", bytes(4) + b"\2")


@pytest.mark.parametrize(
    ("boxes", "said"),
    [
        (STEREO + sv3d(box(b"cbmp", bytes(12))), "found a cubemap; convert it to an equirectangular one"),
        (STEREO + sv3d(equi(0, 0, 2**31 - 1, 2**31 - 1)), "its bounds (sv3d) are damaged"),
    ],
)
def test_a_film_of_an_impossible_projection_is_refused_in_one_line(tmp_path, half_scene, boxes, said):
    film = write_film(tmp_path / "a.mp4", half_scene, count=1)
    film.write_bytes(with_boxes(film.read_bytes(), boxes))
    with pytest.raises(StereoweaveError) as error:
        open_video([film])
    assert said in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    "boxes",
    [
        STEREO + sv3d(equi(2**32 - 1, 2**32 - 1, 2**32 - 1, 2**32 - 1)),
        STEREO + sv3d(equi(2**31, 2**31 - 1, 0, 0)),
        STEREO + sv3d(equi(0, 0, 0, 0)[:-4]),
        STEREO + sv3d(b""),
        STEREO + sv3d(box(b"equi", b"")),
        STEREO[:-1] + sv3d(equi(0, 0, 2**30, 2**30)),
        STEREO + sv3d(equi(0, 0, 2**30, 2**30))[:20],
        box(b"vexu", box(b"proj", box(b"prji", bytes(4) + b"????"))),
    ],
)
def test_a_film_with_damaged_marks_opens_or_is_refused_in_one_line(tmp_path, half_scene, boxes):
    film = write_film(tmp_path / "a.mp4", half_scene, count=1)
    film.write_bytes(with_boxes(film.read_bytes(), boxes))
    try:
        video = open_video([film], "side_by_side")
    except StereoweaveError as error:
        assert "\n" not in str(error)
    else:
        assert first_frame(video).left.ndim == 3
