import io
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from dataset_examples import error_of, read_frame
from rich.console import Console
from shard_examples import PaintedPairMaker, assert_equal, contents

from stereoweave.data.paper_layout import check_frame, write_frame
from stereoweave.data.readers import open_dataset
from stereoweave.data.shards import Shards
from stereoweave.errors import FormatError
from stereoweave.synth.rendering.effects import PLAIN
from stereoweave.synth.rendering.opengl import OpenGLRenderer
from stereoweave.synth.sets import make as making
from stereoweave.synth.sets.check import check_set
from stereoweave.synth.sets.make import PairRenderer, generator_version, make, read_set
from stereoweave.synth.sets.pair_rendering import RenderSpec

SPEC = RenderSpec(scene="pylon", seed=3, size_px=(48, 32), views=(0.5,))
PAIR_MAKER = PaintedPairMaker()
# Program of the process that is killed.
PROGRAM = """
import resource
from pathlib import Path
from shard_examples import PaintedPairMaker
from stereoweave.synth.sets import make as making
from stereoweave.synth.sets.pair_rendering import RenderSpec
if __name__ == "__main__":
    making.LAYOUTS["shards"] = making.LAYOUTS["shards"]._replace(pairs_a_run=4)
    making.generator_version = lambda: "01234567"
    {first}
    spec = RenderSpec(scene="pylon", seed=3, size_px=(48, 32), views=(0.5,))
    making.make(spec, 10, Path({out!r}), pair_maker={pair_maker})
"""


def prepare(patch):
    """Make small shards, and fix the generator's version so that edits to a scene do not change it."""
    patch.setitem(making.LAYOUTS, "shards", making.LAYOUTS["shards"]._replace(pairs_a_run=4))
    patch.setattr(making, "generator_version", lambda: "01234567")


@pytest.fixture(autouse=True)
def prepared(monkeypatch):
    prepare(monkeypatch)


def made(out, pairs=10, spec=SPEC, pair_maker=PAIR_MAKER, **options):
    return make(spec, pairs, out, pair_maker=pair_maker, console=Console(file=io.StringIO()), **options)


def start(folder, out, pair_maker="PaintedPairMaker()", first=""):
    """Start `made` in a separate process."""
    program = folder / "program.py"
    program.write_text(PROGRAM.format(out=str(out), pair_maker=pair_maker, first=first))
    root = Path(__file__).parents[3]
    paths = {"PYTHONPATH": f"{root}/tests/helpers:{root}", "PATH": "/usr/bin:/bin"}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen([sys.executable, program], **pipes, text=True, env=paths)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Return the folder of a set that two workers made without interruption."""
    out = tmp_path_factory.mktemp("finished")
    with pytest.MonkeyPatch.context() as patch:
        prepare(patch)
        assert made(out, jobs=2) == 10
    return out


def copied(finished, out):
    for name, content in contents(finished).items():
        (out / name).write_bytes(content)
    return out


# Making and resuming


def test_a_set_has_the_pairs_of_its_spec_by_number(finished):
    assert list(contents(finished)) == [
        "pylon-000000-000003.tar",
        "pylon-000004-000007.tar",
        "pylon-000008-000009.tar",
        "set.json",
    ]
    pairs = Shards(finished)
    for number in range(10):
        assert_equal(pairs[number], PAIR_MAKER(SPEC, number).sample)


def test_a_set_describes_itself(finished):
    assert read_set(finished) == {
        "format": 1,
        "layout": "shards",
        "scene": "pylon",
        "seed": 3,
        "size_px": [48, 32],
        "frames": 1,
        "views": [0.5],
        "rig": None,
        "generator": "01234567",
        "renderer": "paint",
        "pairs": 10,
    }


def test_a_killed_worker_is_a_one_line_error_and_the_same_call_resumes_to_the_same_bytes(finished, tmp_path):
    message = error_of(made, tmp_path, 10, SPEC, PaintedPairMaker(dies_at=6))
    assert "found one killed" in message
    assert message.endswith("all finished pairs are complete; rerun the same command to resume")
    assert sorted(contents(tmp_path)) == ["pylon-000000-000003.tar", "set.json"]
    # One worker makes this set; two made the set that it is compared with.
    assert made(tmp_path) == 6
    assert contents(tmp_path) == contents(finished)


def test_no_other_process_resumes_until_a_killed_one_and_its_workers_have_ended(finished, tmp_path):
    out = tmp_path / "set"
    first = start(tmp_path, out, pair_maker="PaintedPairMaker(halts_at=6)")
    try:
        os.waitpid(first.pid, os.WUNTRACED)
        text = "expected an output to which no other command is writing, found one that is in use"
        assert text in error_of(made, out)
    finally:
        first.kill()
        first.communicate()  # returns once its workers have ended too
    assert sorted(contents(out)) == [".lock", "pylon-000000-000003.tar", "set.json"]
    (out / ".pylon-000004-000007-0123abcd.tar").write_bytes(b"half a shard")
    assert made(out) == 6
    assert contents(out) == contents(finished)


def test_a_full_disk_is_a_one_line_error_and_leaves_no_partial_file(tmp_path):
    out = tmp_path / "set"
    # There is room for set.json but not for a shard, which raises the same OSError as a full disk does.
    full = start(tmp_path, out, first="resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))")
    message = full.communicate()[1].splitlines()[-1]
    assert "pylon-000000-000003.tar: expected a writable file, found file too large" in message
    assert message.endswith("all finished pairs are complete; rerun the same command to resume")
    assert sorted(contents(out)) == ["set.json"]


def test_adding_pairs_later_leaves_the_first_ones_unchanged(finished, tmp_path):
    copied(finished, tmp_path)
    assert made(tmp_path, 13) == 3
    after, before = contents(tmp_path), contents(finished)
    assert sorted(after.keys() - before.keys()) == ["pylon-000010-000011.tar", "pylon-000012-000012.tar"]
    assert all(after[name] == before[name] for name in before if name != "set.json")
    for number in (9, 10, 12):
        assert_equal(Shards(tmp_path)[number], PAIR_MAKER(SPEC, number).sample)


def test_asking_for_fewer_pairs_changes_nothing(finished, tmp_path):
    copied(finished, tmp_path)
    assert made(tmp_path, 3) == 0
    assert contents(tmp_path) == contents(finished)
    assert read_set(tmp_path)["pairs"] == 10


def test_a_damaged_shard_is_made_again_once_it_is_deleted(finished, tmp_path):
    copied(finished, tmp_path)
    shard = tmp_path / "pylon-000004-000007.tar"
    shard.write_bytes(b"damaged")
    assert error_of(Shards(tmp_path).files, 5).endswith(
        "delete it, and rerun the same `stereoweave synth make` command"
    )
    assert made(tmp_path) == 0
    shard.unlink()
    assert made(tmp_path) == 4
    assert contents(tmp_path) == contents(finished)


@pytest.mark.parametrize("name", ["pylon-000003-000005.tar", "crane-000000-000003.tar"])
def test_making_and_checking_report_a_surplus_shard_with_the_same_error(finished, tmp_path, name):
    copied(finished, tmp_path)
    (tmp_path / name).touch()
    messages = [error_of(made, tmp_path), error_of(check_set, tmp_path)]
    assert messages[0] == messages[1]
    assert messages[0].startswith(f"{tmp_path / name}: expected ")
    (tmp_path / name).unlink()
    assert made(tmp_path) == 0


def test_additional_views_are_kept(finished):
    ((position, image),) = Shards(finished).views(7).items()
    assert position == 0.5
    np.testing.assert_array_equal(image, PAIR_MAKER(SPEC, 7).sample.right)


# The paper's folders


def test_each_job_has_work_in_a_small_set_of_frames(tmp_path):
    spec = replace(SPEC, views=())
    made(tmp_path / "one", 6, spec, layout="paper")
    runs = making._split_into_runs(range(6), making.LAYOUTS["paper"].pairs_a_run)
    assert runs == [[0, 1, 2, 3], [4, 5]]
    made(tmp_path / "two", 6, spec, layout="paper", jobs=2)
    assert contents(tmp_path / "one") == contents(tmp_path / "two")


def test_making_the_paper_s_folders_resumes_after_a_kill_to_the_same_bytes(tmp_path):
    out, whole = tmp_path / "set", tmp_path / "whole"
    spec = replace(SPEC, views=())
    error_of(lambda: made(out, 6, spec, PaintedPairMaker(dies_at=5), layout="paper"))
    assert [frame.name for frame in open_dataset("paper", out)] == [f"pylon/{i:06d}" for i in range(5)]
    (out / "sums" / "pylon" / "000002.sha256").unlink()  # as if killed just before writing it
    (out / "depth" / "pylon" / "000002.png").unlink()
    (out / "left" / "pylon" / ".000005-0123abcd.png").touch()
    assert made(out, 6, spec, layout="paper") == 2
    for number in range(6):
        write_frame(whole, f"pylon/{number:06d}", PAIR_MAKER(SPEC, number).sample)
    found = contents(out)
    assert found.pop("set.json")
    assert found == contents(whole)


@pytest.fixture
def frame(tmp_path):
    sample = PAIR_MAKER(SPEC, 0).sample
    write_frame(tmp_path, "pylon/000000", sample)
    return tmp_path, sample


def test_a_frame_in_the_paper_s_folders_is_read_back_except_for_depths_beyond_15_m(frame):
    root, sample = frame
    found = read_frame("paper", root, "pylon/000000")
    expected = np.where(sample.disparity_px > 0, sample.disparity_px, np.nan)  # 3 px is 4 m, 0 px is the sky
    np.testing.assert_allclose(found.disparity_px, expected, rtol=1e-6)
    assert found.camera == sample.camera
    np.testing.assert_array_equal(found.right, sample.right)


def test_every_frame_may_have_its_own_camera(frame):
    root, sample = frame
    other = replace(sample.camera, focal_px=61.7, doffs_px=0.1)
    write_frame(root, "pylon/000001", replace(sample, camera=other))
    assert [frame.read().camera for frame in open_dataset("paper", root)] == [sample.camera, other]


def test_a_frame_is_on_the_disk_before_its_checksums_appear(tmp_path, monkeypatch):
    sums, at_each = tmp_path / "sums" / "pylon" / "000000.sha256", []
    monkeypatch.setattr("os.fsync", lambda file: at_each.append(sums.exists()))
    write_frame(tmp_path, "pylon/000000", PAIR_MAKER(SPEC, 0).sample)
    assert at_each == [False] * 4
    assert sums.exists()


@pytest.mark.parametrize("folder", ["left", "right", "depth", "calib"])
def test_a_damaged_or_missing_file_of_a_frame_is_named(frame, folder):
    root, _ = frame
    (path,) = (root / folder).rglob("000000.*")
    path.write_bytes(path.read_bytes() + b"\n")
    assert f"{folder}/pylon/000000" in error_of(check_frame, root, "pylon/000000")
    path.unlink()
    assert f"{folder}/pylon/000000" in error_of(check_frame, root, "pylon/000000")


def test_the_paper_s_folders_refuse_a_sample_without_a_camera(frame):
    root, sample = frame
    assert "camera" in error_of(write_frame, root, "pylon/000001", replace(sample, camera=None))


# Refused arguments and folders


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"spec": replace(SPEC, seed=4)}, "expected seed = 4 for this run, found 3"),
        ({"spec": replace(SPEC, size_px=(64, 32))}, "expected size_px = [64, 32]"),
        ({"spec": replace(SPEC, frames=2)}, "expected frames = 2"),
        ({"spec": replace(SPEC, views=(0.25,))}, "expected views = [0.25]"),
        ({"spec": replace(SPEC, scene="rooms")}, 'expected scene = "rooms"'),
        ({"spec": replace(SPEC, views=()), "layout": "paper"}, 'expected layout = "paper"'),
    ],
)
def test_a_folder_with_another_set_is_refused_and_left_unchanged(finished, changes, words):
    before = contents(finished)
    message = error_of(lambda: made(finished, **changes))
    assert words in message
    assert str(finished / "set.json") in message
    assert contents(finished) == before


def test_a_set_of_another_version_or_renderer_is_refused(finished, monkeypatch):
    monkeypatch.setattr(making, "generator_version", lambda: "89abcdef")
    assert 'expected generator = "89abcdef" for this run' in error_of(made, finished)
    prepare(monkeypatch)
    monkeypatch.setattr(PaintedPairMaker, "renderer", lambda self: "oil")
    assert 'expected renderer = "oil" for this run, found "paint"' in error_of(made, finished)


@pytest.mark.parametrize("text", ['{"format": 2, "layout": "shards"}', "[1]", "{"])
def test_a_description_of_another_format_is_refused(tmp_path, text):
    (tmp_path / "set.json").write_text(text)
    assert str(tmp_path / "set.json") in error_of(made, tmp_path)


@pytest.mark.parametrize(
    ("name", "value"),
    [("pairs", "3"), ("pairs", True), ("pairs", None), ("layout", []), ("layout", "zip"), ("scene", 7)],
)
def test_a_damaged_description_is_a_one_line_error(finished, tmp_path, name, value):
    facts = json.loads((finished / "set.json").read_text()) | {name: value}
    (tmp_path / "set.json").write_text(json.dumps(facts))
    message = error_of(read_set, tmp_path)
    assert message.startswith(f"{tmp_path / 'set.json'}: expected a layout (shards or paper), a scene")
    assert f"found {name} = {json.dumps(value)}; " in message


def test_a_folder_with_other_files_is_refused_and_left_unchanged(tmp_path):
    (tmp_path / "thesis.tex").write_text("mine")
    (tmp_path / ".set-0123abcd.json").touch()
    assert "found one with thesis.tex" in error_of(made, tmp_path)
    assert sorted(contents(tmp_path)) == [".set-0123abcd.json", "thesis.tex"]


def test_a_folder_that_cannot_be_written_is_refused(tmp_path):
    (tmp_path / "file").touch()
    assert "found a file" in error_of(made, tmp_path / "file")
    assert "not a directory" in error_of(made, tmp_path / "file" / "set")


@pytest.mark.parametrize(
    ("pairs", "changes", "words"),
    [
        (0, {}, "pairs: expected at least 1, found 0"),
        (-3, {}, "pairs: expected at least 1, found -3"),
        (1, {"spec": replace(SPEC, seed=-1)}, "seed: expected at least 0, found -1"),
        (1, {"spec": replace(SPEC, frames=0)}, "frames: expected at least 1, found 0"),
        (
            1,
            {"spec": replace(SPEC, size_px=(640, 0))},
            "size_px: expected 32 to 4096 px per side, found 640x0",
        ),
        (1, {"spec": replace(SPEC, size_px=(4097, 32))}, "size_px: expected 32 to 4096 px per side"),
        (1, {"spec": replace(SPEC, views=(0.5, 0.5))}, "views: expected different positions"),
        (
            1,
            {"spec": replace(SPEC, views=(0.125,))},
            "views: expected different positions of at most two dec",
        ),
        (1, {"spec": replace(SPEC, views=(float("nan"),))}, "views: expected positions from -1.0 "),
        (1, {"spec": replace(SPEC, views=(0.5, 2.1))}, "views: expected positions from -1.0 "),
        (1, {"layout": "paper"}, "views: expected no additional views"),
        (1, {"layout": "zip"}, "layout: expected one of shards, paper, found 'zip'"),
    ],
)
def test_invalid_arguments_are_refused_before_the_folder_is_created(tmp_path, pairs, changes, words):
    assert error_of(lambda: made(tmp_path / "set", pairs, **changes)).startswith(words)
    assert not (tmp_path / "set").exists()


def test_a_folder_without_a_description_is_not_a_set(tmp_path):
    with pytest.raises(
        FormatError, match=r"set.json: expected the description of a set .* found no such file"
    ):
        read_set(tmp_path)


# The generator's version


def test_the_version_depends_on_the_sources_that_make_pairs_and_on_no_others(tmp_path, monkeypatch):
    monkeypatch.undo()
    drawn = ("synth/scenes/ship.py", "synth/rendering/shaders/shade.frag", "data/poses.py")
    changed = (*drawn, "data/packing.py", "data/samples.py", "stereo.py")
    files = [tmp_path / name for name in ("synth/sets/make.py", "data/paper_layout.py", *changed)]
    for file in files:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("as it was")
    monkeypatch.setattr(making, "__file__", str(files[0]))
    versions = [generator_version()]
    for file in files:
        file.write_text("changed")
        versions.append(generator_version())
    assert versions[0] == versions[1]
    assert len(set(versions)) == len(files)
    monkeypatch.setattr(making, "version", lambda package: "1" if package == "pillow" else "0")
    pillow = generator_version()
    monkeypatch.setattr(making, "version", lambda package: "0")
    assert generator_version() != pillow


@pytest.mark.needs_egl
def test_the_renderer_s_name_contains_the_opengl_driver(monkeypatch):
    monkeypatch.setenv("LP_NUM_THREADS", "1")
    renderer = OpenGLRenderer(PLAIN)
    name = renderer.name
    renderer.close()
    assert "OpenGL" in name
    assert PairRenderer(plain=True).renderer() == f"{name}, plain"
