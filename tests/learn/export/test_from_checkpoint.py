import json
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from learn_examples import (
    PAIR_SIZE,
    RECIPE,
    checkpoint_of,
    complaint,
    overfitted,
    recipe_of,
    untrained,
)
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from stereoweave.errors import StereoweaveError
from stereoweave.learn import checkpoint
from stereoweave.learn.export import confidence as calibrate
from stereoweave.learn.export import from_checkpoint as export
from stereoweave.matching.matcher import Matcher
from stereoweave.stereo import StereoPair


@pytest.fixture(autouse=True)
def little_calibration(monkeypatch):
    monkeypatch.setattr(calibrate, "_PAIRS", 1)
    monkeypatch.setattr(calibrate, "_SIZE", PAIR_SIZE)


@pytest.fixture
def run(tmp_path):
    """Return the folder of a run that has overfitted one pair."""
    folder = tmp_path / "run"
    folder.mkdir()
    checkpoint.save(checkpoint_of(overfitted().network), folder / "last.pt")
    return folder


@pytest.fixture
def pair():
    sample = overfitted().sample
    return StereoPair(left=sample.left, right=sample.right)


def test_a_network_at_half_the_resolution_answers_as_in_pytorch(tmp_path):
    trained = overfitted("weave_half")
    checkpoint.save(checkpoint_of(trained.network, recipe_of("weave_half")), tmp_path / "last.pt")
    card = export.export_matcher(tmp_path, tmp_path / "half.onnx")
    assert card["onnx_differs_px"] < 0.01
    matcher = Matcher(tmp_path / "half.onnx")
    assert (matcher.multiple_of, matcher.max_disparity_px) == (32, 256)
    # Also for a size that needs padding.
    left, right = (np.resize(view, (75, 130, 3)) for view in (trained.sample.left, trained.sample.right))
    assert matcher.estimate(left, right).disparity_px.shape == (75, 130)


def of_another_network(graph):
    """Return the graph with negated weights in one of its layers."""
    weights = next(value for value in graph.graph.initializer if len(value.dims) == 4)
    weights.CopyFrom(onnx.numpy_helper.from_array(-onnx.numpy_helper.to_array(weights), weights.name))
    return graph


def test_the_matcher_file_answers_as_pytorch_does_and_nothing_is_written_otherwise(
    run, pair, tmp_path, monkeypatch
):
    out = tmp_path / "weights" / "tiny.onnx"
    card = export.export_matcher(run, out, [pair])
    assert 0 <= card["onnx_differs_px"] < 0.01
    assert sorted(file.name for file in out.parent.iterdir()) == ["tiny.json", "tiny.onnx"]

    assert card["compared_pairs"] == 2
    assert 0 <= card["onnx_differs_confidence"] < 0.01
    assert card["origin"] == ()
    assert b"site-packages" not in out.read_bytes()
    assert str(Path(export.__file__).parent).encode() not in out.read_bytes()

    graph = onnx.load(out)
    facts = {entry.key: entry.value for entry in graph.metadata_props}
    assert json.loads(facts.pop("stereoweave.recipe"))["crop_size"] == [64, 64]
    assert facts == {
        "stereoweave.name": "tiny",
        "stereoweave.multiple_of": "16",
        "stereoweave.max_disparity_px": "192",
        "stereoweave.commit": "0123abc",
    }
    assert [value.name for value in graph.graph.output] == export.OUTPUTS

    written = json.loads(out.with_suffix(".json").read_text())
    assert written == json.loads(json.dumps(card))
    assert written["steps"] == RECIPE.steps
    assert written["validation"] == {"epe_px": 1.5}
    assert written["parameters"] == sum(p.numel() for p in overfitted().network.parameters())

    matcher = Matcher(out, threads=1)
    mirrored = pair.mirror()
    for found, alone in zip(matcher.estimate_many([pair, mirrored]), (pair, mirrored), strict=True):
        expected = matcher.estimate(alone.left, alone.right)
        np.testing.assert_allclose(found.disparity_px, expected.disparity_px, atol=1e-3)
        np.testing.assert_allclose(found.right_disparity_px, expected.right_disparity_px, atol=1e-3)
        np.testing.assert_allclose(found.confidence, expected.confidence, atol=1e-3)
    assert [side.dim_param for side in graph.graph.input[0].type.tensor_type.shape.dim][:2] == ["batch", ""]

    assert matcher.estimate(pair.left[:45, :77], pair.right[:45, :77]).disparity_px.shape == (45, 77)
    found_px = matcher.estimate(pair.left, pair.right).disparity_px
    assert abs(found_px - overfitted().sample.disparity_px).mean() < 1

    # In the same test, because the export is slow.
    monkeypatch.setattr(export, "export_graph", lambda _network, _kept: of_another_network(graph))
    elsewhere = tmp_path / "elsewhere" / "tiny.onnx"
    with pytest.raises(
        StereoweaveError,
        match=r"run.*: expected ONNX Runtime and PyTorch to differ by .* nothing was written",
    ):
        export.export_matcher(run / "last.pt", elsewhere, [pair])
    assert list(elsewhere.parent.iterdir()) == []


@pytest.fixture
def paper_run(tmp_path):
    """Return the folder of a run of the paper's network, with weights that spread its codes over 0..1."""
    network = untrained("fast_depth")
    torch.nn.init.normal_(network.head.to_code.weight, std=0.05)
    recipe = recipe_of("fast_depth", exponent=1.5, alpha_p=1.0)
    (tmp_path / "paper").mkdir()
    checkpoint.save(checkpoint_of(network, recipe), tmp_path / "paper" / "last.pt")
    return tmp_path / "paper"


def test_a_matcher_of_the_papers_network_estimates_the_right_view_from_the_mirrored_pair(
    paper_run, pair, tmp_path
):
    out = tmp_path / "paper.onnx"
    card = export.export_matcher(paper_run, out, [pair])
    assert 0 <= card["onnx_differs_px"] < 0.01
    assert card["onnx_differs_confidence"] == 0
    assert card["parameters"] == 314_722
    assert "confidence" not in card
    assert [value.name for value in onnx.load(out).graph.output] == ["disparity_px"]

    matcher = Matcher(out, threads=1)
    found = matcher.estimate(pair.left, pair.right, raw=True)
    network = export.load_matcher_network(checkpoint.load(paper_run / "last.pt"))
    for values, view in (
        (found.disparity_px, pair),
        (found.right_disparity_px[:, ::-1], pair.mirror()),
    ):
        tensors = [torch.from_numpy(image).permute(2, 0, 1)[None] / 255 for image in (view.left, view.right)]
        with torch.no_grad():
            code = network.network(*tensors)[0, 0].numpy()
        # Equation (4) with a range of 48 px.
        np.testing.assert_allclose(values, 48 * code ** (1 / 1.5), atol=0.01)
    assert np.ptp(found.disparity_px) > 1


def test_a_matcher_returns_the_pixels_that_its_network_predicts():
    network, recipe = untrained("psmnet"), recipe_of("psmnet", exponent=2.0)
    left, right = torch.rand(2, 1, 3, 32, 48)
    matcher = export.DisparityNetwork(network, recipe)
    with torch.no_grad():
        (found_px,) = matcher(left, right)
        torch.testing.assert_close(found_px, network(left, right))
    assert (matcher.multiple_of, matcher.max_disparity_px) == (16, 48)


@pytest.mark.parametrize(
    ("model", "parts"),
    [("psmnet", "pooling windows"), ("ganet_11", "recursions over rows and columns")],
)
def test_a_network_whose_graph_is_for_one_size_cannot_be_exported(tmp_path, model, parts):
    checkpoint.save(checkpoint_of(untrained(model), recipe_of(model)), tmp_path / "last.pt")
    assert complaint(export.export_matcher, tmp_path, tmp_path / "out" / "a.onnx") == (
        f"tiny: expected a network for pairs of any size, found {model}, whose {parts} depend on the size; "
        "score it with `stereoweave bench networks`"
    )
    assert not (tmp_path / "out").exists()


def test_a_network_that_estimates_depth_cannot_be_exported(tmp_path):
    recipe = recipe_of("fast_depth", target="depth")
    checkpoint.save(checkpoint_of(untrained("fast_depth"), recipe), tmp_path / "last.pt")
    assert complaint(export.export_matcher, tmp_path, tmp_path / "out" / "depth.onnx") == (
        "tiny: expected target = 'disparity', found 'depth'; "
        "a matcher file has no camera with which to convert depth to disparity"
    )
    assert not (tmp_path / "out").exists()


def test_a_network_that_compares_patches_cannot_be_exported(tmp_path):
    checkpoint.save(checkpoint_of(untrained("mc_cnn"), recipe_of("mc_cnn")), tmp_path / "last.pt")
    assert complaint(export.export_matcher, tmp_path, tmp_path / "out" / "mc_cnn.onnx") == (
        "tiny: expected a network that estimates disparities, found mc_cnn, which compares patches; "
        "score it with `stereoweave bench networks`"
    )
    assert not (tmp_path / "out").exists()


class OneLayer(nn.Module):
    def __init__(self):
        super().__init__()
        self.layer = nn.Conv2d(3, 8, 3, padding=1)

    def forward(self, left, right):
        return self.layer(left) @ right[:, :1].mT


def test_multiply_adds_include_layers_and_products():
    height, width = 8, 12
    layer = height * width * 8 * 3 * 9
    product = 8 * height * width * height
    assert export.count_multiply_adds(OneLayer(), height, width) == layer + product


@pytest.mark.parametrize(
    ("name", "refinements"),
    [
        # At half the resolution, each left pixel compares 16 features with those of 6 columns.
        ("weave_base", 16 * 48 * 16 * 6),
        # 8 features with those of 5 columns: at half the resolution of the left view, at a quarter of both.
        ("weave_half", 16 * 48 * 8 * 5 + 2 * 8 * 24 * 8 * 5),
    ],
)
def test_multiply_adds_count_the_refinements_of_weavenet(name, refinements):
    network, image = untrained(name), torch.rand(1, 3, 32, 96)
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        network(image, image)
    assert export.count_multiply_adds(network, 32, 96) == counter.get_total_flops() // 2 + refinements
