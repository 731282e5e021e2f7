"""The check of a video finds the shots of a film and the defects that were put into them."""

import json
import math
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from faulty_video_examples import SHIP, WIDTH, box_at_the_left_border, faulty_film, shot_of
from PIL import Image
from rich.progress import Progress
from video_examples import TEXTURED, example_pairs, flat_pairs, truncate, write_side_by_side, write_video

from stereoweave.cli.root import main
from stereoweave.io.images import write_image
from stereoweave.matching.matcher import Matcher
from stereoweave.stereo import StereoPair
from stereoweave.video.frame_check import check_frame, measure_bars
from stereoweave.video.reader import StereoFrame, open_video
from stereoweave.video.video_check import check_video


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    return faulty_film(tmp_path_factory.mktemp("film") / "film.mp4")


@pytest.fixture(scope="module")
def matcher() -> Matcher:
    return Matcher("small", threads=1)


@pytest.fixture(scope="module")
def found(film, matcher):
    return check_video(open_video([film]), matcher, Progress(disable=True))


def test_a_checked_video_still_calls_its_own_function_for_each_frame(tmp_path, matcher):
    video = open_video([write_side_by_side(tmp_path / "flat.mp4", flat_pairs(3))], "side_by_side")
    video.on_frame = (read := []).append
    check_video(video, matcher, Progress(disable=True))
    assert read == []
    list(video.frames())
    assert read == [0, 1, 2]


def frame_of(left: np.ndarray, right: np.ndarray) -> StereoFrame:
    return StereoFrame(left, right, Fraction(0), None)


def test_the_shots_are_found_with_their_times(found):
    assert [(shot.start_s, shot.end_s, shot.frames) for shot in found.shots] == [
        (Fraction(8 * number, 25), Fraction(8 * number + 8, 25), 8) for number in range(4)
    ]


def test_each_shot_has_the_defects_that_were_put_into_it(found):
    assert [shot.defects for shot in found.shots] == [[], ["swapped"], ["vertical_shift", "exposure"], []]
    assert found.defects == ["swapped", "vertical_shift", "exposure"]
    assert found.lines() == [
        "shot 2: left and right are swapped",
        "shot 3: the eyes' rows are apart",
        "shot 3: the eyes differ in exposure",
    ]


def test_rows_and_exposure_are_measured(found):
    assert [shot.median("rows_px") for shot in found.shots] == pytest.approx([0, 0, 3, 0], abs=0.25)
    assert found.shots[2].median("shift_px") == pytest.approx(3.0, abs=0.25)
    # 0.6 times the levels is 0.6 ** 2.2 times the light.
    stops = [shot.median("exposure_stops") for shot in found.shots]
    assert stops == pytest.approx([0, 0, 2.2 * math.log2(0.6), 0], abs=0.1)


def test_what_the_left_border_cuts_off_is_measured(found):
    # The box is 12 px in front of the screen, and the wall is on it.
    left_px, right_px = found.shots[3].windows_px
    assert left_px == pytest.approx(12, abs=1.5)
    assert right_px == 0
    near_percent, far_percent = found.shots[3].range_percent
    assert near_percent == pytest.approx(-100 * 12 / WIDTH, abs=0.5)
    assert far_percent == pytest.approx(0, abs=0.3)
    # 3.75 % in front: only the light-field display shows 4 %.
    assert found.shots[3].comfortable == ["light_field"]


def test_a_swapped_shot_is_measured_as_it_is_shown_with_near_and_far_exchanged(found, matcher):
    right_way = check_frame(frame_of(*shot_of(SHIP, 6)[-1]), matcher).depth
    assert found.shots[1].depth.far_px == pytest.approx(-right_way.near_px, abs=4)
    assert found.shots[1].depth.near_px == pytest.approx(-right_way.far_px, abs=4)


def test_depth_and_borders_are_defects_for_a_chosen_screen(found):
    chosen = [replace(shot, screen="light_field") for shot in found.shots]
    assert chosen[3].defects == ["cut_off"]
    assert chosen[1].defects == ["swapped", "too_deep"]


def test_a_bluer_eye_differs_in_colour(matcher):
    left, right = example_pairs(1, width=320, height=240)[0]
    weaker = np.rint(right * np.array([1.0, 1.0, 0.8])).astype(np.uint8)
    assert "colour" not in check_frame(frame_of(left, right), matcher).defects
    found = check_frame(frame_of(left, weaker), matcher)
    assert found.colour_stops == pytest.approx(-2.2 * math.log2(0.8), abs=0.1)
    assert "colour" in found.defects


def test_a_floating_window_of_the_object_s_parallax_mends_what_a_border_cuts_off(matcher):
    left, right = box_at_the_left_border(1)[0]
    assert check_frame(frame_of(left, right), matcher).windows_px[0] == pytest.approx(12, abs=1.5)
    for bar_px, expected_px in ((12, 0), (5, 12)):
        windowed = left.copy()
        windowed[:, :bar_px] = 0
        found_px, _ = check_frame(frame_of(windowed, right), matcher).windows_px
        assert found_px == pytest.approx(expected_px, abs=1.5)


def test_bars_of_both_eyes_are_no_floating_window(matcher):
    left, right = box_at_the_left_border(1)[0]
    wide = [np.pad(eye, ((0, 0), (30, 30), (0, 0))) for eye in (left, right)]
    assert measure_bars(StereoPair(left=wide[0], right=wide[1])) == ((30, 30), (30, 30))


def test_long_shots_have_a_sample_a_second(tmp_path, matcher):
    pairs = box_at_the_left_border(6)
    video = write_side_by_side(tmp_path / "slow.mp4", pairs, times_ms=range(0, 3000, 500), codec="libx264")
    found = check_video(open_video([video]), matcher, Progress(disable=True))
    # The first is due after 0.2 s.
    assert [sample.time for sample in found.shots[0].samples] == [
        Fraction(1, 2),
        Fraction(3, 2),
        Fraction(5, 2),
    ]


def run(*words: object) -> int:
    return main(["check", *map(str, words)])


def test_the_command_prints_tables_and_a_line_for_each_defect(film, capsys):
    assert run(film) == 1
    printed = capsys.readouterr().out
    assert "Depth as shown; negative percents are in front of the screen" in printed
    rows = [line.split() for line in printed.splitlines() if line.strip()[:1] in "1234" and "0:0" in line]
    assert [row[1:3] for row in rows] == [
        ["0:00.0", "0:00.3"],
        ["0:00.3", "0:00.6"],
        ["0:00.6", "0:01.0"],
        ["0:01.0", "0:01.3"],
    ]
    assert "shot 2: left and right are swapped" in printed
    assert "rows, exposure" in printed


def test_the_command_gives_all_numbers_as_json(film, capsys):
    assert run("--film", film, "--json", "--screen", "television") == 1
    facts = json.loads(capsys.readouterr().out)
    assert (facts["width_px"], facts["height_px"], len(facts["shots"])) == (320, 240, 4)
    last = facts["shots"][3]
    assert last["windows_px"][0] == pytest.approx(12, abs=1.5)
    assert last["defects"] == ["too_deep", "cut_off"]
    television = last["screens"]["television"]
    # 12 px of depth in a budget of 9.6 px, a third of it in front.
    assert television["comfortable"] is False
    assert television["strength"] == pytest.approx(9.6 / 12, abs=0.1)
    assert television["convergence_px"] == pytest.approx(12 * 2 / 3, abs=1)


def test_a_sound_video_passes(tmp_path, capsys):
    video = write_side_by_side(tmp_path / "in.mp4", shot_of(TEXTURED, 3), codec="libx264")
    assert run(video) == 0
    assert "no defects: the eyes agree in all shots" in capsys.readouterr().out


def black(side: int) -> list:
    pairs = []
    for pair in shot_of(TEXTURED, 3):
        eyes = list(pair)
        eyes[side] = np.zeros_like(eyes[side])
        pairs.append(tuple(eyes))
    return pairs


ODD_VIDEOS = {
    "one frame": (lambda: shot_of(TEXTURED, 1), 0, "no defects"),
    "two frames": (lambda: shot_of(TEXTURED, 2), 0, "no defects"),
    "left eye black": (lambda: black(0), 1, "shot 1: the left eye is empty"),
    "right eye black": (lambda: black(1), 1, "shot 1: the right eye is empty"),
    "one colour": (lambda: [(np.full((96, 160, 3), 90, np.uint8),) * 2] * 3, 1, "too plain to be checked"),
    "two colours": (lambda: flat_pairs(3, width=160, height=96), 1, "too plain to be checked"),
    "black": (lambda: [(np.zeros((96, 160, 3), np.uint8),) * 2] * 3, 1, "too plain to be checked"),
    "the same view twice": (lambda: [(pair[0],) * 2 for pair in shot_of(TEXTURED, 3)], 1, "flat: both eyes"),
    "other scenes": (
        lambda: [(one[0], two[0]) for one, two in zip(shot_of(TEXTURED, 2), shot_of(SHIP, 2), strict=True)],
        1,
        "the eyes show different scenes",
    ),
    "tiny": (lambda: example_pairs(2, width=32, height=32), None, ""),
    "a title before": (
        lambda: [(np.zeros((240, 320, 3), np.uint8),) * 2] * 3 + shot_of(TEXTURED, 3),
        0,
        "shot 1: too plain to be checked",
    ),
}


def test_a_title_before_a_film_that_suits_the_screen_is_no_defect(tmp_path, capsys):
    make, *_ = ODD_VIDEOS["a title before"]
    video = write_side_by_side(tmp_path / "film.mp4", make(), codec="libx264")
    run(video, "--format", "side_by_side", "--screen", "phone")
    lines = capsys.readouterr().out.splitlines()
    assert "shot 1: too plain to be checked" in lines
    cut = "near objects are cut off by the left or right border"
    assert [line for line in lines if cut in line] == [f"shot 2: {cut}"]


@pytest.mark.parametrize("name", ODD_VIDEOS)
def test_an_odd_video_gets_a_line(name, tmp_path, capsys):
    make, status, words = ODD_VIDEOS[name]
    video = write_side_by_side(tmp_path / "odd.mp4", make(), codec="libx264")
    found = run(video, "--format", "side_by_side", "--timeline", tmp_path / "t.png")
    assert found == status or (status is None and found in (0, 1))
    printed, told = capsys.readouterr()
    assert words in printed
    assert "Traceback" not in told
    with Image.open(tmp_path / "t.png") as picture:
        assert picture.size == (1600, 940)


def test_the_timeline_names_the_file_without_its_folder(tmp_path):
    pictures = []
    for folder in (tmp_path, tmp_path / "another folder"):
        folder.mkdir(exist_ok=True)
        video = write_side_by_side(folder / "in.mp4", flat_pairs(1), codec="libx264")
        run(video, "--format", "side_by_side", "--timeline", folder / "t.png")
        with Image.open(folder / "t.png") as picture:
            pictures.append(np.asarray(picture))
    np.testing.assert_array_equal(*pictures)


def test_a_timeline_does_not_replace_a_frame(tmp_path, capsys):
    for eye, pair in zip(("left", "right"), zip(*flat_pairs(2), strict=True), strict=True):
        (tmp_path / eye).mkdir()
        for number, image in enumerate(pair):
            write_image(tmp_path / eye / f"{number}.png", image)
    frame = tmp_path / "left" / "0.png"
    before = frame.read_bytes()
    assert run(tmp_path / "left", tmp_path / "right", "--film", "--timeline", frame) == 2
    assert capsys.readouterr().err.endswith(
        "0.png: expected a new file, found one of the inputs; choose another one (--timeline)\n"
    )
    assert frame.read_bytes() == before


def test_a_packing_that_no_picture_has_means_a_video(tmp_path, capsys):
    frames = [view for pair in example_pairs(3) for view in pair]
    video = write_video(tmp_path / "in.mkv", frames, codec="ffv1")
    run(video, "--format", "frame_sequential")
    assert "shot" in capsys.readouterr().out


def test_a_cut_file_is_checked_as_far_as_it_goes_and_says_so(tmp_path, capsys):
    whole = write_side_by_side(
        tmp_path / "cut.mkv", shot_of(TEXTURED, 20), codec="libx264", options={"g": "4"}
    )
    assert run(truncate(whole, 0.6)) == 0
    printed = capsys.readouterr().out
    assert "problems in 1 of" in printed
    assert "no defects" in printed


BAD = {
    "an empty file": (["empty.mp4"], "empty.mp4: expected"),
    "a text": (["text.mp4"], "text.mp4: expected"),
    "no file": (["missing.mp4"], "missing.mp4: expected"),
    "a folder without pictures": (["--film", "folder"], "folder"),
    "a mono film": (["mono.mp4"], "mono.mp4"),
    "an unknown screen": (["good.mp4", "--screen", "tv"], "--screen: expected one of phone, television"),
    "an unknown packing": (["good.mp4", "--format", "diagonal"], "--format: expected one of"),
    "a timeline that is no picture": (["good.mp4", "--timeline", "t.txt"], "t.txt: expected a picture file"),
    "a timeline that is a folder": (
        ["good.mp4", "--timeline", "taken.png"],
        "taken.png: expected a writable",
    ),
    "three videos": (["--film", "good.mp4", "good.mp4", "good.mp4"], "found 3"),
    "a picture as a film": (["--film", "left.png"], "left.png"),
    "pictures with a screen": (
        ["left.png", "right.png", "--screen", "phone"],
        "--screen: expected only with a video",
    ),
    "pictures with a timeline": (
        ["left.png", "right.png", "--timeline", "t.png"],
        "--timeline: expected only",
    ),
    "two sizes": (["--film", "good.mp4", "mono.mp4"], "same size"),
}


@pytest.fixture(scope="module")
def bad_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bad")
    (folder / "empty.mp4").write_bytes(b"")
    (folder / "text.mp4").write_text("no video " * 50)
    (folder / "folder").mkdir()
    (folder / "taken.png").mkdir()
    pairs = shot_of(TEXTURED, 2)
    write_side_by_side(folder / "good.mp4", pairs, codec="libx264")
    write_video(folder / "mono.mp4", [left for left, _ in pairs], codec="libx264")
    for name, image in zip(("left", "right"), pairs[0], strict=True):
        Image.fromarray(image).save(folder / f"{name}.png")
    return folder


@pytest.mark.parametrize("name", BAD)
def test_a_wrong_file_or_option_is_one_line(name, bad_folder, monkeypatch, capsys):
    monkeypatch.chdir(bad_folder)
    words, fragment = BAD[name]
    before = sorted(Path().iterdir())
    assert run(*words) == 2
    printed, told = capsys.readouterr()
    assert printed == ""
    assert fragment in told
    assert len(told.strip().splitlines()) == 1
    assert sorted(Path().iterdir()) == before
