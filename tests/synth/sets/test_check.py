import io
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console
from shard_examples import CAMERA, box_before_a_wall

from stereoweave.data.packing import pack, unpack
from stereoweave.data.paper_layout import write_frame
from stereoweave.data.samples import make_sample
from stereoweave.data.shards import write_shard
from stereoweave.stereo import StereoPair
from stereoweave.synth.sets.check import check_set, find_problem, report_lines
from stereoweave.synth.sets.pair_rendering import RenderSpec, render_pair
from stereoweave.synth.sets.renderers import shared_renderer

FACTS = '{"format": 1, "layout": "LAYOUT", "scene": "pylon", "pairs": 3}'
SCENES_IN_SMALL = ("propeller", "ship", "refinery", "pylon", "wind_turbine")


@pytest.fixture
def sample(rng):
    return box_before_a_wall(rng)


@pytest.fixture(params=["shards", "paper"])
def folder(request, tmp_path):
    """Return the folder of a set of three pairs, in each layout."""
    (tmp_path / "set.json").write_text(FACTS.replace("LAYOUT", request.param))
    samples = [box_before_a_wall(np.random.default_rng(number)) for number in range(3)]
    if request.param == "shards":
        write_shard(tmp_path, "pylon", 0, [pack(sample, {}) for sample in samples])
    else:
        for number, sample in enumerate(samples):
            write_frame(tmp_path, f"pylon/{number:06d}", sample)
    return tmp_path


def checked(folder):
    return check_set(folder, console=Console(file=io.StringIO()))


# One pair


def test_a_correct_pair_has_no_problem(sample):
    assert find_problem(sample) is None


@pytest.mark.parametrize("shift_px", [-1, 1, 5])
def test_a_disparity_that_is_off_by_a_pixel_is_a_problem(sample, shift_px):
    shifted = {name: getattr(sample, name) + shift_px for name in ("disparity_px", "right_disparity_px")}
    assert "expected the images to differ least at the disparity" in find_problem(replace(sample, **shifted))


def test_swapped_images_are_a_problem(sample):
    assert "expected the images to differ least" in find_problem(
        replace(sample, left=sample.right, right=sample.left)
    )


def test_disparities_that_disagree_are_a_problem(sample):
    wrong_px = np.where(sample.right_disparity_px > 0, sample.right_disparity_px + 0.1, 0).astype(np.float32)
    message = find_problem(replace(sample, right_disparity_px=wrong_px))
    assert message.startswith("expected the two disparities to agree at 95% or more of")


def test_a_pair_without_truth_is_a_problem(sample):
    nothing = np.full_like(sample.disparity_px, np.nan)
    assert "expected known disparities, found none" in find_problem(replace(sample, disparity_px=nothing))


def test_a_pair_without_near_surfaces_has_no_problem(sample):
    far_px = np.full_like(sample.disparity_px, 0.5)
    assert find_problem(replace(sample, disparity_px=far_px, right_disparity_px=far_px)) is None


def test_a_slope_with_a_crease_agrees_with_itself_but_not_with_a_wrong_disparity():
    # The crease lies between two columns of the other view, so neither column has its disparity.
    width = 48
    left_px = np.broadcast_to(4 + 0.1 * np.abs(np.arange(width) - 24.5), (32, width)).astype(np.float32)
    places = np.arange(width) - left_px[0]
    right_px = np.interp(np.arange(width), places, left_px[0])
    right_px = np.broadcast_to(right_px, (32, width)).astype(np.float32)
    pair = StereoPair(left=np.zeros((32, width, 3), np.uint8), right=np.zeros((32, width, 3), np.uint8))
    crease = make_sample(replace(pair, camera=CAMERA), left_px, right_px)
    assert find_problem(crease) is None
    off = replace(crease, right_disparity_px=right_px + np.float32(0.2))
    assert "the two disparities to agree" in find_problem(off)


# Small rendered pairs


@pytest.fixture(scope="module")
def rendered_pairs():
    """Return pairs of five scenes at 160x120 and of two of them at 64x48, as read from the disk."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LP_NUM_THREADS", "1")
        renderer = shared_renderer(plain=True)
    orders = [RenderSpec(scene=scene, size_px=(160, 120)) for scene in SCENES_IN_SMALL]
    orders += [RenderSpec(scene=scene, size_px=(64, 48)) for scene in SCENES_IN_SMALL[:2]]
    return [unpack(pack(render_pair(renderer, spec, 0).sample, {})) for spec in orders]


def shifted(sample, shift_px):
    names = ("disparity_px", "right_disparity_px")
    return replace(sample, **{name: getattr(sample, name) + np.float32(shift_px) for name in names})


@pytest.mark.needs_egl
def test_rendered_pairs_of_all_sizes_have_no_problem(rendered_pairs):
    assert [find_problem(sample) for sample in rendered_pairs] == [None] * len(rendered_pairs)


@pytest.mark.needs_egl
@pytest.mark.parametrize(
    "spoil",
    [
        lambda sample: replace(sample, left=sample.right, right=sample.left),
        lambda sample: shifted(sample, 1),
        lambda sample: shifted(sample, -1),
        lambda sample: replace(sample, right_disparity_px=1.2 * sample.right_disparity_px),
        lambda sample: replace(sample, right_disparity_px=-sample.right_disparity_px),
        lambda sample: replace(sample, right_disparity_px=sample.right_disparity_px + np.float32(0.1)),
    ],
    ids=["sides", "a pixel more", "a pixel less", "scale", "sign", "a tenth of a pixel"],
)
def test_spoiled_rendered_pairs_have_a_problem(rendered_pairs, spoil):
    assert all(find_problem(spoil(sample)) for sample in rendered_pairs)


# A set


def test_an_intact_set_has_statistics_and_no_problem(folder):
    found = checked(folder)
    assert found.problems == ()
    assert found.pairs == 3
    # Of 32 x 48 pixels, a box of 11 x 16 is at 10 px, a sky of 8 rows at 0 px, and a wall at 3 px. Focal
    # length times baseline is 12 px m.
    box, sky = 3 * 11 * 16, 3 * 8 * 48
    wall = 3 * 32 * 48 - box - sky
    known_sky = sky - found.unknown
    assert found.unknown in (0, sky)
    assert found.disparity.tolist() == [known_sky, 0, 0, wall, 0, box, 0, 0, 0, 0]
    # The box is at 1.2 m, the wall at 4 m, and the sky at 100 m or more.
    assert found.depth.tolist() == [0, box, 0, wall, 0, 0, 0, 0, 0, 0, known_sky]
    # Without the right view's disparity, pixels that the box hides from the right camera count as well.
    assert found.compared == 3
    assert found.matched == (3 if known_sky else 0)
    assert found.grey_levels[1] <= (0 if known_sky else 0.2 * found.grey_levels[0])


def test_the_report_has_statistics_with_histograms(folder):
    told = "\n".join(report_lines(checked(folder)))
    assert told.endswith("\nno problems")
    assert "3 pairs" in told
    assert "8 to 16  " in told
    # The wall covers most of the picture, so it has the longest bar.
    assert ("█" * 40) in next(line for line in told.splitlines() if line.strip().startswith("2 to 4"))


def test_a_damaged_file_is_named_and_the_other_pairs_are_checked(folder):
    path = next(iter(folder.glob("*.tar")), folder / "left" / "pylon" / "000001.png")
    content = bytearray(path.read_bytes())
    content[content.find(b"IDAT" if path.suffix == ".png" else b"VP8L") + 30] ^= 1
    path.write_bytes(content)
    found = checked(folder)
    (message,) = found.problems
    assert "found it damaged" in message
    assert str(folder) in message
    assert found.pairs == 2
    assert list(report_lines(found))[-2:] == [message, "1 problem"]


def test_a_damaged_shard_is_reported_once_for_all_of_its_pairs(folder):
    for path in (*folder.glob("*.tar"), *folder.glob("depth/pylon/*.png")):
        path.write_bytes(b"nothing")
    found = checked(folder)
    count = 1 if next(folder.glob("*.tar"), None) else 3
    assert len(found.problems) == count
    assert all("rerun the same `stereoweave synth make` command" in message for message in found.problems)
    assert list(report_lines(found))[-1] == f"{count} problem{'s' * (count > 1)}"


def test_inconsistent_pairs_are_named(tmp_path):
    (tmp_path / "set.json").write_text(FACTS.replace("LAYOUT", "shards"))
    samples = [box_before_a_wall(np.random.default_rng(number)) for number in range(3)]
    samples[1] = replace(samples[1], left=samples[0].left)
    write_shard(tmp_path, "pylon", 0, [pack(sample, {}) for sample in samples])
    (message,) = checked(tmp_path).problems
    assert message.startswith(f"{tmp_path}: pylon-000001: expected the images to differ least")


def test_an_unfinished_set_is_a_problem(folder):
    text = (folder / "set.json").read_text().replace("3}", "5}")
    (folder / "set.json").write_text(text)
    (message,) = checked(folder).problems
    assert message.startswith(f"{folder}: expected the 5 pairs requested, found 3")


def test_several_processes_report_the_same_as_one(folder):
    one, several = checked(folder), check_set(folder, jobs=2, console=Console(file=io.StringIO()))
    assert list(report_lines(one)) == list(report_lines(several))
