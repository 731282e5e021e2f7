import csv
import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import onnx
import pytest
from command_output import without_steps
from onnx import TensorProto, helper
from PIL import Image

import stereoweave
from stereoweave.bench.opencv_matchers import OPENCV_MATCHERS
from stereoweave.cli.options import find_allowed_hosts, listen
from stereoweave.cli.root import main
from stereoweave.io.images import read_image
from stereoweave.io.maps import read_disparity_png, read_pfm

REPOSITORY = Path(__file__).resolve().parents[2]
TEXTURED = Path(__file__).resolve().parents[1] / "textured_pair"
RECIPE = REPOSITORY / "recipes" / "weave_small.toml"
CALIBRATION = "cam0=[100 0 48; 0 100 32; 0 0 1]\ndoffs=0\nbaseline=80\nwidth=96\nheight=64\n"


def run(line: str) -> int:
    return main(line.split())


def save_matcher(
    path: Path,
    disparity_px: float,
    *,
    size=("height", "width"),
    inputs=TensorProto.FLOAT,
    shrunk=1,
    keepdims=1,
    multiple_of="1",
) -> None:
    """Write a matcher file that finds one disparity everywhere; the options make it invalid."""
    image = ["batch", 3, *size]
    constants = {"zero": 0.0, "disparity": disparity_px}
    graph = helper.make_graph(
        [
            helper.make_node("Cast", ["left"], ["wide"], to=TensorProto.FLOAT),
            helper.make_node("MaxPool", ["wide"], ["pooled"], kernel_shape=[1, 1], strides=[shrunk, shrunk]),
            helper.make_node("ReduceMean", ["pooled"], ["grey"], axes=[1], keepdims=keepdims),
            helper.make_node("Mul", ["grey", "zero"], ["zeros"]),
            helper.make_node("Add", ["zeros", "disparity"], ["disparity_px"]),
        ],
        "constant",
        [helper.make_tensor_value_info(side, inputs, image) for side in ("left", "right")],
        [helper.make_tensor_value_info("disparity_px", TensorProto.FLOAT, None)],
        [helper.make_tensor(name, TensorProto.FLOAT, [], [value]) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    facts = {"name": "constant", "multiple_of": multiple_of, "max_disparity_px": "192"}
    helper.set_model_props(model, {f"stereoweave.{key}": value for key, value in facts.items()})
    onnx.save(model, path)


def save_identity(path: Path) -> None:
    """Write a valid ONNX file that is not a matcher."""
    x, y = (helper.make_tensor_value_info(name, TensorProto.FLOAT, [1]) for name in "xy")
    graph = helper.make_graph([helper.make_node("Identity", ["x"], ["y"])], "identity", [x], [y])
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8), path)


def truncate(source: Path, target: Path) -> None:
    target.write_bytes(source.read_bytes()[: source.stat().st_size // 2])


@pytest.fixture
def pictures(rng, tmp_path, monkeypatch) -> Path:
    """Write a pair of 96x64 and its calibration to the current folder."""
    monkeypatch.chdir(tmp_path)
    photograph = Image.fromarray(rng.integers(0, 256, (8, 13, 3), dtype=np.uint8)).resize((104, 64))
    left, right = photograph.crop((0, 0, 96, 64)), photograph.crop((8, 0, 104, 64))
    left.save("left.png")
    right.save("right.png")
    Image.fromarray(np.hstack([left, right])).save("both.png")
    Path("calib.txt").write_text(CALIBRATION)
    return tmp_path


@pytest.fixture
def mistakes(pictures) -> Path:
    """Add all kinds of invalid inputs to the folder of `pictures`."""
    left = Image.open("left.png")
    left.save("left.jpg")
    left.crop((0, 0, 80, 64)).save("narrow.png")
    left.crop((0, 0, 31, 64)).save("tiny.png")
    truncate(Path("left.png"), Path("half.png"))
    truncate(Path("left.jpg"), Path("half.jpg"))
    truncate(Path("calib.txt"), Path("half.txt"))
    Path("words.png").write_text("these are words")
    Path("words.onnx").write_text("these are words")
    Path("folder").mkdir()
    Path("wrong.txt").write_text(CALIBRATION.replace("width=96", "width=960"))
    save_identity(Path("identity.onnx"))
    save_matcher(Path("nan.onnx"), float("nan"))
    save_matcher(Path("fixed.onnx"), 4.0, size=(32, "w"))
    save_matcher(Path("float16.onnx"), 4.0, inputs=TensorProto.FLOAT16)
    save_matcher(Path("rank3.onnx"), 4.0, keepdims=0)
    save_matcher(Path("quarter.onnx"), 4.0, shrunk=4)
    save_matcher(Path("zero.onnx"), 4.0, multiple_of="0")
    save_matcher(Path("abc.onnx"), 4.0, multiple_of="abc")
    save_matcher(Path("sgbm.onnx"), 4.0)
    Path("taken/depth.png").mkdir(parents=True)
    Path("taken.png").mkdir()
    Path("scenes/wall").mkdir(parents=True)
    for name in ("left.png", "right.png"):
        Path("scenes/wall", name).write_bytes(Path(name).read_bytes())
    Image.fromarray(np.full((64, 96), 8 * 256, np.uint16)).save("scenes/wall/disparity.png")
    return pictures


@pytest.mark.parametrize(
    ("arguments", "fragments"),
    [
        ("depth none.png right.png -o out", ["none.png", "no such file"]),
        ("view left.png none.png -o out.png", ["none.png", "no such file"]),
        ("depth folder right.png -o out", ["folder", "expected a picture"]),
        ("depth words.png right.png -o out", ["words.png", "expected a picture"]),
        ("depth half.png right.png -o out", ["half.png", "expected a picture", "truncated"]),
        ("depth left.png half.jpg -o out", ["half.jpg", "expected a picture", "truncated"]),
        (
            "depth left.png narrow.png -o out",
            ["left.png with 96x64", "narrow.png with 80x64 pixels", "the same size"],
        ),
        ("depth tiny.png tiny.png -o out", ["tiny.png", "at least 32x32", "found 31x64"]),
        (
            "depth tiny.png --format side_by_side -o out",
            ["tiny.png", "a width of at least 64", "found 31x64"],
        ),
        ("depth left.png right.png both.png -o out", ["two pictures, left and right", "found 3", "both.png"]),
        ("view left.png right.png both.png left.png -o out.png", ["two pictures, left and right", "found 4"]),
        (
            "depth left.png right.png --calib half.txt -o out",
            ["half.txt", "expected a calibration of two cameras", "no entry"],
        ),
        ("depth left.png right.png --calib none.txt -o out", ["none.txt", "no such file"]),
        ("depth left.png right.png --calib wrong.txt -o out", ["wrong.txt", "96x64", "960x64"]),
        (
            "depth left.png right.png -o calib.txt/out",
            ["calib.txt", "expected a writable folder", "found a file"],
        ),
        (
            "depth left.png right.png -o calib.txt",
            ["calib.txt", "expected a writable folder", "found a file"],
        ),
        (
            "view left.png right.png -o calib.txt/out.png",
            ["calib.txt", "expected a writable folder", "found a file"],
        ),
        ("view left.png right.png -o out.words", ["out.words", "expected a picture file extension"]),
        ("view left.png right.png -o folder", ["folder", "expected"]),
        ("view left.png right.png --position 7 -o out.png", ["position", "-1", "2", "7"]),
        ("view left.png right.png --position nan -o out.png", ["position", "-1", "2", "nan"]),
        ("depth left.png right.png --model large -o out", ["large", "small"]),
        ("depth left.png right.png --model none.onnx -o out", ["none.onnx", "no such file"]),
        (
            "depth left.png right.png --model identity.onnx -o out",
            ["identity.onnx", "expected", "left", "found"],
        ),
        ("depth left.png right.png --model words.onnx -o out", ["words.onnx", "expected"]),
        (
            "view left.png right.png --model nan.onnx -o out.png",
            ["nan.onnx", "disparity_px", "expected finite", "NaN"],
        ),
        (
            "depth left.png right.png --model nan.onnx -o out",
            ["nan.onnx", "disparity_px", "expected finite", "NaN"],
        ),
        ("depth left.png right.png --model fixed.onnx -o out", ["fixed.onnx", "expected", "ONNX Runtime"]),
        ("depth left.png right.png --model float16.onnx -o out", ["float16.onnx", "left tensor(float16)"]),
        (
            "depth left.png right.png --model rank3.onnx -o out",
            ["rank3.onnx", "[1, 1, 64, 96]", "[1, 64, 96]"],
        ),
        ("view both.png --model quarter.onnx -o out.png", ["quarter.onnx", "disparity_px", "[1, 1, 16, 24]"]),
        ("depth left.png right.png --model zero.onnx -o out", ["zero.onnx", "multiple_of '0'"]),
        ("depth left.png right.png --model abc.onnx -o out", ["abc.onnx", "multiple_of 'abc'"]),
        (
            "depth left.png right.png -o taken",
            ["taken/depth.png", "expected a writable file", "found a folder"],
        ),
        ("view left.png right.png -o taken.png", ["taken.png", "expected a writable file", "found a folder"]),
        ("bench pairs scenes --model sgbm.onnx -o rows.csv", ["sgbm.onnx", "rename"]),
        ("depth left.png right.png --threads 0 -o out", ["--threads"]),
        ("bench pairs folder -o out.csv", ["folder", "left.png"]),
        ("train none.toml -o out", ["none.toml"]),
        ("export folder -o out.onnx", ["folder"]),
        ("dept left.png right.png -o out", ["dept", "depth"]),
    ],
)
def test_a_mistake_is_reported_in_one_line_and_leaves_nothing_behind(mistakes, capfd, arguments, fragments):
    before = sorted(mistakes.rglob("*"))
    assert run(arguments) == 2
    printed, told = capfd.readouterr()
    assert printed == ""
    (line,) = without_steps(told)
    assert line.startswith("stereoweave: ")
    assert [fragment for fragment in fragments if fragment not in line] == []
    assert sorted(mistakes.rglob("*")) == before


@pytest.mark.parametrize(
    "options", ["--position 7 -o out.png", "-o out.words", "-o taken.png", "-o calib.txt/a.png"]
)
def test_view_finds_mistakes_of_its_own_before_it_matches(mistakes, capfd, options):
    assert run(f"view left.png right.png --model nan.onnx {options}") == 2
    assert "nan.onnx" not in capfd.readouterr().err


def test_a_programming_error_is_not_reported_as_a_mistake_of_the_user(pictures, monkeypatch):
    name = "stereoweave.matching.matcher.Matcher.estimate_many"
    monkeypatch.setattr(name, lambda *_, **__: int("our own"))
    with pytest.raises(ValueError, match="our own"):
        run("depth left.png right.png -o out")


def test_the_installed_command_reports_a_mistake_in_one_line(mistakes):
    command = [Path(sys.executable).with_name("stereoweave"), "depth", "half.png", "right.png", "-o", "out"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stdout == ""
    assert len(done.stderr.splitlines()) == 1
    assert "half.png" in done.stderr


def test_the_name_alone_shows_the_help(capsys):
    assert main([]) == 0
    told = capsys.readouterr()
    assert told.out.startswith("Usage: stereoweave [OPTIONS] COMMAND") and told.err == ""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_stopped_command_says_so_and_leaves_nothing(tmp_path, number):
    pictures = [REPOSITORY / "examples" / f"{eye}.png" for eye in ("left", "right")]
    program = (
        # As in a terminal: a shell that starts the tests in the background lets them ignore Ctrl-C.
        "import faulthandler, signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
        "signal.signal(signal.SIGHUP, signal.SIG_DFL); faulthandler.dump_traceback_later(120, exit=True); "
        "from stereoweave.cli.root import main; sys.exit(main())"
    )
    command = [sys.executable, "-c", program, "depth", *pictures, "--model", "small", "-o", tmp_path / "out"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    while not any(tmp_path.glob(".stereoweave-*/*")) and process.poll() is None:
        time.sleep(0.01)
    assert process.poll() is None
    process.send_signal(number)
    told = process.communicate()[1]
    assert told.splitlines()[-1] == "stereoweave: stopped", told
    assert process.returncode == 128 + number
    assert [path for path in tmp_path.rglob("*") if path.name.startswith(".stereoweave-")] == []


@pytest.mark.parametrize("kind", ["grey", "grey of 16 bits", "RGBA"])
def test_pictures_of_other_kinds_work(pictures, kind):
    left = Image.open("left.png")
    if kind == "grey of 16 bits":
        left = Image.fromarray(np.asarray(left.convert("L")).astype(np.uint16) * 257)
    else:
        left = left.convert({"grey": "L", "RGBA": "RGBA"}[kind])
    left.save("other.png")
    assert run("view other.png other.png -o view.png") == 0
    assert read_image("view.png").shape == (64, 96, 3)


def test_depth_writes_what_the_matcher_finds(pictures):
    assert run("depth left.png right.png --model small --calib calib.txt -o new/out") == 0
    names = [
        "confidence.png",
        "depth.png",
        "disparity.pfm",
        "disparity.png",
        "occluded.png",
        "preview.png",
        "report.html",
    ]
    assert sorted(file.name for file in Path("new/out").iterdir()) == names
    estimate = stereoweave.estimate(read_image("left.png"), read_image("right.png"))
    disparity_px = read_pfm("new/out/disparity.pfm")
    np.testing.assert_array_equal(disparity_px, estimate.disparity_px)
    np.testing.assert_allclose(
        np.asarray(Image.open("new/out/disparity.png")) / 256, disparity_px, atol=1 / 256
    )
    confidence = np.asarray(Image.open("new/out/confidence.png"))
    np.testing.assert_allclose(confidence / 255, estimate.confidence, atol=0.5 / 255 + 1e-6)
    assert read_image("new/out/preview.png").shape == (64, 96, 3)


def test_depth_png_is_in_millimetres(pictures):
    save_matcher(Path("eight.onnx"), 8.0)
    assert run("depth left.png right.png --model eight.onnx --calib calib.txt -o out") == 0
    # 100 px * 0.08 m / 8 px = 1 m
    assert np.median(np.asarray(Image.open("out/depth.png"))) == 1000


@pytest.mark.parametrize(
    ("arguments", "out"),
    [
        ("left.png right.png", "left_depth"),
        ("both.png --format side_by_side", "both_depth"),
        ("scenes", "scenes_depth/wall"),
        ("--left scenes/*/left.png --right scenes/*/right.png", "scenes_depth/wall"),
        ("--left left*.png --right right*.png", "depth/{here}"),
        ("--list my.pairs.txt", "my.pairs_depth/{here}"),
    ],
)
def test_without_out_the_results_are_named_after_what_was_given(mistakes, arguments, out):
    Path("my.pairs.txt").write_text("left.png right.png\n")
    save_matcher(Path("eight.onnx"), 8.0)
    assert run(f"depth {arguments} --model eight.onnx --jobs 1") == 0
    assert (mistakes / out.format(here=mistakes.name) / "disparity.pfm").is_file()


def test_without_out_the_results_of_the_current_folder_are_named_after_it(mistakes, monkeypatch):
    save_matcher(Path("eight.onnx"), 8.0)
    monkeypatch.chdir("scenes")
    assert run("depth . --model ../eight.onnx --jobs 1") == 0
    assert Path("scenes_depth/wall/disparity.pfm").is_file()


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ("", "left_view.png"),
        ("--layout crossed", "left_crossed_RLF_cross.png"),
        ("--layout wiggle", "left_wiggle.webp"),
    ],
)
def test_without_out_a_view_is_named_after_the_left_picture(pictures, options, name):
    save_matcher(Path("eight.onnx"), 8.0)
    assert run(f"view left.png right.png --model eight.onnx {options}") == 0
    assert Path(name).is_file()


def test_the_words_after_depth_are_the_range_of_most_pixels_in_pixels_and_metres_and_the_files(
    pictures, capfd
):
    save_matcher(Path("eight.onnx"), 8.0)
    assert run("depth left.png right.png --raw --model eight.onnx --calib calib.txt -o out") == 0
    printed = capfd.readouterr().out.splitlines()
    # 100 px * 0.08 m / 8 px = 1 m
    assert "disparity 8.0 to 8.0 px, depth 1.00 m to 1.00 m (the middle 98 % of the pixels)" in printed
    files = "disparity.pfm, disparity.png, depth.png, preview.png, confidence.png, occluded.png, report.html"
    assert printed[-2:] == [f"files: {files}", "report: out/report.html"]


def test_a_side_by_side_picture_gives_the_same_as_the_two(pictures):
    assert run("depth left.png right.png -o two") == 0
    assert run("depth both.png -o one") == 0
    np.testing.assert_array_equal(read_pfm("one/disparity.pfm"), read_pfm("two/disparity.pfm"))


def test_stdout_is_only_json_that_names_the_files(pictures, capfd):
    save_matcher(Path("eight.onnx"), 8.0)
    assert run("depth left.png right.png --model eight.onnx --calib calib.txt -o out --json") == 0
    printed, told = capfd.readouterr()
    summary = json.loads(printed)
    assert without_steps(told) == []
    assert summary["pictures"] == ["left.png", "right.png"]
    assert (summary["model"], summary["width_px"], summary["height_px"]) == ("eight.onnx", 96, 64)
    assert 7 < summary["disparity_min_px"] <= 8 <= summary["disparity_max_px"] < 9
    assert (summary["disparity_median_px"], summary["depth_median_m"]) == (8, 1)
    assert summary["camera"]["baseline_m"] == 0.08
    assert all(Path(file).is_file() for file in summary["files"].values())
    assert len(summary["files"]) == 7
    assert summary["notes"] == []


@pytest.mark.parametrize("command", ["depth", "depth --json", "view"])
def test_problems_of_a_pair_are_printed(pictures, capfd, command):
    Image.new("RGB", (96, 64)).save("black.png")
    assert (
        run(f"{command} black.png black.png --threads 1 -o {'out.png' if command == 'view' else 'out'}") == 0
    )
    printed, told = capfd.readouterr()
    assert without_steps(told) == []
    notes = json.loads(printed)["notes"] if "--json" in command else printed.splitlines()
    assert [note for note in notes if note.startswith("only 0 % of the disparities are confident")] != []


@pytest.mark.parametrize("disparity_px", [-3.0, 300.0])
def test_a_disparity_that_a_png_cannot_hold_gets_a_note_instead_of_a_png(pictures, capfd, disparity_px):
    save_matcher(Path("far.onnx"), disparity_px)
    assert run("depth left.png right.png --model far.onnx -o out") == 0
    printed, _ = capfd.readouterr()
    text = "no disparity.png: expected disparities of 0 to 255.99 px"
    (note,) = [line for line in printed.splitlines() if text in line]
    assert " px; disparity_scaled.png was written in its place, with px = value / 256 " in note
    assert not Path("out/disparity.png").exists()
    # The photographs do not show this disparity, so refinement moves it by at most 1 px.
    np.testing.assert_allclose(read_pfm("out/disparity.pfm"), disparity_px, atol=1.001)
    scaled_px = read_disparity_png("out/disparity_scaled.png")
    np.testing.assert_allclose(scaled_px, read_pfm("out/disparity.pfm"), atol=0.5 / 256)
    assert "disparity_scaled.png" in printed.splitlines()[-2]


def test_a_new_result_replaces_the_old_one_completely(pictures):
    assert run("depth left.png right.png --calib calib.txt -o out") == 0
    Path("out/mine.txt").write_text("kept")
    assert run("depth left.png right.png -o out") == 0
    assert not Path("out/depth.png").exists()
    assert Path("out/mine.txt").read_text() == "kept"


def test_view_writes_the_image_that_synthesize_renders(pictures):
    assert run("view left.png right.png --position 0.25 -o view.png") == 0
    left, right = read_image("left.png"), read_image("right.png")
    view = stereoweave.synthesize(left, right, position=0.25)
    np.testing.assert_array_equal(read_image("view.png"), view.image)


def test_bench_scores_the_network_beside_sgbm(pictures, capfd):
    scene = Path("scenes/wall")
    scene.mkdir(parents=True)
    for name in ("left.png", "right.png"):
        Path(name).rename(scene / name)
    truth = np.full((64, 96), 6 * 256, np.uint16)
    truth[:, :8] = 0  # unknown, because the right photograph does not show it
    Image.fromarray(truth).save(scene / "disparity.png")
    save_matcher(Path("eight.onnx"), 8.0)
    assert run("bench pairs scenes --model eight.onnx -o rows.csv") == 0
    with Path("rows.csv").open() as file:
        rows = {(row["matcher"], row["scene"]): row for row in csv.DictReader(file)}
    assert set(rows) == {
        (name, scene)
        for name in (*OPENCV_MATCHERS, "eight.onnx", "eight.onnx refined")
        for scene in ("wall", "mean")
    }
    # 8 px is found, as in the photographs; 6 px is given as the truth
    assert float(rows["eight.onnx", "wall"]["epe_px"]) == pytest.approx(2, abs=1e-3)
    assert "eight.onnx" in capfd.readouterr().out


def test_bench_scores_every_shipped_network_and_names_the_file_of_the_rows(mistakes, capfd):
    assert run("bench pairs scenes") == 0
    with Path("pairs.csv").open() as file:
        networks = {"base", "small", "small refined"}  # base always refines
        assert {row["matcher"] for row in csv.DictReader(file)} == {*OPENCV_MATCHERS, *networks}
    assert capfd.readouterr().out.endswith("rows: pairs.csv\n")


def test_depth_of_a_large_picture_takes_less_than_a_gigabyte_and_a_half(tmp_path):
    for side in ("left.png", "right.png"):
        Image.open(TEXTURED / side).resize((1920, 1080)).save(tmp_path / side)
    # In a process whose only child is the command, because Linux counts a parent's memory as its child's.
    program = (
        "import resource, subprocess, sys; subprocess.run(sys.argv[1:], check=True); "
        "print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)"
    )
    command = [Path(sys.executable).with_name("stereoweave"), "depth", "left.png", "right.png", "-o", "out"]
    done = subprocess.run(
        [sys.executable, "-c", program, *command], capture_output=True, text=True, check=True, cwd=tmp_path
    )
    unit_bytes = 1 if sys.platform == "darwin" else 1024
    peak_bytes = unit_bytes * int(done.stdout.splitlines()[-1])
    assert 0.1e9 < peak_bytes < 1.5e9


def test_training_without_pytorch_names_the_extra(tmp_path):
    program = (
        "import sys; sys.modules['torch'] = None; from stereoweave.cli.root import main; "
        f"sys.exit(main(['train', {str(RECIPE)!r}, '-o', 'run']))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False, cwd=tmp_path
    )
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert "PyTorch" in done.stderr
    assert 'from your wheel or your copy of the source: pip install "stereoweave[train]"' in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_help_loads_nothing_heavy():
    program = (
        "import sys; from stereoweave.cli.root import main; main(['--help']); "
        "sys.exit(str({'numpy', 'cv2', 'numba', 'onnxruntime', 'torch', 'PIL', 'rich'} & sys.modules.keys()))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert "depth" in done.stdout
    assert done.stderr.strip() == "set()"


def test_version_is_the_package_version(capfd):
    assert run("--version") == 0
    assert capfd.readouterr().out == f"stereoweave {stereoweave.__version__}\n"


@pytest.fixture
def network_run(tmp_path, monkeypatch):
    """Write an untrained network, `run`, and its two held-out pairs to the current folder."""
    from learn_examples import checkpoint_of, keep_pairs, recipe_of, untrained

    from stereoweave.learn.checkpoint import save
    from stereoweave.learn.data.sources import VALIDATION_SEED

    monkeypatch.chdir(tmp_path)
    recipe = recipe_of("fast_depth")
    Path("run").mkdir()
    save(checkpoint_of(untrained("fast_depth"), recipe), Path("run/last.pt"))
    for seed, count in ((recipe.seed, recipe.pairs), (VALIDATION_SEED, recipe.validation_pairs)):
        keep_pairs(Path("pairs"), seed, count)
    return tmp_path


def read_rows(file):
    with Path(file).open() as stream:
        return list(csv.DictReader(stream))


def test_bench_networks_scores_a_run_beside_untrained_methods(network_run, capfd):
    assert run("bench networks run -o new/rows.csv") == 0
    rows = {row["method"]: row for row in read_rows("new/rows.csv")}
    assert list(rows) == ["ground truth", "no warping", "sgbm", "median", "run"]
    # A quarter of the held-out pixels are at 12 px, the others at 4 px.
    assert (float(rows["no warping"]["epe_px"]), float(rows["median"]["epe_px"])) == (6, 2)
    assert "cpu" in rows["run"]
    printed = capfd.readouterr().out
    assert "Means over the held-out pairs" in printed
    assert all(name.split()[0] in printed for name in rows)
    # Names are wrapped in a narrow terminal, not cut, because runs differ at the end of their names.
    assert "…" not in printed
    assert printed.endswith("rows: new/rows.csv\n")


def test_bench_networks_accepts_a_checkpoint_and_a_folder_of_pairs(network_run):
    assert run("bench networks run -o beside.csv") == 0
    Path("pairs").rename("kept")
    Path("run/last.pt").rename("run/run.pt")
    assert run("bench networks run/run.pt --pairs kept -o told.csv") == 0
    assert read_rows("told.csv") == read_rows("beside.csv")
    assert list(network_run.rglob("pairs")) == []


@pytest.mark.parametrize(
    ("arguments", "fragments"),
    [
        ("bench networks folder -o rows.csv", ["folder/last.pt", "no such checkpoint"]),
        ("bench networks nowhere -o rows.csv", ["nowhere: no such checkpoint"]),
        ("bench networks here here -o rows.csv", ["here", "unique name"]),
        ("bench networks folder -o taken.png", ["taken.png", "expected a writable file", "found a folder"]),
        ("bench networks", ["RUN..."]),
    ],
)
def test_a_mistake_with_bench_networks_is_reported_in_one_line(mistakes, capfd, arguments, fragments):
    before = sorted(mistakes.rglob("*"))
    assert run(arguments) == 2
    printed, told = capfd.readouterr()
    assert printed == ""
    (line,) = without_steps(told)
    assert line.startswith("stereoweave: ")
    assert [fragment for fragment in fragments if fragment not in line] == []
    assert sorted(mistakes.rglob("*")) == before


@pytest.mark.parametrize(
    "line",
    [
        "depth {left} {right} -o {link}",
        "depth {folder} -o {link}",
        "view {left} {right} -o {link}/view.png",
        "view {left} {right} --layout wiggle -o {link}/view.webp",
        "rectify {left} {right} -o {link}",
        "bench pairs {folder} -o {link}/rows.csv",
        "video {folder} {folder} --depth -o {link}/depth.mp4",
        "batch {folder} {link}",
    ],
)
def test_a_broken_link_is_refused_as_an_output(tmp_path, capsys, line):
    link = tmp_path / "link"
    link.symlink_to(tmp_path / "nowhere")
    places = {"left": TEXTURED / "left.png", "right": TEXTURED / "right.png", "folder": TEXTURED}
    assert run(line.format(**places, link=link)) == 2
    told = capsys.readouterr().err.splitlines()
    expected = "expected a writable folder, found a broken link; choose another place for the output"
    assert told[-1] == f"stereoweave: {link}: {expected}"
    assert not (tmp_path / "nowhere").exists()


@pytest.mark.parametrize(
    ("address", "host", "names"),
    [
        ("127.0.0.1", "127.0.0.1", ("127.0.0.1", "localhost")),
        ("127.0.1.1", "Debian", ("127.0.1.1", "localhost", "debian")),
        ("::1", "0:0::1", ("[::1]", "localhost", "[0:0::1]")),
        ("0.0.0.0", "0.0.0.0", None),
    ],
)
def test_the_allowed_hosts_are_the_address_of_the_listener_and_the_given_name(address, host, names):
    with listen(address, 0) as listener:
        assert find_allowed_hosts(listener, host) == names
