"""Parts of an unfinished video: kept after an error, continued with the same settings, then removed."""

import json
from pathlib import Path

import numpy as np
import pytest
from full_disks import disk_with_room

from stereoweave.errors import StereoweaveError
from stereoweave.video.parts import Parts, open_parts, parts_folder


def test_the_parts_are_removed_when_the_video_is_finished(tmp_path):
    video = tmp_path / "video.mp4"
    with open_parts(video, {"position": 0.5}) as parts:
        add(parts, b"first", 1)
        assert parts_folder(video) == tmp_path / "video.mp4.parts"
        assert parts_folder(video).is_dir()
    assert list(tmp_path.iterdir()) == []


def test_other_files_in_the_folder_of_parts_are_kept(tmp_path):
    video = tmp_path / "video.mp4"
    parts_folder(video).mkdir()
    (parts_folder(video) / "notes.txt").write_text("mine")
    with open_parts(video, {}) as parts:
        add(parts, b"first", 1)
    assert [path.name for path in parts_folder(video).iterdir()] == ["notes.txt"]


def test_an_error_before_the_first_part_leaves_nothing(tmp_path):
    with pytest.raises(ZeroDivisionError), open_parts(tmp_path / "video.mp4", {}) as parts:
        break_off(parts, ZeroDivisionError())
    assert list(tmp_path.iterdir()) == []


def test_an_error_keeps_the_finished_parts_and_the_latest_state(tmp_path):
    video = tmp_path / "video.mp4"
    told = r"^no picture; finished parts are in .*video\.mp4\.parts; rerun the same command to resume$"
    with pytest.raises(StereoweaveError, match=told), open_parts(video, {"position": 0.5}) as parts:
        add(parts, b"first", 1)
        add(parts, b"second", 2)
        break_off(parts, StereoweaveError("no picture"))
    with open_parts(video, {"position": 0.5}) as parts:
        assert [file.read_bytes() for file in parts.files] == [b"first", b"second"]
        assert parts.state() == {"frames": 2}
        assert sorted(path.name for path in parts.folder.iterdir()) == [
            "000001.nut",
            "000002.nut",
            "settings.json",
            "state-000002.npz",
        ]


def test_parts_without_a_state_are_discarded(tmp_path):
    video = tmp_path / "video.mp4"
    with pytest.raises(KeyboardInterrupt), open_parts(video, {}) as parts:
        add(parts, b"first", 1)
        add(parts, b"second", 2)
        raise KeyboardInterrupt
    (parts_folder(video) / "state-000002.npz").unlink()
    with open_parts(video, {}) as parts:
        assert parts.files == []
        assert [path.name for path in parts.folder.iterdir()] == ["settings.json"]


def test_parts_of_another_video_are_not_continued(tmp_path):
    video = tmp_path / "video.mp4"
    with pytest.raises(KeyboardInterrupt), open_parts(video, {"position": 0.5, "model": "small"}) as parts:
        add(parts, b"first", 1)
        raise KeyboardInterrupt
    with (
        pytest.raises(
            StereoweaveError, match=r"found parts made with position 0\.5; remove this folder, or rerun"
        ),
        open_parts(video, {"position": 0.25, "model": "small"}),
    ):
        pass
    assert json.loads((tmp_path / "video.mp4.parts" / "settings.json").read_text())["position"] == 0.5


def test_parts_made_with_a_setting_that_is_now_unset_are_not_continued(tmp_path):
    begin(tmp_path / "video.mp4", {"position": 0.5, "look": "30,0"})
    with (
        pytest.raises(StereoweaveError, match=r"found parts made with look 30,0; remove this folder"),
        open_parts(tmp_path / "video.mp4", {"position": 0.5}),
    ):
        pass


@pytest.mark.parametrize("name", ["settings.json", "state-000001.npz"])
@pytest.mark.parametrize("content", [b"", b"[1, 2", b"PK\x03\x04 no archive"])
def test_the_remedy_for_damaged_parts_is_to_remove_their_folder(tmp_path, name, content):
    folder = begin(tmp_path / "video.mp4")
    (folder / name).write_bytes(content)
    assert_to_be_removed(tmp_path / "video.mp4", name)


def test_the_remedy_for_parts_without_settings_is_to_remove_their_folder(tmp_path):
    folder = begin(tmp_path / "video.mp4")
    (folder / "settings.json").unlink()
    assert_to_be_removed(tmp_path / "video.mp4", "settings.json")


def test_a_disk_that_is_full_from_the_start_is_reported_in_one_line_with_the_file(tmp_path):
    told = r"settings\.json: expected a writable file, found file too large$"
    with (
        pytest.raises(StereoweaveError, match=told),
        disk_with_room(1),
        open_parts(tmp_path / "video.mp4", {"position": 0.5}),
    ):
        pass
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("value", "told"),
    [(True, "with x"), (False, "without x"), (None, "without x"), (0.5, "with x 0.5")],
)
def test_the_settings_of_existing_parts_are_named_as_users_write_them(tmp_path, value, told):
    video = tmp_path / "video.mp4"
    begin(video, {"x": value})
    with (
        pytest.raises(StereoweaveError, match=f"found parts made {told}; "),
        open_parts(video, {"x": "else"}),
    ):
        pass


def begin(video: Path, settings: dict[str, object] | None = None) -> Path:
    """Interrupt a video after one part and return the folder of its parts."""
    with pytest.raises(KeyboardInterrupt), open_parts(video, settings or {}) as parts:
        add(parts, b"first", 1)
        raise KeyboardInterrupt
    return parts_folder(video)


def assert_to_be_removed(video: Path, name: str) -> None:
    with pytest.raises(StereoweaveError) as caught, open_parts(video, {}):
        pass
    folder = parts_folder(video)
    assert str(caught.value).startswith(f"{folder / name}: expected")
    assert str(caught.value).endswith(f"remove the folder {folder}")
    assert (folder / "000001.nut").exists()


def add(parts: Parts, content: bytes, frames: int) -> None:
    with parts.next(lambda: {"frames": np.array(frames)}) as path:
        path.write_bytes(content)


def break_off(parts: Parts, error: Exception) -> None:
    with parts.next(dict) as path:
        path.write_bytes(b"half")
        raise error
