import numpy as np
import pytest
from picture_examples import refusal_of

from stereoweave.errors import StereoweaveError
from stereoweave.io import files, images, maps


@pytest.fixture
def picture():
    """Return an image that is smooth, so that JPEG keeps it, and differs in every channel and direction."""
    y, x = np.mgrid[:40, :48]
    return np.stack([5 * x, 6 * y, 255 - 2 * x - 2 * y], axis=-1).astype(np.uint8)


def test_a_file_gets_its_name_only_when_it_is_complete(tmp_path):
    target = tmp_path / "out.txt"
    target.write_text("old")
    with files.replacing(target) as temporary:
        temporary.write_text("new")
        assert target.read_text() == "old"
        assert (temporary.parent, temporary.suffix) == (tmp_path, ".txt")
    assert target.read_text() == "new"
    assert list(tmp_path.iterdir()) == [target]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_an_error_leaves_the_earlier_file_and_nothing_else(tmp_path, error):
    target = tmp_path / "out.txt"
    target.write_text("old")
    with pytest.raises(error), files.replacing(target) as temporary:
        temporary.write_text("half")
        raise error
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


# 255 bytes are the most.
@pytest.mark.parametrize("stem", ["a" * 251, "\N{CAMERA}" * 62], ids=["letters", "wide"])
def test_the_longest_names_can_be_written(tmp_path, stem):
    with files.replacing(tmp_path / f"{stem}.png") as temporary:
        temporary.write_text("new")
        assert files.is_leftover(temporary)
    assert [path.stem for path in tmp_path.iterdir()] == [stem]


def test_a_name_that_is_too_long_is_a_one_line_error(tmp_path):
    for name in ("a" * 300, f"a.{'b' * 300}"):
        with (
            pytest.raises(StereoweaveError, match="expected a writable file, found file name too long$"),
            files.replacing(tmp_path / name) as temporary,
        ):
            temporary.write_text("new")
    assert list(tmp_path.iterdir()) == []


def test_a_written_file_has_the_usual_permissions(tmp_path, picture):
    (tmp_path / "plain").touch()
    images.write_image(tmp_path / "picture.png", picture)
    assert (tmp_path / "picture.png").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_missing_folders_are_made(tmp_path, picture):
    images.write_image(tmp_path / "new" / "folder" / "picture.png", picture)
    assert (tmp_path / "new" / "folder" / "picture.png").exists()


@pytest.mark.parametrize("folder", ["occupied", "occupied/below"])
def test_an_output_folder_that_is_a_file_is_named(tmp_path, picture, folder):
    (tmp_path / "occupied").write_text("a file")
    for function, arguments in [
        (files.make_folder, ()),
        (images.write_image, (picture,)),
        (maps.write_pfm, (np.zeros((2, 2)),)),
    ]:
        target = tmp_path / folder / "out.png" if arguments else tmp_path / folder
        with pytest.raises(StereoweaveError) as caught:
            function(target, *arguments)
        assert str(caught.value).startswith(f"{tmp_path / folder}: expected a writable folder, found")
        assert "\n" not in str(caught.value)
    assert (tmp_path / "occupied").read_text() == "a file"


def test_an_output_that_is_a_folder_is_named(tmp_path, picture):
    (tmp_path / "out.png").mkdir()
    message = refusal_of(images.write_image, tmp_path / "out.png", picture, kind=StereoweaveError)
    assert message.endswith("found a folder")
    assert list(tmp_path.iterdir()) == [tmp_path / "out.png"]


def test_a_folder_is_made_and_left_empty(tmp_path):
    folder = files.make_folder(tmp_path / "new" / "folder")
    assert folder == tmp_path / "new" / "folder"
    assert list(folder.iterdir()) == []
