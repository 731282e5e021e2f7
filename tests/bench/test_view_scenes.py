import json

import numpy as np
import pytest
from shard_examples import box_before_a_wall

from stereoweave.bench.view_scenes import read_view_scenes
from stereoweave.data.packing import pack
from stereoweave.data.shards import write_shard
from stereoweave.errors import FormatError, StereoweaveError
from stereoweave.io.images import write_image
from stereoweave.io.maps import write_disparity_png, write_pfm

SIZE = (48, 64, 3)


def picture(number, size=SIZE):
    return np.random.default_rng(number).integers(0, 256, size, np.uint8)


@pytest.fixture
def scene(tmp_path):
    """Write the smallest scene of photographs: a pair and a picture from halfway."""
    for number, name in enumerate(("left", "right", "view_0.5")):
        write_image(tmp_path / "shed" / f"{name}.png", picture(number))
    return tmp_path / "shed"


def test_photographs_alone_have_no_disparity_and_no_offset(scene):
    (found,) = read_view_scenes(scene.parent)
    assert found.name == "shed"
    for number, image in enumerate((found.sample.left, found.sample.right, found.views[0].image)):
        np.testing.assert_array_equal(image, picture(number))
    assert np.isnan(found.sample.disparity_px).all()
    assert np.isnan(found.sample.right_disparity_px).all()
    assert [(view.position, view.offset_px) for view in found.views] == [(0.5, (0, 0))]


def test_views_are_sorted_by_position_and_know_their_offsets(scene):
    for number, position in ((3, "0.75"), (4, "-0.25"), (5, "1.5")):
        write_image(scene / f"view_{position}.png", picture(number))
    card = {"name": "shed", "offset_px": {"0.75": [0.2, -1], "0.50": [1, 2], "0.1": [9, 9]}}
    (scene / "scene.json").write_text(json.dumps(card))
    (found,) = read_view_scenes(scene.parent)
    places = [(view.position, view.offset_px) for view in found.views]
    assert places == [(-0.25, (0, 0)), (0.5, (1, 2)), (0.75, (0.2, -1)), (1.5, (0, 0))]
    np.testing.assert_array_equal(found.views[0].image, picture(4))


def test_disparity_comes_from_either_kind_of_file(scene):
    left_px, right_px = np.full(SIZE[:2], 3.5, np.float32), np.full(SIZE[:2], 7.25, np.float32)
    left_px[5, 6] = np.nan
    right_px[7, 8] = np.inf
    write_disparity_png(scene / "disparity.png", left_px)
    write_pfm(scene / "right_disparity.pfm", right_px)
    (found,) = read_view_scenes(scene.parent)
    np.testing.assert_array_equal(found.sample.disparity_px, left_px)
    right_px[7, 8] = np.nan
    np.testing.assert_array_equal(found.sample.right_disparity_px, right_px)


def test_the_pairs_of_rendered_sets_below_a_folder_are_scenes_with_their_views(tmp_path):
    samples = [box_before_a_wall(np.random.default_rng(number)) for number in range(3)]
    views = [{0.75: sample.right, 0.25: sample.left} for sample in samples]
    files = [pack(sample, taken) for sample, taken in zip(samples, views, strict=True)]
    write_shard(tmp_path / "far" / "ship", "ship", 0, files[:2])
    write_shard(tmp_path / "crane", "crane", 0, files[2:])
    scenes = list(read_view_scenes(tmp_path))
    assert [scene.name for scene in scenes] == [
        "crane/crane-000000", "far/ship/ship-000000", "far/ship/ship-000001",
    ]  # fmt: skip
    for scene, sample in zip(scenes, [samples[2], *samples[:2]], strict=True):
        np.testing.assert_array_equal(scene.sample.left, sample.left)
        np.testing.assert_allclose(scene.sample.right_disparity_px, sample.right_disparity_px, atol=0.001)
        assert [view.position for view in scene.views] == [0.25, 0.75]
        np.testing.assert_array_equal(scene.views[0].image, sample.left)
    assert [scene.name for scene in read_view_scenes(tmp_path / "crane")] == ["crane-000000"]


def test_a_folder_without_scenes_is_refused(tmp_path):
    with pytest.raises(StereoweaveError, match="expected subfolders with left.png, or rendered sets, found"):
        read_view_scenes(tmp_path)


def test_a_set_without_views_is_named(tmp_path):
    write_shard(tmp_path, "ship", 0, [pack(box_before_a_wall(np.random.default_rng(0)), {})])
    with pytest.raises(
        FormatError,
        match="further views of every pair, found none for ship-000000; render a set with further",
    ):
        next(read_view_scenes(tmp_path))


def test_a_scene_without_further_photographs_is_named(scene):
    (scene / "view_0.5.png").unlink()
    with pytest.raises(FormatError, match=r"shed: expected .* view_0\.5\.png, found no view_\*\.png"):
        next(read_view_scenes(scene.parent))


@pytest.mark.parametrize("position", ["half", "", "nan", "2.5"])
def test_a_position_that_no_view_can_have_is_named(scene, position):
    write_image(scene / f"view_{position}.png", picture(3))
    with pytest.raises(FormatError, match=rf"a position from -1 to 2 .*, found '{position}'"):
        next(read_view_scenes(scene.parent))


def test_a_view_of_another_size_is_named(scene):
    write_image(scene / "view_0.5.png", picture(3, (48, 60, 3)))
    with pytest.raises(FormatError, match=r"view_0\.5\.png: expected 64x48 pixels, .*, found 60x48"):
        next(read_view_scenes(scene.parent))


def test_a_disparity_of_another_size_is_named(scene):
    write_pfm(scene / "right_disparity.pfm", np.ones((40, 64), np.float32))
    with pytest.raises(FormatError, match=r"right_disparity\.pfm: expected 64x48 pixels, .*, found 64x40"):
        next(read_view_scenes(scene.parent))


@pytest.mark.parametrize(
    "text",
    [
        "{",
        "[]",
        '{"offset_px": [1]}',
        '{"offset_px": {"0.5": [1]}}',
        '{"offset_px": {"0.5": ["a", null]}}',
        "[" * 60_000,
    ],
)
def test_malformed_offsets_are_refused(scene, text):
    (scene / "scene.json").write_text(text)
    with pytest.raises(FormatError, match=r'scene\.json: expected JSON whose "offset_px" is') as told:
        next(read_view_scenes(scene.parent))
    assert "\n" not in str(told.value)
