import gc
import io
import itertools
import json
import pickle
import subprocess
import tarfile
from dataclasses import replace

import numpy as np
import pytest
import webdataset
from dataset_examples import cut, error_of
from PIL import Image
from shard_examples import assert_equal, box_before_a_wall, contents

from stereoweave.data.packing import pack, unpack, unpack_views
from stereoweave.data.readers import open_dataset
from stereoweave.data.shards import Shards, list_shards, write_shard


def pair(number):
    return box_before_a_wall(np.random.default_rng(number))


@pytest.fixture
def folder(tmp_path):
    """Write ten pairs in three shards, the last of which has two."""
    for first, count in ((0, 4), (4, 4), (8, 2)):
        write_shard(tmp_path, "ship", first, [pack(pair(first + i), {}) for i in range(count)])
    return tmp_path


# The files of a pair


def test_a_pair_comes_back_as_it_was(rng):
    sample = pair(1)
    assert_equal(unpack(pack(sample, {})), sample)


def test_a_disparity_of_0_is_known_and_nan_is_unknown():
    sample = pair(1)
    sample.disparity_px[5, :3] = np.nan, 0, 0.25
    found = unpack(pack(sample, {}))
    np.testing.assert_array_equal(found.disparity_px[5, :3], [np.nan, 0, 0.25])
    assert (found.disparity_px[0] == 0).all()


@pytest.mark.parametrize(
    ("most_px", "steps_per_px"), [(0.5, 1024), (63.9, 1024), (64, 512), (200, 256), (1000, 64)]
)
def test_disparity_is_rounded_to_the_finest_step_that_16_bits_hold(rng, most_px, steps_per_px):
    values_px = rng.uniform(0, most_px, (32, 48)).astype(np.float32)
    values_px[3, 4] = most_px
    files = pack(replace(pair(1), disparity_px=values_px), {})
    assert json.loads(files["camera.json"])["steps_per_px"] == steps_per_px
    error_px = np.abs(unpack(files).disparity_px - values_px).max()
    assert 0.4 / steps_per_px < error_px <= 0.5 / steps_per_px


def test_a_set_without_any_truth_can_be_kept():
    nothing = np.full((32, 48), np.nan, np.float32)
    sample = replace(pair(1), disparity_px=nothing, right_disparity_px=nothing, camera=None)
    assert_equal(unpack(pack(sample, {})), sample)


@pytest.mark.parametrize("value_px", [-0.1, 65535.0, np.inf])
def test_a_disparity_that_16_bits_cannot_hold_is_refused(value_px):
    sample = pair(1)
    sample.right_disparity_px[0, 0] = value_px
    assert f"{value_px:g}" in error_of(pack, sample, {})


def test_further_views_come_back_by_their_position():
    sample = pair(1)
    found = unpack_views(pack(sample, {-0.25: sample.left, 0.5: sample.right}))
    assert list(found) == [-0.25, 0.5]
    np.testing.assert_array_equal(found[0.5], sample.right)


# Shards


def test_pairs_are_read_by_index_across_shards(folder):
    pairs = Shards(folder)
    assert pairs.count == 10
    for index in (9, 0, 4, 3):
        assert_equal(pairs[index], pair(index))
    assert [pairs.name(index) for index in (0, 9)] == ["ship-000000", "ship-000009"]
    assert [shard.path.name for shard in list_shards(folder)] == [
        "ship-000000-000003.tar",
        "ship-000004-000007.tar",
        "ship-000008-000009.tar",
    ]


@pytest.mark.parametrize(
    ("damage", "found"),
    [
        ({"left.webp": b"RIFF"}, "left.webp: expected a picture"),
        ({"disparity.png": b"%!PS-Adobe-3.0 EPSF-3.0\n"}, "disparity.png: expected a picture"),
        ({"camera.json": b"[]"}, "found missing or damaged files in ship-000000"),
        ({"camera.json": b"{}"}, "steps_per_px"),
    ],
)
def test_a_damaged_file_of_a_pair_is_named_though_its_checksum_is_right(tmp_path, damage, found):
    write_shard(tmp_path, "ship", 0, [pack(pair(1), {}) | damage])
    message = error_of(Shards(tmp_path).__getitem__, 0)
    assert message.startswith(f"{tmp_path / 'ship-000000-000000.tar'}: expected all files of a pair")
    assert found in message


@pytest.mark.parametrize("index", [-1, 10])
def test_an_index_outside_of_the_set_is_an_index_error(folder, index):
    with pytest.raises(IndexError):
        Shards(folder)[index]


def test_shards_travel_to_other_processes(folder):
    pairs = Shards(folder)
    _ = pairs[0]
    assert_equal(pickle.loads(pickle.dumps(pairs))[7], pair(7))


def test_the_same_pairs_give_the_same_bytes(folder, tmp_path_factory):
    other = tmp_path_factory.mktemp("other")
    write_shard(other, "ship", 4, [pack(pair(4 + i), {}) for i in range(4)])
    assert contents(other) == {"ship-000004-000007.tar": (folder / "ship-000004-000007.tar").read_bytes()}


# webdataset leaves closing the files that it read to the garbage collector.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning", "ignore::ResourceWarning")
def test_webdataset_reads_the_shards(folder):
    urls = [str(shard.path) for shard in list_shards(folder)]
    read = list(webdataset.WebDataset(urls, shardshuffle=False))
    gc.collect()
    assert [found["__key__"] for found in read] == [f"ship-{number:06d}" for number in range(10)]
    left = np.array(Image.open(io.BytesIO(read[7]["left.webp"])))
    np.testing.assert_array_equal(left, pair(7).left)
    steps = np.array(Image.open(io.BytesIO(read[7]["disparity.png"])))
    np.testing.assert_array_equal(steps / 1024, pair(7).disparity_px)


def test_sha256sum_checks_an_unpacked_shard(folder, tmp_path_factory):
    place = tmp_path_factory.mktemp("unpacked")
    with tarfile.open(folder / "ship-000008-000009.tar") as tar:
        tar.extractall(place, filter="data")
    command = ["sha256sum", "--check", "ship-000008.sha256", "ship-000009.sha256"]
    done = subprocess.run(command, cwd=place, capture_output=True, text=True, check=True)
    # Two pictures, two disparity maps, two masks and the camera.
    assert done.stdout.count(": OK") == 2 * 7


def test_a_byte_that_changed_is_noticed_and_the_pair_named(folder):
    path = folder / "ship-000004-000007.tar"
    with tarfile.open(path) as tar:
        place = tar.getmember("ship-000006.right.webp").offset_data + 100
    content = bytearray(path.read_bytes())
    content[place] ^= 1
    path.write_bytes(content)
    message = error_of(Shards(folder).files, 6)
    assert message.startswith(f"{path}: expected ship-000006.right.webp to be intact, found it damaged")
    assert_equal(Shards(folder)[5], pair(5))


def test_a_shard_that_lost_its_end_is_noticed_and_named(folder):
    path = folder / "ship-000004-000007.tar"
    cut(path)
    assert str(path) in error_of(Shards(folder).files, 7)
    path.write_bytes(b"nothing")
    assert str(path) in error_of(Shards(folder).files, 7)


def png(values):
    stream = io.BytesIO()
    Image.fromarray(values).save(stream, "PNG")
    return stream.getvalue()


def facts(**changes):
    camera = {"focal_px": 60.0, "baseline_m": 0.2, "cx_px": 23.5, "cy_px": 15.5, "doffs_px": 0.0}
    return json.dumps({"steps_per_px": 1024, "camera": camera} | changes).encode()


@pytest.mark.parametrize(
    ("name", "content", "found"),
    [
        ("right.webp", None, "right.webp is missing"),
        ("camera.json", None, "camera.json is missing"),
        ("left.webp", b"no picture", "left.webp"),
        ("left.webp", b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 48 32\n", "left.webp"),
        ("left.webp", png(np.zeros((32, 48), np.uint8)), "left.webp has an unexpected data type"),
        ("disparity.png", png(np.zeros((32, 48), np.uint8)), "disparity.png has an unexpected data type"),
        (
            "disparity.png",
            png(np.zeros((32, 47), np.uint16)),
            "disparity.png: expected the same size as left.webp, found 47x32",
        ),
        (
            "occluded.png",
            png(np.zeros((31, 48), bool)),
            "occluded.png: expected the same size as left.webp, found 48x31",
        ),
        ("camera.json", b"[" * 5000, "recursion"),
        ("camera.json", b"[]", "camera.json"),
        ("camera.json", facts(steps_per_px=0), "camera.json"),
        ("camera.json", facts(steps_per_px="1"), "camera.json"),
        ("camera.json", facts(camera=3), "camera.json"),
        ("camera.json", facts(camera={"focal_px": 60.0}), "camera.json"),
        ("camera.json", facts(camera={"focal_mm": 6}), "camera.json"),
        ("camera.json", facts(camera=json.loads(facts())["camera"] | {"cx_px": "x"}), "camera.json"),
    ],
    ids=itertools.count(),
)
def test_a_pair_with_an_invalid_file_is_named_with_the_file(tmp_path, name, content, found):
    files = pack(pair(0), {}) | {name: content}
    write_shard(tmp_path, "ship", 0, [{end: made for end, made in files.items() if made is not None}])
    message = error_of(Shards(tmp_path).__getitem__, 0)
    assert message.startswith(f"{tmp_path / 'ship-000000-000000.tar'}: expected ")
    assert "ship-000000" in message
    assert found in message


def test_a_further_view_of_another_kind_is_named(tmp_path):
    write_shard(tmp_path, "ship", 0, [pack(pair(0), {}) | {"view_0.50.webp": b"no picture"}])
    assert "view_0.50.webp" in error_of(Shards(tmp_path).views, 0)


def test_a_name_in_a_shard_that_is_no_text_is_refused(tmp_path):
    write_shard(tmp_path, "ship", 0, [pack(pair(0), {})])
    path = tmp_path / "ship-000000-000000.tar"
    head = bytearray(path.read_bytes()[:512])
    place = head.index(b"camera.json")
    head[place] = 0xFF
    head[148:156] = b" " * 8
    head[148:156] = b"%06o\0 " % sum(head)
    path.write_bytes(head + path.read_bytes()[512:])
    assert str(path) in error_of(Shards(tmp_path).files, 0)


def test_a_shard_with_a_file_of_a_negative_size_is_refused(tmp_path):
    write_shard(tmp_path, "ship", 0, [pack(pair(0), {})])
    path = tmp_path / "ship-000000-000000.tar"
    head = bytearray(path.read_bytes()[:512])
    head[124:136] = b"\xff" * 10 + b"\xfe\x00"  # -512, after which the same header is read again
    head[148:156] = b" " * 8
    head[148:156] = b"%06o\0 " % sum(head)
    path.write_bytes(head + path.read_bytes()[512:])
    assert str(path) in error_of(Shards(tmp_path).files, 0)


def test_a_shard_that_is_missing_between_others_is_noticed(folder):
    (folder / "ship-000004-000007.tar").unlink()
    message = error_of(Shards, folder)
    assert "expected the next shard to start at pair 4" in message
    assert "found ship-000008-000009.tar" in message


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (
            "ship-000003-000005.tar",
            "expected no overlap with ship-000000-000003.tar, found pairs in both; delete it",
        ),
        ("towns-000004-000007.tar", "expected a shard of ship, found a shard of towns; move or delete it"),
    ],
)
def test_a_shard_too_many_is_named_with_what_to_do(folder, name, words):
    (folder / name).touch()
    assert error_of(Shards, folder, "ship").startswith(f"{folder / name}: {words}")
    assert error_of(list_shards, folder).startswith(f"{folder / name}: {words}")


def test_a_folder_without_shards_is_refused(tmp_path):
    (tmp_path / ".ship-000000-000003-12345678.tar").touch()
    assert str(tmp_path) in error_of(Shards, tmp_path)


# The order in which training reads


def test_an_order_has_every_pair_once_and_depends_on_the_random_numbers_alone(folder):
    pairs = Shards(folder)
    first, again, other = (pairs.order(np.random.default_rng(seed)).tolist() for seed in (1, 1, 2))
    assert first == again != other
    assert sorted(first) == list(range(10))


def test_an_order_goes_through_a_few_shards_at_a_time(tmp_path):
    for first in range(0, 128, 2):
        (tmp_path / f"ship-{first:06d}-{first + 1:06d}.tar").touch()
    order = Shards(tmp_path).order(np.random.default_rng(0))
    windows = (order // 2).reshape(-1, 16).tolist()
    # 8 shards of 2 pairs are read at a time.
    assert [len(set(window)) for window in windows] == [8] * 8
    assert max(windows[0]) > 8
    assert windows[0] != sorted(windows[0])


# As a dataset of a recipe


def test_a_folder_of_sets_is_a_dataset(folder, tmp_path_factory):
    root = tmp_path_factory.mktemp("sets")
    (root / "more" / "ship").mkdir(parents=True)
    for path in folder.iterdir():
        path.rename(root / "more" / "ship" / path.name)
    frames = open_dataset("shards", root)
    assert [frame.name for frame in frames] == [f"more/ship/ship-{number:06d}" for number in range(10)]
    assert_equal(pickle.loads(pickle.dumps(frames))[8].read(), pair(8))


def test_a_set_is_a_dataset(folder):
    assert [frame.name for frame in open_dataset("shards", folder)][:2] == ["ship-000000", "ship-000001"]
