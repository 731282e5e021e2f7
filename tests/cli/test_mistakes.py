"""Mistakes of a new user, over all commands: one line on stderr, which says what to do, and exit status 2.

`test_error_texts.py` has those with a pair and its settings.
"""

import shlex
import shutil
from pathlib import Path

import pytest
from error_examples import write_error_examples
from PIL import Image

from stereoweave.cli.root import main
from stereoweave.outputs.results import FILES

# A warning by Pydantic about Ray Serve when that is imported.
pytestmark = pytest.mark.filterwarnings("ignore:Using extra keyword arguments on `Field`:DeprecationWarning")

PAIR = "left.png right.png"
PICTURE_ENDINGS = ".png, .jpg, .jpeg, .tif, .tiff, .webp, .bmp"
SCENES = (
    "antenna, boards, bridge, crane, figures, propeller, pylon, refinery, rooms, ship, street, wind_turbine"
)
CALIBRATION = (
    "a calibration of two cameras (OpenCV's YAML or XML, Kalibr's camchain, KITTI's or Middlebury's)"
)
LIVE = "expected a camera number, a video file, a stream address, or pictures such as frame%03d.png, found"
CALIBRATE = "calibrate boards -o calib.yml --board 9x6 --square-mm"
MISTAKES = {
    # The words themselves.
    "dept left.png right.png": "no such command 'dept'; did you mean 'depth', 'export'? See stereoweave "
    "--help",
    "--verion": "no such option: --verion; did you mean --version? See stereoweave --help",
    "bench": "expected a command, found none; see stereoweave bench --help",
    f"depth {PAIR} --modle best": "no such option: --modle; did you mean --left, --model, --whole? See "
    "stereoweave depth --help",
    f"depth {PAIR} --out": "--out: expected a value, found none; see stereoweave depth --help",
    f"depth {PAIR} --json=yes": "--json: expected no value; see stereoweave depth --help",
    f"depth {PAIR} --jobs 0": "--jobs: expected at least 1, found '0'; see stereoweave depth --help",
    "view": "expected PICTURE (LEFT RIGHT, two pictures of the same size; or one picture that holds both "
    "views), found none; see stereoweave view --help",
    f"measure {PAIR}": "expected --from (first point: a pixel of the left picture), found none; see "
    "stereoweave measure --help",
    "calibrate boards": "expected --out (calibration file to write, in OpenCV's YAML format), found none; "
    "see stereoweave calibrate --help",
    "serve left.png": "expected nothing more, found left.png; see stereoweave serve --help",
    "serve --port 99999": "--port: expected at most 65535, found '99999'; see stereoweave serve --help",
    "synth make ship --pairs 1 -o set --rig 500": "--rig: expected 2 values; see stereoweave synth make "
    "--help",
    # Pictures.
    "depth my photo.png right.png": "expected two pictures, left and right, or one that holds both views, "
    "found 3: my photo.png right.png; put quotes around a name with spaces: 'my photo.png'",
    "depth film.mp4": "film.mp4: expected a picture (PNG, JPEG, TIFF or the like), found a video; convert it "
    "as such (stereoweave video)",
    "depth photo.heic photo.heic": "photo.heic: expected a picture (PNG, JPEG, TIFF or the like), found "
    "one that cannot be read (no box 'meta', or several); copy it again",
    "depth small.png right.png": "expected left and right pictures of the same size, found small.png with "
    "300x200 and right.png with 640x480 pixels; crop or rescale one of them",
    "depth --list pairs.txt": "pairs.txt: expected a list of pairs, found no such file",
    "depth --list wide.txt": "wide.txt, line 1: expected the left picture, the right picture and optionally "
    "a name, found 5 columns: left.png right.png a b c",
    f"depth {PAIR} -o left.png": "left.png: expected a writable folder, found a file; choose another place "
    "for the output",
    "demo -o left.png": "left.png: expected a writable folder, found a file; choose another place for the "
    "output",
    f"depth {PAIR} --model huge": "unknown model 'huge'; expected base, small, best or the path of "
    "an .onnx file",
    f"depth {PAIR} --calib calib.txt": f"calib.txt: expected {CALIBRATION}, found no such file",
    f"depth {PAIR} --write mesh": f"--write: expected one of all, {', '.join(FILES)}, found 'mesh'; "
    "did you mean mesh.ply or mesh.glb?",
    f"measure {PAIR} --from 1 --to 3,4": "--from: expected column and row of a pixel, such as 320,240, found "
    "'1'",
    f"measure {PAIR} --from 1,2 --to 3000,4 --focal-px 500 --baseline-m 0.1": "expected a pixel of the left "
    "picture, from 0,0 to 639,479, found 3000,4",
    # Views.
    f"view {PAIR} -o view": f"view: expected a picture file extension ({PICTURE_ENDINGS}), found none; "
    "3-D pictures have .mpo, .heic, .jps, .html; sweep and wiggle .mp4, .gif",
    f"view {PAIR} --layout wiggle -o wiggle.png": "wiggle.png: expected an animation file extension (.mp4, "
    ".gif, .webp), found .png",
    f"view {PAIR} --layout viewer -o photo.png": "photo.png: expected the file extension .html for the "
    "layout viewer, found .png",
    f"view {PAIR} --layout quilt --quilt 0x6": "--quilt: expected columns and rows for 2 to 200 views, got "
    "0x6; displays use 5x9, 8x6, 7x7 or 11x6",
    f"view {PAIR} --layout wiggle --position 0.3": "--position: expected only for a single view, found with "
    "the layout wiggle, whose positions are fixed; widen them with --strength",
    f"view {PAIR} --position 1 --strength 9": "--strength: expected views from -1 to 2 (0 is the left "
    "camera and 1 the right one), got 5 (position 1 at strength 9)",
    f"view {PAIR} --size big": "--size: expected the longer side in pixels, or width x height, such as 1600 "
    "or 1600x1200, at least 32 px per side, found 'big'",
    # Rigs.
    f"check {PAIR} small.png": "expected two pictures, left and right, or one that holds both views, found "
    "3: left.png right.png small.png",
    f"rectify {PAIR} -o .": "left.png: expected a new file, found one of the inputs; "
    "choose another one (--out)",
    f"view {PAIR} -o ./left.png": "left.png: expected a new file, found one of the inputs; "
    "choose another one (--out)",
    f"view {PAIR} -o right.png": "right.png: expected a new file, found one of the inputs; "
    "choose another one (--out)",
    "calibrate none -o calib.yml --board 9x6 --square-mm 25": "none: expected a folder with pictures of a "
    "board, found no such folder",
    "calibrate boards -o calib.yml --board 9 --square-mm 25": "--board: expected columns and rows, such as "
    "9x6, found '9'",
    "calibrate boards -o left.png --board 9x6 --square-mm 25": "left.png: expected the file extension "
    ".yml or .yaml, found .png",
    f"{CALIBRATE} 0": "expected a board of at least 3x3 with squares larger than 0 mm, found 9x6 with "
    "squares of 0 mm",
    f"{CALIBRATE} 25 --charuco DICT_5X5_100": "expected both the dictionary and the size of a ChArUco "
    "board's markers, found only one of them",
    f"{CALIBRATE} 25 --charuco DICT_5X5_100 --marker-mm 30": "expected markers smaller than the squares (25 "
    "mm), found markers of 30 mm",
    f"{CALIBRATE} 25": "boards: expected pairs of pictures, such as left/01.png and right/01.png or 01_L.png "
    "and 01_R.png, found none among 0 files",
    # Many pairs, services and live pictures.
    "batch ftp://host/x out": "ftp://host/x: expected a path, or a URL that begins with s3://, gs://, az://, "
    "abfs:// or file://, found ftp://",
    "batch boards out --cpus-each 0": "--cpus-each: expected 0.0001 or more, found 0.0",
    "serve --host 0.0.0.0 --port 0": "--host 0.0.0.0: expected a loopback address, such as 127.0.0.1, found "
    "one that other machines can reach; put a proxy in front of the service (deploy/nginx.conf) and add "
    "--behind-proxy",
    "serve --token-file none": "--token-file none: expected a file with a token, found no such file",
    "app --host 192.0.2.1": "--host 192.0.2.1: expected an address of this computer, found another one; "
    "127.0.0.1 accepts this computer only, and 0.0.0.0 any computer that can reach it",
    "app --provider gpu": "--provider: expected one of cpu, cuda, tensorrt, openvino, coreml, directml, "
    "found 'gpu'",
    "live film.mkv --no-browser --port 0": f"film.mkv: {LIVE} no such file",
    "live 0 1 2 --no-browser --port 0": "expected one source with both views, or a left and a right source, "
    "found 3: 0 1 2",
    # Rendered sets, training, scores.
    "synth make castle --pairs 1 -o set": f"scene: expected one of {SCENES}, found 'castle'",
    "synth make ship --pairs 1 --size big -o set": "--size: expected width x height in pixels, such as "
    "640x480, found 'big'",
    "synth make ship --pairs 1 --rig -5 1 -o set": "--rig: focal_px: expected a number above 1e-09, found -5",
    "synth check boards": "boards/set.json: expected the description of a set made by stereoweave synth "
    "make, found no such file",
    "train none.toml -o run": "none.toml: expected a recipe in TOML, found no such file",
    "export huge -o huge.onnx": "huge: expected a run's folder, a checkpoint, an .onnx matcher file or a "
    "shipped network (base, small), found none of them",
    "export left.png -o left.onnx": "left.png: expected a checkpoint of `stereoweave train`, found another "
    "kind of file, or a damaged one",
    "export small -o small.pt": "small.pt: expected the file extension .onnx, found .pt",
    "bench pairs boards --plot plot.doc": f"plot.doc: expected a picture file extension ({PICTURE_ENDINGS}), "
    "found .doc",
}


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch) -> Path:
    write_error_examples(tmp_path)
    monkeypatch.chdir(tmp_path)
    shutil.copy("left.png", "my photo.png")
    with Image.open("left.png") as picture:
        picture.crop((0, 0, 300, 200)).save("small.png")
    Path("film.mp4").write_bytes(b"\0\0\0\x18ftypisom\0\0\0\0isom" + bytes(200))
    Path("photo.heic").write_bytes(b"\0\0\0\x18ftypheic\0\0\0\0mif1heic" + bytes(200))
    Path("wide.txt").write_text("left.png right.png a b c\n")
    Path("boards").mkdir()
    return tmp_path


@pytest.mark.parametrize("command", MISTAKES)
def test_a_mistake_is_answered_in_one_line_that_says_what_to_do(folder, capfd, command):
    before = sorted(folder.rglob("*"))
    assert main(shlex.split(command)) == 2
    assert capfd.readouterr().err == f"stereoweave: {MISTAKES[command]}\n"
    assert sorted(folder.rglob("*")) == before


@pytest.mark.parametrize(("name", "found"), [("boards", "neither"), ("none", "no such folder")])
def test_a_folder_without_scenes_may_be_a_dataset(folder, capfd, name, found):
    assert main(["bench", "pairs", name]) == 2
    assert capfd.readouterr().err == (
        f"stereoweave: {folder / name}: expected <scene>/left.png below it, or rendered sets, found {found}; "
        "if it is a dataset, give its name (--dataset)\n"
    )


def test_an_address_that_no_computer_has_is_not_mended_by_another_port(capfd):
    assert main(["app", "--host", "nowhere.invalid"]) == 2
    assert capfd.readouterr().err.startswith(
        "stereoweave: --host nowhere.invalid: expected an address of this computer, found another one; "
    )


@pytest.mark.parametrize("words", [["depth", "", ""], ["view", "left.png", ""], ["check", ""]])
def test_an_empty_word_is_an_error(words, capsys):
    assert main(words) == 2
    expected = "expected file names and values, found an empty one; is a variable unset?"
    assert capsys.readouterr().err == f"stereoweave: {expected}\n"
