import re
import subprocess
import sys
from functools import partial
from pathlib import Path

import moderngl
import pytest
from dataset_examples import error_of
from shard_examples import contents

from stereoweave.cli.root import main
from stereoweave.cli.synth import SCENE_NAMES
from stereoweave.data.poses import read_poses
from stereoweave.data.readers import open_dataset
from stereoweave.data.shards import Shards
from stereoweave.synth.rendering.gpu_buffers import FrameBuffers
from stereoweave.synth.scenes import SCENES
from stereoweave.synth.sets.contact_sheet import contact_sheet, quiz_sheet
from stereoweave.synth.sets.effect_costs import measure_effect_costs
from stereoweave.synth.sets.renderers import shared_renderer


def run(line: str) -> int:
    return main(line.split())


# Making and checking sets, as users do


@pytest.fixture(scope="module")
def words(tmp_path_factory):
    """Make a set. Returns the command line, which ends with the folder of the set."""
    out = tmp_path_factory.mktemp("made") / "set"
    line = f"synth make pylon --pairs 2 --seed 1 --size 160x120 --plain --view 0.5 --jobs 1 -o {out}"
    assert run(line) == 0
    return line


@pytest.mark.needs_egl
def test_a_set_is_made_once(words, capsys):
    out = Path(words.split()[-1])
    before = contents(out)
    assert run(words) == 0
    assert f"{out}: 0 pairs made, 2 already there" in capsys.readouterr().out
    assert contents(out) == before
    assert Shards(out)[1].left.shape == (120, 160, 3)
    assert list(Shards(out).views(1)) == [0.5]


@pytest.mark.needs_egl
def test_a_set_by_world_has_a_video_of_each_world_and_passes_the_check(tmp_path, capsys):
    out = tmp_path / "set"
    line = f"synth make ship --worlds 2 --frames 2 --size 160x120 --plain --layout paper --jobs 1 -o {out}"
    assert run(line) == 0
    assert f"{out}: 4 pairs made, 0 already there" in capsys.readouterr().out
    names = [f"ship/{world}/00000{frame}" for world in ("000", "001") for frame in (0, 1)]
    assert [frame.name for frame in open_dataset("paper_worlds", out)] == names
    assert list(read_poses(out)) == names
    assert run(f"synth check {out} --jobs 1") == 0


@pytest.mark.needs_egl
def test_a_valid_set_passes_the_check_and_a_damaged_one_exits_with_1(words, capsys):
    out = Path(words.split()[-1])
    assert run(f"synth check {out} --jobs 1") == 0
    told = capsys.readouterr().out
    assert "disparity, px" in told
    assert told.endswith("\nno problems\n")
    shard = out / "pylon-000000-000001.tar"
    content = shard.read_bytes()
    shard.write_bytes(content[:2000] + b"?" + content[2001:])
    assert run(f"synth check {out} --jobs 1") == 1
    shard.write_bytes(content)
    told = capsys.readouterr().out
    assert f"{shard}: expected pylon-000000." in told
    assert told.endswith("rerun the same `stereoweave synth make` command\n1 problem\n")


@pytest.mark.needs_egl
def test_a_sheet_has_a_row_of_five_pictures_for_each_scene(capsys):
    picture = contact_sheet(shared_renderer(plain=True), ["pylon", "rooms"], seed=0)
    assert picture.shape == (20 + 2 * (20 + 240), 5 * 320, 3)
    assert "2/2" in capsys.readouterr().out
    tiles = picture[40:280].reshape(240, 5, 320, 3)
    assert all(tiles[:, column].std() > 5 for column in range(5))
    # Pixels that only one camera sees are orange; nothing else in the last two columns has a colour.
    assert (tiles[:, 3].max(axis=2) != tiles[:, 3].min(axis=2)).mean() < 0.5


@pytest.mark.needs_egl
def test_a_quiz_shows_every_scene_and_prints_the_answers_by_place():
    picture, answers = quiz_sheet(shared_renderer(plain=True), ["pylon", "rooms"], seed=2, pictures=6)
    assert picture.shape == (2 * 240, 4 * 320, 3)
    assert sorted(answers) == ["pylon"] * 3 + ["rooms"] * 3
    assert answers != sorted(answers)
    assert not picture[240:, 640:].any()


@pytest.mark.needs_egl
def test_the_costs_of_the_effects_are_printed_in_milliseconds(monkeypatch, capsys):
    monkeypatch.setenv("LP_NUM_THREADS", "1")
    monkeypatch.setattr(
        "stereoweave.synth.sets.effect_costs.measure_effect_costs",
        partial(measure_effect_costs, size_px=(64, 48)),
    )
    assert run("synth costs pylon --pairs 1") == 0
    told = [re.fullmatch(r" *(-?\d+) ms  (.+)", line) for line in capsys.readouterr().out.splitlines()]
    assert [found[2] for found in told] == [
        "everything",
        "shadows",
        "ambient occlusion",
        "gloss",
        "fog",
        "relief",
        "2x2 samples",
        "none (plain)",
    ]
    assert int(told[0][1]) > int(told[-1][1]) > 0


# Mistakes are reported in one line, with exit code 2


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("synth make cathedral --pairs 1 -o set", "scene: expected one of "),
        ("synth make pylon --pairs 0 -o set", "expected at least 1"),
        (
            "synth make pylon -o set",
            "--pairs: expected a number of pairs, or of worlds with --frames pairs each, ",
        ),
        ("synth make pylon --frames 5 -o set", "pairs each, found neither"),
        ("synth make pylon --pairs 6 --worlds 2 -o set", "pairs each, found both"),
        ("synth make pylon --worlds 0 -o set", "expected at least 1"),
        ("synth make pylon --pairs -5 -o set", "expected at least 1"),
        ("synth make pylon --pairs 1 --seed -1 -o set", "expected at least 0"),
        ("synth make pylon --pairs 1 --frames 0 -o set", "expected at least 1"),
        ("synth make pylon --pairs 1 --size 640 -o set", "--size: expected width x height"),
        (
            "synth make pylon --pairs 1 --size 640x10 -o set",
            "--size: expected 32 to 4096 px per side, found 640x10",
        ),
        ("synth make pylon --pairs 1 --size 99999x32 -o set", "--size: expected 32 to 4096 px per side"),
        ("synth make pylon --pairs 1 --size ６４x４８ -o set", "--size: expected width x height"),
        ("synth make pylon --pairs 1 --view 2.1 -o set", "--view: expected positions from -1.0 to 2.0 "),
        ("synth make pylon --pairs 1 --view 0.5 --view 0.5 -o set", "--view: expected different positions"),
        ("synth make pylon --pairs 1 --rig 0 0.2 -o set", "focal_px: expected a number above 1e-09, found 0"),
        ("synth make pylon --pairs 1 --layout zip -o set", "--layout: expected one of shards, paper"),
        ("synth make pylon --pairs 1 -o file/set", "file/set: expected a writable folder"),
        ("synth costs cathedral", "scene: expected one of "),
        ("synth check set", "set/set.json: expected the description of a set"),
        ("synth sheet -o sheet.doc", "sheet.doc: expected a picture file extension"),
    ],
)
def test_a_mistake_is_reported_in_one_line(tmp_path, monkeypatch, capsys, line, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    assert run(line) == 2
    told = capsys.readouterr()
    assert words in told.err
    assert told.err.count("\n") == 1
    assert told.out == ""
    assert list(contents(tmp_path)) == ["file"]


@pytest.mark.needs_egl
def test_a_cluster_that_does_not_answer_is_reported_in_one_line(tmp_path, capsys):
    line = f"synth make pylon --pairs 1 --size 48x32 --plain -o {tmp_path} --cluster 127.0.0.1:1"
    assert run(line) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert "127.0.0.1:1: expected the head of a Ray cluster, found " in told.err
    assert told.err.endswith("; all finished pairs are complete; rerun the same command to resume\n")
    assert told.err.count("\n") == 1


def test_the_help_names_every_scene(capsys):
    assert list(SCENE_NAMES) == list(SCENES)
    assert run("synth make --help") == 0
    told = capsys.readouterr().out
    assert all(name in told for name in SCENES)


def test_costs_of_an_unknown_scene_are_refused_before_a_renderer_starts(monkeypatch, capsys):
    monkeypatch.setenv("LP_NUM_THREADS", "1")
    monkeypatch.setattr("stereoweave.synth.sets.effect_costs.OpenGLRenderer", None)
    assert run("synth costs cathedral") == 2
    assert "scene: expected one of" in capsys.readouterr().err


@pytest.mark.needs_egl
def test_too_little_opengl_memory_is_reported_in_one_line():
    gl = moderngl.create_context(standalone=True, backend="egl")
    message = error_of(FrameBuffers, gl, (100_000, 32), 2)
    assert message.startswith("pictures of 100000x32 px: expected enough OpenGL memory, found too little (")
    gl.release()


def test_without_the_extra_the_error_names_it(tmp_path):
    program = (
        "import sys; sys.modules['skimage'] = None; from stereoweave.cli.root import main; "
        "sys.exit(main(['synth', 'make', 'pylon', '--pairs', '1', '-o', 'set']))"
    )
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "install the extra 'synth'" in done.stderr


def test_the_help_of_the_commands_imports_nothing_heavy():
    program = (
        "import sys, stereoweave.cli.root; "
        "print({'numpy', 'cv2', 'moderngl', 'trimesh', 'skimage'} & sys.modules.keys())"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
