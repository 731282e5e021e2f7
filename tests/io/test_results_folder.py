import shutil

import pytest

from stereoweave.errors import StereoweaveError
from stereoweave.io.results_folder import replacing_together

NAMES = ("map.pfm", "map.png", "notes.json")


def write_result(out, files, marks=NAMES[:2]):
    with replacing_together(out, NAMES, tuple(files), marks) as folder:
        for name, text in files.items():
            (folder / name).write_text(text)


def read_all(out):
    return {path.name: path.read_text() for path in out.iterdir()}


def test_a_result_replaces_all_files_of_an_earlier_one(tmp_path):
    out = tmp_path / "out"
    write_result(out, {"map.pfm": "1", "map.png": "1", "notes.json": "1"})
    (out / "own.txt").write_text("kept")
    write_result(out, {"map.pfm": "2", "map.png": "2"})
    assert read_all(out) == {"map.pfm": "2", "map.png": "2", "own.txt": "kept"}


def test_an_error_leaves_the_folder_as_it_was(tmp_path):
    out = tmp_path / "out"
    write_result(out, {"map.pfm": "1", "map.png": "1"})
    with (
        pytest.raises(OSError, match="disk full"),
        replacing_together(out, NAMES, NAMES[:2], NAMES[:2]) as folder,
    ):
        (folder / "map.pfm").write_text("2")
        raise OSError("disk full")
    assert read_all(out) == {"map.pfm": "1", "map.png": "1"}
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_a_users_own_files_beside_no_earlier_result_are_kept(tmp_path):
    (tmp_path / "notes.json").write_text("own")
    write_result(tmp_path, {"map.pfm": "1"})
    assert read_all(tmp_path) == {"map.pfm": "1", "notes.json": "own"}


def test_a_users_own_file_that_a_result_left_alone_is_kept_by_the_next_one_too(tmp_path):
    (tmp_path / "notes.json").write_text("own")
    for text in ("1", "2"):
        write_result(tmp_path, {"map.pfm": text, "map.png": text})
    assert read_all(tmp_path) == {"map.pfm": "2", "map.png": "2", "notes.json": "own"}
    with pytest.raises(StereoweaveError, match="notes.json: expected no file, or one of an earlier result"):
        write_result(tmp_path, {"map.pfm": "3", "map.png": "3", "notes.json": "3"})
    assert read_all(tmp_path) == {"map.pfm": "2", "map.png": "2", "notes.json": "own"}


def test_a_copied_result_is_recognised_if_the_copy_keeps_its_times(tmp_path):
    write_result(tmp_path / "out", {"map.pfm": "1", "map.png": "1"})
    copied = shutil.copytree(tmp_path / "out", tmp_path / "copied")
    write_result(copied, {"map.pfm": "2", "map.png": "2"})
    assert read_all(copied) == {"map.pfm": "2", "map.png": "2"}


@pytest.mark.parametrize("name", ["map.pfm", "map.png"])
def test_a_users_own_file_is_not_replaced(tmp_path, name):
    (tmp_path / name).write_text("own")
    with pytest.raises(StereoweaveError) as caught:
        write_result(tmp_path, {"map.pfm": "1", "map.png": "1"})
    assert str(caught.value) == (
        f"{tmp_path / name}: expected no file, or one of an earlier result, found a file of another origin; "
        "choose another folder (out)"
    )
    assert read_all(tmp_path) == {name: "own"}


def test_a_result_is_recognised_by_its_first_mark_and_one_of_the_others(tmp_path):
    write_result(tmp_path, {"map.pfm": "1", "map.png": "1", "notes.json": "1"}, marks=NAMES)
    (tmp_path / "map.png").unlink()
    write_result(tmp_path, {"map.pfm": "2"}, marks=NAMES)
    assert read_all(tmp_path) == {"map.pfm": "2"}


def test_in_a_folder_of_results_alone_all_their_files_are_replaced(tmp_path):
    (tmp_path / "map.png").write_text("1")
    write_result(tmp_path, {"map.pfm": "2"}, marks=())
    assert read_all(tmp_path) == {"map.pfm": "2"}
