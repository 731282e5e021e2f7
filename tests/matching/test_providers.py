from dataclasses import replace
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
from matcher_examples import matcher_file, painted, red_of
from onnx import TensorProto, helper

import stereoweave as sw
from stereoweave.cli.root import main
from stereoweave.errors import MatcherError, ProviderError
from stereoweave.io.images import read_pair, write_image
from stereoweave.matching.backend import Backend
from stereoweave.matching.matcher import Matcher
from stereoweave.matching.providers import PROVIDERS
from stereoweave.outputs.results import DepthJob, job_facts, make_depth
from stereoweave.system import kernel_cache as compiling

HERE = [name for name, known in PROVIDERS.items() if known.name in onnxruntime.get_available_providers()]
ABSENT = [name for name in PROVIDERS if name not in HERE]


@pytest.fixture
def red(tmp_path):
    """Write a matcher file that returns the red channel as disparity."""
    nodes = red_of("left", "disparity_px") + red_of("right", "right_disparity_px")
    return matcher_file(tmp_path / "red.onnx", nodes, ["disparity_px", "right_disparity_px"])


@pytest.fixture
def pictures(tmp_path):
    pair = read_pair("tests/textured_pair/left.png", "tests/textured_pair/right.png")
    paths = tmp_path / "left.png", tmp_path / "right.png"
    for path, picture in zip(paths, (pair.left, pair.right), strict=True):
        write_image(path, picture[200:296, 200:328])
    return paths


@pytest.mark.parametrize("provider", HERE)
def test_available_providers_run_a_matcher_file(red, rng, provider):
    left, right = (painted(rng.integers(0, 255, (32, 48))) for _ in range(2))
    found = Matcher(red, provider=provider).estimate(left, right, raw=True)
    np.testing.assert_allclose(found.disparity_px, left[:, :, 0], atol=1e-3)
    np.testing.assert_allclose(found.right_disparity_px, right[:, :, 0], atol=1e-3)


@pytest.mark.parametrize("provider", HERE)
def test_available_providers_give_the_results_of_the_cpu(provider):
    pair = read_pair("tests/textured_pair/left.png", "tests/textured_pair/right.png")
    left, right = pair.left[200:296, 200:328], pair.right[200:296, 200:328]
    expected = sw.estimate(left, right)
    found = sw.estimate(left, right, provider=provider)
    np.testing.assert_allclose(found.right_disparity_px, expected.right_disparity_px, atol=0.01)
    np.testing.assert_allclose(found.confidence, expected.confidence, atol=1e-3)


@pytest.mark.parametrize("provider", ABSENT)
def test_a_missing_provider_is_reported_with_its_requirements(provider):
    with pytest.raises(MatcherError) as caught:
        sw.estimate(np.zeros((32, 32, 3), np.uint8), np.zeros((32, 32, 3), np.uint8), provider=provider)
    line = str(caught.value)
    assert line.startswith(f"provider {provider}: expected an ONNX Runtime that includes it, found version ")
    assert f"{onnxruntime.__version__} with {', '.join(HERE)}; the provider needs " in line
    assert {
        "cuda": "then pip install onnxruntime-gpu[cuda,cudnn]",
        "tensorrt": "then pip install onnxruntime-gpu[cuda,cudnn] tensorrt",
        "openvino": "pip install onnxruntime-openvino",
        "coreml": "macOS",
        "directml": "pip install onnxruntime-directml",
    }[provider] in line
    assert "\n" not in line


def test_an_unknown_provider_is_reported_with_the_known_ones():
    with pytest.raises(
        MatcherError, match="expected one of cpu, cuda, tensorrt, openvino, coreml, directml, found 'gpu'"
    ):
        Matcher(provider="gpu")


@pytest.mark.parametrize("make", [sw.StereoMatcher, lambda **given: sw.synthesize(*noise(), 0.5, **given)])
def test_every_way_to_a_matcher_takes_a_provider(make):
    with pytest.raises(MatcherError, match="found 'gpu'"):
        make(provider="gpu")


def noise():
    return np.random.default_rng(0).integers(0, 256, (2, 32, 32, 3), np.uint8)


@pytest.mark.parametrize(
    "words",
    [
        "depth left.png right.png -o out",
        "depth . -o out",
        "measure left.png right.png --from 9,9 --to 20,20 --focal-px 500 --baseline-m 0.1",
        "view left.png right.png -o out.png",
        "live 0 --port 0 --no-browser",
        "app --port 0",
    ],
)
def test_every_matching_command_takes_a_provider_and_writes_nothing_if_it_is_missing(
    pictures, monkeypatch, capsys, words
):
    monkeypatch.chdir(pictures[0].parent)
    assert main([*words.split(), "--provider", "gpu"]) == 2
    printed, told = capsys.readouterr()
    assert printed == ""
    assert told == f"stereoweave: --provider: expected one of {', '.join(PROVIDERS)}, found 'gpu'\n"
    assert {path.name for path in Path().iterdir()} == {"left.png", "right.png"}


def test_running_out_of_memory_is_not_blamed_on_the_file(tmp_path):
    # A picture of 32x32 becomes a tensor of 4 exabytes, which exceeds any machine's address space.
    shape = helper.make_tensor("shape", TensorProto.INT64, [4], [1, 10**6, 10**6, 10**6])
    nodes = [
        *red_of("left", "red_px"),
        helper.make_node("ReduceMax", ["red_px"], ["nearest_px"]),
        helper.make_node("Constant", [], ["shape"], value=shape),
        helper.make_node("Expand", ["nearest_px", "shape"], ["vast"]),
        helper.make_node("ReduceMax", ["vast"], ["most_px"]),
        helper.make_node("Add", ["red_px", "most_px"], ["disparity_px"]),
    ]
    vast = Matcher(matcher_file(tmp_path / "vast.onnx", nodes, ["disparity_px"]))
    with pytest.raises(ProviderError, match=r"provider cpu: failed to run vast\.onnx: .*alloc") as caught:
        vast.estimate(*noise())
    line = str(caught.value)
    assert "use smaller pictures, or run fewer processes" in line
    assert "or run it on " not in line
    assert "\n" not in line


def test_a_graph_that_rejects_its_input_is_blamed_on_the_file(tmp_path):
    seven = helper.make_tensor("seven", TensorProto.INT64, [1], [7])
    nodes = [
        *red_of("left", "red_px"),
        helper.make_node("Constant", [], ["seven"], value=seven),
        helper.make_node("Reshape", ["red_px", "seven"], ["disparity_px"]),
    ]
    unfit = Matcher(matcher_file(tmp_path / "unfit.onnx", nodes, ["disparity_px"]))
    with pytest.raises(MatcherError, match=r"unfit\.onnx: expected an ONNX matcher file") as caught:
        unfit.estimate(*noise())
    assert not isinstance(caught.value, ProviderError)


@pytest.mark.parametrize("provider", HERE)
def test_a_result_names_its_provider_unless_it_is_the_cpu(pictures, tmp_path, provider):
    job = DepthJob(backend=Backend(provider=provider), always=("disparity.pfm",))
    summary, *_ = make_depth(pictures, tmp_path / "out", job)
    assert summary.model == ("small" if provider == "cpu" else f"small on {provider}")


def test_a_batch_whose_gpu_failed_can_be_finished_on_the_processor():
    job = DepthJob()
    assert job_facts(replace(job, backend=Backend(provider="cuda"))) == job_facts(job)


def test_tensorrt_keeps_its_engines_in_the_users_cache_where_there_is_one(tmp_path, monkeypatch):
    monkeypatch.setattr(compiling, "cache_folder", lambda: tmp_path / "kernels")
    folder = str(tmp_path / "tensorrt")
    assert PROVIDERS["tensorrt"].options(1) == {
        "trt_engine_cache_enable": "True",
        "trt_engine_cache_path": folder,
        "trt_timing_cache_enable": "True",
        "trt_timing_cache_path": folder,
    }
    assert Path(folder).is_dir()
    (tmp_path / "file").touch()
    monkeypatch.setattr(compiling, "cache_folder", lambda: tmp_path / "file" / "kernels")
    assert PROVIDERS["tensorrt"].options(1) == {}
