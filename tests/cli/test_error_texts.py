"""Error texts and notes of the command line, where a setting is named by its option."""

from pathlib import Path

import pytest
from command_output import without_steps
from error_examples import LAYOUTS, write_error_examples

from stereoweave.cli.root import main
from stereoweave.outputs.results import FILES
from stereoweave.rendering.layouts import ANIMATIONS, VIEWER
from stereoweave.rendering.layouts import LAYOUTS as VIEW_LAYOUTS

PAIR = "left.png right.png"
NO_CAMERA = (
    "expected a camera for depth, found none; give a calibration, or the focal length and baseline of a "
    "rectified pair (--calib, --focal-px, --baseline-m)"
)
PICTURE = "a picture (PNG, JPEG, TIFF or the like)"
ERRORS = {
    "depth left.png -o out": "left.png: expected a stereo picture, two views side by side or one above the "
    "other, found what looks like a single photograph (its halves do not resemble each other); give two "
    "files, left and right; or choose its layout, such as side_by_side (--format)",
    f"depth {PAIR} --format crossed -o out": "--format: expected one picture that holds both views, found "
    "two, left.png and right.png; omit this setting, and give the left picture first",
    "view both.png --format diagonal -o out.png": f"--format: expected one of {LAYOUTS}, mpo, jps, found "
    "'diagonal'",
    f"depth {PAIR} --calib turned.yml -o out": "turned.yml: expected a calibration of rectified pictures, "
    "found lenses with distortion; rectify the pair with it (--rectify)",
    f"depth {PAIR} --focal-px 500 -o out": "metres: expected a baseline besides the focal length, "
    "found none in metadata; give the baseline (--baseline-m)",
    f"depth {PAIR} --baseline-m 0.1 -o out": "metres: expected a focal length besides the "
    "baseline, found none in metadata; give the focal length (--focal-px)",
    "view plain.png plain.png --rectify -o out.png": "--rectify: expected at least 40 feature matches "
    "that agree on the camera positions, found 0 of 0 matches; photograph a scene with more "
    "texture and with more overlap; or give a calibration (--calib)",
    "rectify plain.png plain.png -o out": "rectify: expected at least 40 feature matches that agree on the "
    "camera positions, found 0 of 0 matches; photograph a scene with more texture and with more "
    "overlap; or give a calibration (--calib)",
    "rectify both.png --format diagonal -o out": f"--format: expected one of {LAYOUTS}, mpo, jps, found "
    "'diagonal'",
    f"depth {PAIR} --write depth.npy -o out": f"depth.npy: {NO_CAMERA}",
    f"depth {PAIR} --write x.obj -o out": f"--write: expected one of all, {', '.join(FILES)}, found 'x.obj'",
    f"measure {PAIR} --from 1,2 --to 3,4": NO_CAMERA,
    f"depth {PAIR} --raw --refined -o out": "--raw: cannot be combined with refined, because raw "
    "output is not post-processed; leave one of them out (--raw, --refined)",
    f"depth {PAIR} --range 700,800 -o out": "--range: expected disparities between -640 and 640 px, the "
    "width of the pictures, got 700 and 800; omit it for automatic detection",
    f"depth {PAIR} --provider gpu -o out": "--provider: expected one of cpu, cuda, tensorrt, openvino, "
    "coreml, directml, found 'gpu'",
    f"depth {PAIR} --list list.txt -o out": "expected pictures or a folder, patterns of left and right "
    "pictures, or a list of pairs, found pictures and a list; give exactly one of them (--left, --right, "
    "--list)",
    "depth --left none*.png --right right*.png -o out": "--left: expected pictures that match none*.png, "
    "found none; check and quote the pattern",
    "depth lef.png right.png": f"lef.png: expected {PICTURE}, found no such file; did you mean left.png?",
    "depth left.png Right.png": f"Right.png: expected {PICTURE}, found no such file; did you mean right.png?",
    "depth *.jpg": f"*.jpg: expected {PICTURE}, found no file that matches",
    "depth http://a.org/left.png right.png": f"http://a.org/left.png: expected {PICTURE}, found an address; "
    "download the file first, because nothing is fetched",
    "depth left.png notes.txt": f"notes.txt: expected {PICTURE}, found another type of file; save it as PNG "
    "or JPEG",
    "depth left.png empty.png": f"empty.png: expected {PICTURE}, found an empty file; copy it again",
    f"depth {PAIR} out": "expected two pictures, left and right, or one that holds both views, found 3: "
    "left.png right.png out; if one of them is the output, name it as such (--out)",
    f"view {PAIR} out.png": "expected two pictures, left and right, or one that holds both views, found 3: "
    "left.png right.png out.png; if one of them is the output, name it as such (--out)",
    "check folder": f"folder: expected {PICTURE}, found a folder; give the files in it",
    "depth folder folder": "expected two pictures, or one folder of pairs, found two folders: folder folder; "
    "give a pattern of the pictures in each, such as 'left/*.png' (--left, --right)",
    "depth left.png turned.png": "expected left and right pictures of the same size, found left.png with "
    "640x480 and turned.png with 480x640 pixels; turn one of them upright",
    "depth --left left.png": "expected patterns of the left and of the right pictures, found none of the "
    "right ones; give both, or give the pictures themselves (--left, --right)",
    "depth --list left.png": "left.png: expected a list of pairs, found one that is not UTF-8 text",
    f"depth {PAIR} --calib left.png": "left.png: expected a text file of at most 262144 bytes, found more; "
    "give another file",
    f"depth {PAIR} --focal-px 500 --baseline-m 0": "--baseline-m: expected a number above 1e-09, found 0",
    f"depth {PAIR} --focal-px -500 --baseline-m 1": "--focal-px: expected a number above 1e-09, found -500",
    f"depth {PAIR} --focal-px 5mm": "--focal-px: expected a number, found '5mm'; see stereoweave depth "
    "--help",
    f"depth {PAIR} --threads many": "--threads: expected a whole number, found 'many'; see stereoweave "
    "depth --help",
    f"view {PAIR} -o out.gif": "out.gif: expected an animation for this extension, found a single view; "
    "choose sweep or wiggle (--layout)",
    f"{PAIR}": "expected a command, such as depth or view, before the pictures, found left.png; see "
    "stereoweave --help",
    "bench pair scenes": "no such command 'pair'; did you mean 'pairs', 'parity'? See stereoweave bench "
    "--help",
    "batch . out --gpus-each 1.5": (
        "--gpus-each: expected 0, a fraction below 1, or a whole number, found 1.5"
    ),
    f"view {PAIR} --position 3 -o out.png": (
        "--position: expected -1 to 2 (0 is the left camera and 1 the right one), got 3"
    ),
    f"view {PAIR} --layout diagonal -o out.png": "--layout: expected one of "
    f"{', '.join([*VIEW_LAYOUTS, *ANIMATIONS, VIEWER])}, found 'diagonal'",
    "video plain.png -o out.mp4": "expected one kind of output, found none; choose one (--depth, "
    "--depth10, --depth16, --position, --layout)",
    "video plain.png --depth -o out.mp4": "plain.png: expected a 3-D video, two views side by side or one "
    "above the other, found a picture that is too plain to tell; give two files, left and right; or choose "
    "its layout, such as side_by_side (--format)",
    "video plain.png --depth --format diagonal -o out.mp4": f"--format: expected one of {LAYOUTS}, "
    "frame_sequential, frame_sequential_right_first, two_streams, two_streams_right_first, found 'diagonal'",
    "synth make pylon --pairs 1 --size 8x8 -o set": "--size: expected 32 to 4096 px per side, found 8x8",
    "synth make pylon --pairs 1 --view 3 -o set": "--view: expected positions from -1.0 to 2.0 (0 is the "
    "left camera and 1 the right one), found 3.0",
    "export small": "export: expected an output file, found none; give at least one (--out, --half, "
    "--eight-bits)",
    "bench collages -o set --pairs 2 --size 64x16": "--size: expected at least 32x32 pixels, found 64x16",
}
NOTES = {
    "check upper.png lower.png": "depth and view rectify such a pair by themselves; stereoweave rectify "
    "writes its pictures",
    "check both.png": "side_by_side, detected; override it if it is wrong (--format)",
    "check right.png left.png": "left and right are swapped; give them the other way round",
    "depth inwards_left.png inwards_right.png --focal-px 640 --baseline-m 0.1 --rectify --model small "
    "-o out": "no depth in metres: rectification from feature matches did not find the cameras parallel; "
    "give a calibration (--calib)",
    "view left.png zoomed.png --calib rectified.txt --model small -o out.png": "the right picture is 12.0 % "
    "larger than the left one; give a calibration of these cameras (--calib)",
    "view left.png zoomed.png --model small -o out.png": "the right picture is 12.0 % larger than the left "
    "one; give a calibration (--calib)",
    f"depth {PAIR} --write all --model small -o out": f"no depth, point cloud or mesh: {NO_CAMERA}",
    "view upper.png lower.png --model small --no-rectify -o out.png": "the right picture is 2.0 px lower "
    "than the left one; rectify the pair (--rectify)",
}


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch) -> Path:
    write_error_examples(tmp_path)
    (tmp_path / "notes.txt").write_text("words")
    (tmp_path / "empty.png").touch()
    (tmp_path / "folder").mkdir()
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("command", ERRORS)
def test_an_error_names_settings_by_their_option(capsys, command):
    assert main(command.split()) == 2
    assert without_steps(capsys.readouterr().err) == [f"stereoweave: {ERRORS[command]}"]


@pytest.mark.parametrize("command", NOTES)
def test_a_note_names_settings_by_their_option(capsys, command):
    main(command.split())
    assert NOTES[command] in capsys.readouterr().out.splitlines()


def test_many_pairs_have_the_same_texts(capsys):
    Path("list.txt").write_text("left.png right.png sound\nupper.png lower.png low\nleft.png\n")
    words = ["depth", "--list", "list.txt", "--jobs", "1", "--threads", "1", "--no-rectify", "-o", "out"]
    assert main([*words, "--model", "small"]) == 1
    told = capsys.readouterr().err
    assert f"left: {ERRORS['depth left.png -o out']}\n" in told
    low = next(line for line in Path("out/summary.csv").read_text().splitlines() if line.startswith("low,"))
    assert NOTES["view upper.png lower.png --model small --no-rectify -o out.png"] in low


def test_notes_on_a_video_name_its_option(capsys):
    words = ["video", "upper.png", "lower.png", "--depth", "-o", "out.mkv", "--threads", "1"]
    assert main([*words, "--no-rectify"]) == 0
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "px lower" in line]
    # No time: it is about the whole video.
    assert line == "the right picture is 2.0 px lower than the left one; rectify the pair (--rectify)"


def test_a_folder_whose_pictures_name_no_side_says_what_they_are_taken_for(capsys):
    for name in ("left.png", "right.png"):
        Path(name).rename(Path("folder") / {"left.png": "a.png", "right.png": "b.png"}[name])
    assert main(["depth", "folder", "--jobs", "1"]) == 1
    told = capsys.readouterr().err
    assert "folder: no two names differ in left and right alone, as 1_L.jpg and 1_R.jpg do, so each" in told
    assert "a: folder/a.png: expected a stereo picture" in told


def test_the_short_option_for_help_is_that_of_other_programs(capsys):
    for words in (["-h"], ["depth", "-h"], ["bench", "pairs", "-h"]):
        assert main(words) == 0
        assert "Usage: stereoweave " + " ".join(words[:-1]) in capsys.readouterr().out


def test_a_folder_with_two_pairs_of_one_name_advises_a_list(capsys):
    Path("same").mkdir()
    for name in ("a.mpo", "a.jps"):
        (Path("same") / name).write_bytes(b"")
    assert main(["depth", "same", "-o", "out"]) == 2
    assert capsys.readouterr().err == (
        "stereoweave: expected pairs with different names, found a for both a.jps and a.mpo; rename one; or "
        "name them in the third column of a list (--list)\n"
    )
