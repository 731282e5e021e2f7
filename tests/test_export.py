import json
from pathlib import Path

import onnx
import pytest
from learn_examples import PAIR_SIZE, RECIPE, checkpoint_of, overfitted
from torch import nn

from stereoweave.errors import StereoweaveError
from stereoweave.learn import calibrate, checkpoint, export
from stereoweave.matcher import Matcher
from stereoweave.stereo import StereoPair


@pytest.fixture(autouse=True)
def little_calibration(monkeypatch):
    monkeypatch.setattr(calibrate, "_PAIRS", 1)
    monkeypatch.setattr(calibrate, "_SIZE", PAIR_SIZE)


@pytest.fixture
def run(tmp_path):
    """The folder of a run that has learnt one pair."""
    folder = tmp_path / "run"
    folder.mkdir()
    checkpoint.save(checkpoint_of(overfitted().network), folder / "last.pt")
    return folder


@pytest.fixture
def pair():
    sample = overfitted().sample
    return StereoPair(left=sample.left, right=sample.right)


def of_another_network(graph):
    """The graph with the weights of one of its layers the other way round."""
    weights = next(value for value in graph.graph.initializer if len(value.dims) == 4)
    weights.CopyFrom(onnx.numpy_helper.from_array(-onnx.numpy_helper.to_array(weights), weights.name))
    return graph


def test_the_matcher_file_answers_as_pytorch_does_and_nothing_is_written_otherwise(
    run, pair, tmp_path, monkeypatch
):
    out = tmp_path / "weights" / "tiny.onnx"
    card = export.export(run, out, [pair])
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
    assert matcher.estimate(pair.left[:45, :77], pair.right[:45, :77]).disparity_px.shape == (45, 77)
    found_px = matcher.estimate(pair.left, pair.right).disparity_px
    assert abs(found_px - overfitted().sample.disparity_px).mean() < 1

    # Here, because the exporter takes its time.
    monkeypatch.setattr(export, "graph_of", lambda _network, _kept: of_another_network(graph))
    elsewhere = tmp_path / "elsewhere" / "tiny.onnx"
    with pytest.raises(
        StereoweaveError, match=r"run.*: ONNX Runtime and PyTorch differ by .* nothing was written"
    ):
        export.export(run / "last.pt", elsewhere, [pair])
    assert list(elsewhere.parent.iterdir()) == []


class OneLayer(nn.Module):
    def __init__(self):
        super().__init__()
        self.layer = nn.Conv2d(3, 8, 3, padding=1)

    def forward(self, left, right):
        return self.layer(left) @ right[:, :1].mT


def test_multiply_adds_are_those_of_layers_products_and_the_refinement():
    height, width = 8, 12
    layer = height * width * 8 * 3 * 9
    product = 8 * height * width * height
    # Both views at half the resolution compare 16 features with those of 6 columns.
    refinement = 2 * (height // 2) * (width // 2) * 16 * 6
    assert export.multiply_adds(OneLayer(), height, width) == layer + product + refinement
