"""MC-CNN: its costs, its views and patches, and the known results of the published weights."""

import numpy as np
import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from stereoweave.bench.mc_cnn.steps import find_nearest_vectors
from stereoweave.errors import FormatError
from stereoweave.io.images import read_pair
from stereoweave.io.maps import read_disparity_png
from stereoweave.learn.mc_cnn_matcher import describe
from stereoweave.learn.models.mc_cnn import MCCNN, PATCH_PX, load_weights, standardise


@pytest.fixture(autouse=True)
def same_draws():
    torch.manual_seed(0)


@pytest.fixture
def weights():
    return MCCNN().state_dict()


def test_the_network_takes_45_giga_multiply_adds_for_a_view():
    # 9 weights to 64 channels, then four layers of 9 * 64 weights to 64 channels, at each of 640x480 pixels.
    assert (9 * 64 + 4 * 9 * 64 * 64) * 640 * 480 == 45_475_430_400
    network, image = MCCNN().to("meta"), torch.empty(1, 1, 480, 640, device="meta")
    with FlopCounterMode(display=False) as counter:
        network.describe(image)
    assert counter.get_total_flops() == 2 * 45_475_430_400
    assert "45.48 G multiply-adds" in MCCNN.__doc__


def test_a_view_has_mean_0_and_deviation_1_over_whole_levels():
    # Red, green, blue, white and black have the levels 76.2, 149.7, 29.1, 255 and 0, with a mean of 102.
    view = torch.tensor([[1.0, 0, 0, 1, 0], [0, 1, 0, 1, 0], [0, 0, 1, 1, 0]])[None, :, None]
    deviations = np.array([76, 150, 29, 255, 0]) - 102
    assert (deviations**2).sum() == 42_122
    found = standardise(view)[0, 0, 0].numpy()
    np.testing.assert_allclose(found, deviations / (42_122 / 5) ** 0.5, rtol=1e-5)


def test_a_plain_view_is_0_everywhere():
    assert standardise(torch.full((1, 3, 20, 30), 0.37)).abs().max() < 1e-3


@torch.no_grad()
def test_the_vector_of_a_pixel_is_that_of_the_11x11_patch_around_it():
    network, grey = MCCNN(), torch.randn(1, 1, 30, 40)
    vectors = network.describe(grey)
    assert vectors.shape == (1, 64, 30, 40)
    torch.testing.assert_close(vectors.norm(dim=1), torch.ones(1, 30, 40))
    assert PATCH_PX == 11
    patch = grey[..., 12 - 5 : 12 + 6, 20 - 5 : 20 + 6]
    torch.testing.assert_close(network.describe_patches(patch)[0], vectors[0, :, 12, 20])


@pytest.mark.parametrize("entry", ["model", "averaged"])
def test_the_weights_of_a_published_file_and_of_a_checkpoint_are_loaded(tmp_path, weights, entry):
    torch.save({"epoch": 13, entry: weights}, tmp_path / "some.pt")
    network = load_weights(tmp_path / "some.pt")
    assert not network.training
    for name, values in network.state_dict().items():
        torch.testing.assert_close(values, weights[name], rtol=0, atol=0)


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"conv_blocks.8.bias": None}, "found no conv_blocks.8.bias"),
        ({"conv_blocks.0.weight": torch.zeros(64, 3, 3, 3)}, r"\(64, 1, 3, 3\), found \(64, 3, 3, 3\)"),
        ({"conv_blocks.2.bias": [0.0] * 64}, r"conv_blocks.2.bias of shape \(64,\), found list"),
        (
            {"conv_blocks.4.bias": torch.full((64,), torch.nan)},
            "expected finite numbers in conv_blocks.4.bias",
        ),
        (
            {"conv_blocks.4.bias": torch.zeros(64, dtype=torch.int8)},
            "expected finite numbers in conv_blocks.4",
        ),
        ({"head.weight": torch.zeros(1)}, "also found head.weight"),
        ({7: torch.zeros(1)}, "also found 7"),
    ],
)
def test_weights_of_another_network_are_refused_with_the_difference(tmp_path, weights, changes, complaint):
    changed = {name: values for name, values in (weights | changes).items() if values is not None}
    torch.save({"model": changed}, tmp_path / "some.pt")
    with pytest.raises(FormatError, match=complaint) as raised:
        load_weights(tmp_path / "some.pt")
    assert str(raised.value).startswith(f"{tmp_path / 'some.pt'}: expected ")
    assert "\n" not in str(raised.value)


class Payload:
    """What pickle runs when it loads this creates a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


def test_a_file_that_holds_no_weights_is_refused_in_one_line_and_runs_no_code(tmp_path, weights):
    torch.save({"model": weights}, tmp_path / "cut.pt")
    (tmp_path / "cut.pt").write_bytes((tmp_path / "cut.pt").read_bytes()[:100_000])
    (tmp_path / "text.pt").write_text("conv_blocks")
    (tmp_path / "empty.pt").touch()
    torch.save({"model": Payload(tmp_path / "ran")}, tmp_path / "pickle.pt")
    torch.save(weights, tmp_path / "bare.pt")
    torch.save([1], tmp_path / "list.pt")
    for name, complaint in (
        ("missing.pt", "found no such file"),
        (".", "in a PyTorch file, found "),
        ("cut.pt", "found another kind of file, or a damaged one"),
        ("text.pt", "found another kind of file, or a damaged one"),
        ("empty.pt", "found "),
        ("pickle.pt", "found another kind of file, or a damaged one"),
        ("bare.pt", "in an entry model or averaged, found neither"),
        ("list.pt", "in an entry model or averaged, found neither"),
    ):
        with pytest.raises(FormatError, match=complaint) as raised:
            load_weights(tmp_path / name)
        assert str(raised.value).startswith(f"{tmp_path / name}: expected MC-CNN's weights")
        assert "\n" not in str(raised.value)
    assert not (tmp_path / "ran").exists()


@pytest.mark.testdata
@pytest.mark.parametrize(
    ("name", "scene", "errors"),
    [
        ("mb_weights", "motorcycle", (3.897, 17.95, 15.52)),
        ("mb_weights", "teddy", (4.243, 20.87, 18.88)),
        ("data_fusion_contest", "motorcycle", (3.390, 19.64, 15.81)),
        ("data_fusion_contest", "teddy", (3.714, 22.80, 19.36)),
    ],
)
def test_the_published_weights_give_their_known_errors(testdata, name, scene, errors):
    folder = testdata / "stereo" / "pairs" / scene
    pair = read_pair(folder / "left.png", folder / "right.png")
    truth_px = read_disparity_png(folder / "disparity.png")
    network = load_weights(testdata / "mc_cnn" / f"mc_cnn_fast_{name}.pt")
    found_px = find_nearest_vectors(describe(network, pair.left), describe(network, pair.right), 96)
    off_px = np.abs(found_px - truth_px)[np.isfinite(truth_px)]
    measured = off_px.mean(), 100 * (off_px > 1).mean(), 100 * (off_px > 2).mean()
    assert measured == pytest.approx(errors, rel=0.01)
