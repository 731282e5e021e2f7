"""DenseMapNet: its parameter count, its image sizes, and the known results of the published weights."""

import h5py
import numpy as np
import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from stereoweave.errors import FormatError
from stereoweave.io.images import read_pair
from stereoweave.io.maps import read_disparity_png
from stereoweave.learn.models.densemapnet import DenseMapNet, load_keras

# Kernels in Keras's order: rows, columns, inputs, outputs. The transposed convolution swaps the last two.
KERNELS = [
    *[(5, 5, 3, 16), (5, 5, 3, 1), (5, 5, 6, 32)],
    *[(5, 5, 32, 32)] * 4,
    *[(1, 1, 176, 64), (5, 5, 64, 16), (1, 1, 192, 64), (5, 5, 64, 16)],
    *[(1, 1, 208, 64), (5, 5, 64, 16), (1, 1, 224, 64), (5, 5, 64, 16)],
    *[(1, 1, 240, 32), (5, 5, 33, 16)],
]
NORMS = [32, 176, 64, 192, 64, 208, 64, 224, 64, 240, 33, 49]


@pytest.fixture(autouse=True)
def same_draws():
    torch.manual_seed(0)


def arrays_of_a_keras_file(rng):
    shapes = {"conv2d_transpose_1/kernel": (9, 9, 1, 49), "conv2d_transpose_1/bias": (1,)}
    for number, shape in enumerate(KERNELS, 1):
        shapes |= {f"conv2d_{number}/kernel": shape, f"conv2d_{number}/bias": shape[3:]}
    for number, channels in enumerate(NORMS, 1):
        for part in ("gamma", "beta", "moving_mean", "moving_variance"):
            shapes[f"batch_normalization_{number}/{part}"] = (channels,)
    return {name: rng.random(shape, np.float32) for name, shape in shapes.items()}


def write_keras(path, arrays):
    with h5py.File(path, "w") as file:
        for name, values in arrays.items():
            layer, part = name.split("/")
            file[f"{layer}/{layer}/{part}:0"] = values


def parameters(network):
    return sum(parameter.numel() for parameter in network.parameters())


def values_of(network):
    """Return the number of parameters and batch-norm statistics, without step counters, which Keras lacks."""
    return sum(values.numel() for values in network.state_dict().values() if values.is_floating_point())


def test_the_network_has_its_published_number_of_parameters():
    network = DenseMapNet()
    assert parameters(network) == 290_290
    assert values_of(network) == 293_110
    assert "290,290 parameters" in DenseMapNet.__doc__


def test_a_grey_network_has_one_channel_per_view_instead_of_three():
    # Two channels fewer: 25 weights each to 16 features and 1 channel of the left view, and to 32 of both.
    assert 2 * 25 * (16 + 1 + 2 * 32) == 4_050
    assert parameters(DenseMapNet(channels=1)) == 290_290 - 4_050
    assert values_of(DenseMapNet(channels=1)) == 289_060


def test_the_network_takes_8_giga_multiply_adds():
    network, image = DenseMapNet().to("meta"), torch.empty(1, 3, 480, 640, device="meta")
    with FlopCounterMode(display=False) as counter:
        network(image, image)
    assert round(counter.get_total_flops() / 2 / 1e9, 2) == 8.41
    assert "8.41 G multiply-adds" in DenseMapNet.__doc__


@pytest.mark.parametrize("size", [(37, 53), (1, 1), (16, 24)])
@pytest.mark.parametrize("channels", [1, 3])
def test_the_code_has_the_size_of_the_pictures_and_is_between_0_and_1(size, channels):
    network = DenseMapNet(channels).eval()
    left, right = torch.rand(2, 2, 3, *size)
    code = network(left, right)
    assert code.shape == (2, 1, *size)
    assert ((code > 0) & (code < 1)).all()
    assert len(network.outputs(left, right)) == len(network.output_weights) == 1


def test_a_picture_of_odd_size_gives_the_result_of_the_picture_padded_by_its_border():
    network = DenseMapNet().eval()
    left, right = torch.rand(2, 1, 3, 37, 53)
    rows, columns = torch.arange(40).clamp(max=36), torch.arange(56).clamp(max=52)
    padded = (view[:, :, rows][..., columns] for view in (left, right))
    with torch.no_grad():
        torch.testing.assert_close(network(left, right), network(*padded)[..., :37, :53], rtol=0, atol=0)


def test_a_grey_network_weighs_the_colours_by_rec_601():
    network = DenseMapNet(channels=1).eval()
    amounts = torch.rand(2, 1, 1, 16, 16)
    with torch.no_grad():
        for channel, weight in enumerate((0.299, 0.587, 0.114)):
            coloured = torch.zeros(2, 1, 3, 16, 16)
            coloured[:, :, channel] = amounts[:, :, 0]
            grey = (weight * amounts).expand(2, 1, 3, 16, 16)
            torch.testing.assert_close(network(*coloured), network(*grey))


def test_every_value_of_a_keras_file_is_loaded_into_its_place(tmp_path, rng):
    arrays = arrays_of_a_keras_file(rng)
    write_keras(tmp_path / "some.h5", arrays)
    network = load_keras(tmp_path / "some.h5")
    assert not network.training
    assert sum(values.size for values in arrays.values()) == 293_110
    loaded = torch.cat([v.flatten() for v in network.state_dict().values() if v.is_floating_point()])
    expected = np.concatenate([values.ravel() for values in arrays.values()])
    np.testing.assert_array_equal(np.sort(loaded.numpy()), np.sort(expected))
    matching, head = network.matching, network.head
    for layer, name in (
        (matching.left_features, "conv2d_1"),
        (matching.left_channel, "conv2d_2"),
        (matching.stereo_features, "conv2d_3"),
        (matching.correspondence[0], "conv2d_4"),
        (matching.dense[3][1][2], "conv2d_15"),
        (matching.bottleneck[2], "conv2d_16"),
        (head.conv[2], "conv2d_17"),
    ):
        kernel = torch.from_numpy(arrays[f"{name}/kernel"])
        torch.testing.assert_close(layer.weight, torch.einsum("yxio->oiyx", kernel))
        torch.testing.assert_close(layer.bias, torch.from_numpy(arrays[f"{name}/bias"]))
    transposed = torch.from_numpy(arrays["conv2d_transpose_1/kernel"])
    torch.testing.assert_close(head.to_code.weight, torch.einsum("yxoi->ioyx", transposed))
    for part, values in (
        ("gamma", head.norm.weight),
        ("beta", head.norm.bias),
        ("moving_mean", head.norm.running_mean),
        ("moving_variance", head.norm.running_var),
    ):
        torch.testing.assert_close(values, torch.from_numpy(arrays[f"batch_normalization_12/{part}"]))


def test_a_file_of_another_network_is_refused_with_the_difference(tmp_path, rng):
    arrays, path = arrays_of_a_keras_file(rng), tmp_path / "some.h5"
    last = "conv2d_transpose_1/kernel"
    for changed, complaint in (
        (
            {name: values for name, values in arrays.items() if name != last},
            f"no conv2d_transpose_1/{last}:0",
        ),
        (
            arrays | {"batch_normalization_3/beta": np.zeros(48, np.float32)},
            r"batch_normalization_3/beta:0 of shape \(64,\), found shape \(48,\)",
        ),
        (arrays | {"dense_1/kernel": np.zeros((2, 2))}, "also found dense_1/dense_1/kernel:0"),
        ({}, "found no conv2d_1/conv2d_1/kernel:0"),
    ):
        write_keras(path, changed)
        with pytest.raises(FormatError, match=complaint) as raised:
            load_keras(path)
        assert str(raised.value).startswith(f"{path}: expected ")
        assert "\n" not in str(raised.value)


def test_a_file_that_is_missing_or_not_hdf5_is_refused_in_one_line(tmp_path, rng):
    text, damaged = tmp_path / "text.h5", tmp_path / "damaged.h5"
    text.write_text("conv2d_1")
    write_keras(damaged, arrays_of_a_keras_file(rng))
    damaged.write_bytes(damaged.read_bytes()[:100_000])
    for path, complaint in (
        (tmp_path / "missing.h5", "found no such file"),
        (tmp_path, "in HDF5, found another format or a damaged file"),
        (text, "in HDF5, found another format or a damaged file"),
        (damaged, "in HDF5, found another format or a damaged file"),
    ):
        with pytest.raises(FormatError, match=complaint) as raised:
            load_keras(path)
        assert str(raised.value).startswith(f"{path}: expected Keras weights")
        assert "\n" not in str(raised.value)


@pytest.mark.testdata
@pytest.mark.parametrize(
    ("name", "channels", "count"),
    [
        ("driving", 3, 293_110),
        ("flying", 3, 293_110),
        ("kitti2015", 1, 289_060),
        ("monkaa", 3, 293_110),
        ("mpi", 3, 293_110),
    ],
)
def test_each_published_file_fills_the_whole_network(testdata, name, channels, count):
    path = testdata / "densemapnet" / f"{name}.h5"
    sizes = []
    with h5py.File(path) as file:
        file.visititems(lambda _, item: sizes.append(getattr(item, "size", 0)))
    network = load_keras(path)
    assert network.channels == channels
    assert sum(sizes) == values_of(network) == count


@pytest.mark.testdata
@pytest.mark.parametrize(
    ("name", "error_px", "correlation"), [("flying", 6.86, 0.78), ("driving", 12.5, 0.68)]
)
def test_the_published_weights_give_their_known_errors_on_motorcycle(testdata, name, error_px, correlation):
    scene = testdata / "stereo" / "pairs" / "motorcycle"
    pair = read_pair(scene / "left.png", scene / "right.png")
    height, width = (side // 8 * 8 for side in pair.left.shape[:2])
    left, right = (
        torch.from_numpy(view[:height, :width].copy()).permute(2, 0, 1)[None] / 255
        for view in (pair.left, pair.right)
    )
    truth_px = read_disparity_png(scene / "disparity.png")[:height, :width]
    with torch.no_grad():
        code = load_keras(testdata / "densemapnet" / f"{name}.h5")(left, right)[0, 0].numpy()
    known = np.isfinite(truth_px)
    code, truth_px = code[known].astype(float), truth_px[known].astype(float)
    # d_max is unknown, so a least-squares factor replaces it.
    scaled_px = code * (code @ truth_px) / (code @ code)
    assert np.abs(scaled_px - truth_px).mean() == pytest.approx(error_px, rel=0.01)
    assert np.corrcoef(code, truth_px)[0, 1] == pytest.approx(correlation, rel=0.01)
