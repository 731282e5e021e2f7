from concurrent.futures import ThreadPoolExecutor

import numpy as np
import onnxruntime
import pytest
from matcher_examples import matcher_file, of_fixed_size, red_of

from stereoweave.errors import MatcherError
from stereoweave.matching import network as networks
from stereoweave.matching.matcher import model_file
from stereoweave.matching.network import RUNS_BEFORE, Network

MAPS = ["disparity_px", "right_disparity_px", "confidence_logit"]


@pytest.fixture
def opened(monkeypatch):
    """Return the list of the sizes for which sessions of their own are opened."""
    sizes, open_session = [], networks.open_session_of_size
    monkeypatch.setattr(
        networks,
        "open_session_of_size",
        lambda *given: sizes.append((*given[-1].values(),)) or open_session(*given),
    )
    return sizes


def pair_of(height, width, batch=1):
    rng = np.random.default_rng(height + width)
    return {view: rng.random((batch, 3, height, width), np.float32) for view in ("left", "right")}


def red_network(tmp_path, size=("batch", "height", "width")):
    nodes = red_of("left", "disparity_px")
    return Network(matcher_file(tmp_path / "red.onnx", nodes, ["disparity_px"], size=size), "cpu", 1)


def red(pair):
    return 255 * pair["left"][:, :1]


@pytest.mark.parametrize("model", ["base", "small"])
def test_a_session_for_one_size_computes_the_same_bits(model, opened):
    network, pair = Network(model_file(model), "cpu", 2), pair_of(64, 96)
    first, *others = (network.run(MAPS, pair, False) for _ in range(RUNS_BEFORE + 2))
    assert opened == [(1, 64, 96)]
    for other in others:
        for before, after in zip(first, other, strict=True):
            np.testing.assert_array_equal(before, after)


def test_only_a_size_that_repeats_without_another_in_between_gets_its_own_session(tmp_path, opened):
    network = red_network(tmp_path)
    first, second = [(8, 8)], [(8, 9)]
    repeated = (RUNS_BEFORE + 1) * second + 2 * first + RUNS_BEFORE * second
    for height, width in [*RUNS_BEFORE * first, *second, *first, *repeated]:
        pair = pair_of(height, width)
        np.testing.assert_allclose(network.run(["disparity_px"], pair, False)[0], red(pair), rtol=1e-6)
    assert opened == [(1, 8, 9)]


def test_batches_of_several_numbers_are_different_sizes(tmp_path, opened):
    network = red_network(tmp_path)
    for batch in [*RUNS_BEFORE * [1, 2], *RUNS_BEFORE * [2]]:
        assert network.run(["disparity_px"], pair_of(8, 8, batch), False)[0].shape == (batch, 1, 8, 8)
    assert opened == [(2, 8, 8)]


def test_a_file_that_has_changed_is_not_read_again(tmp_path, opened):
    network, pair = red_network(tmp_path), pair_of(8, 8)
    (tmp_path / "red.onnx").write_bytes(b"another file")
    for _ in range(RUNS_BEFORE + 2):
        np.testing.assert_allclose(network.run(["disparity_px"], pair, False)[0], red(pair), rtol=1e-6)
    assert len(opened) == 1


def test_a_network_of_a_fixed_size_keeps_its_only_session(tmp_path, opened):
    network, pair = (
        Network(of_fixed_size("small", tmp_path / "fixed.onnx", 64, 96), "cpu", 1),
        pair_of(64, 96),
    )
    for _ in range(RUNS_BEFORE + 2):
        network.run(MAPS, pair, False)
    assert opened == []


def test_sides_that_must_be_equal_by_their_names_keep_the_session_for_any_size(tmp_path, opened):
    network, pair = red_network(tmp_path, size=("batch", "side", "side")), pair_of(8, 8)
    for _ in range(RUNS_BEFORE + 2):
        np.testing.assert_allclose(network.run(["disparity_px"], pair, False)[0], red(pair), rtol=1e-6)
    assert opened == []


def test_threads_that_match_different_sizes_at_once_all_get_their_own_maps(tmp_path, opened):
    network = red_network(tmp_path)
    pairs = [pair_of(8, 8 + i // 30 % 2) for i in range(120)]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda pair: network.run(["disparity_px"], pair, False)[0], pairs))
    for pair, disparity_px in zip(pairs, found, strict=True):
        np.testing.assert_allclose(disparity_px, red(pair), rtol=1e-6)
    assert opened


def test_its_own_session_has_the_same_number_of_threads(tmp_path, monkeypatch):
    network, used = Network(model_file("small"), "cpu", 1), []
    run = onnxruntime.InferenceSession.run
    monkeypatch.setattr(
        onnxruntime.InferenceSession,
        "run",
        lambda self, *given: used.append(self) or run(self, *given),
    )
    for _ in range(RUNS_BEFORE + 1):
        network.run(MAPS, pair_of(32, 64), False)
    assert [session.get_session_options().intra_op_num_threads for session in used] == [1] * (RUNS_BEFORE + 1)
    assert used[0] is not used[-1]


def releases_memory(options):
    try:
        return options.get_run_config_entry("memory.enable_memory_arena_shrinkage") == "cpu:0"
    except RuntimeError:  # there is no such entry
        return False


def test_the_session_for_any_size_releases_its_memory_before_another_replaces_it(tmp_path, monkeypatch):
    network, released = red_network(tmp_path), []
    run = onnxruntime.InferenceSession.run

    def spy(self, outputs, inputs, options):
        released.append(releases_memory(options))
        return run(self, outputs, inputs, options)

    monkeypatch.setattr(onnxruntime.InferenceSession, "run", spy)
    for _ in range(RUNS_BEFORE + 2):
        network.run(["disparity_px"], pair_of(8, 8), False)
    network.run(["disparity_px"], pair_of(8, 9), True)
    assert released == [*(RUNS_BEFORE - 1) * [False], True, False, False, True]


def test_a_run_that_fails_names_the_file(tmp_path):
    network = red_network(tmp_path)
    with pytest.raises(MatcherError, match=r"red\.onnx"):
        network.run(["disparity_px"], {"left": np.zeros((1, 3, 8, 8), np.float64)}, False)


def test_a_size_that_cannot_be_planned_keeps_the_session_for_any_size(tmp_path, monkeypatch):
    def refuse(*_):
        raise MatcherError("no such plan")

    monkeypatch.setattr(networks, "open_session_of_size", refuse)
    network, pair = red_network(tmp_path), pair_of(8, 8)
    for _ in range(RUNS_BEFORE + 2):
        np.testing.assert_allclose(network.run(["disparity_px"], pair, False)[0], red(pair), rtol=1e-6)


def test_no_size_is_planned_on_a_gpu(tmp_path, opened, monkeypatch):
    open_session = networks.open_session
    monkeypatch.setattr(networks, "open_session", lambda path, _, threads: open_session(path, "cpu", threads))
    nodes = red_of("left", "disparity_px")
    network = Network(matcher_file(tmp_path / "red.onnx", nodes, ["disparity_px"]), "cuda", 1)
    for _ in range(RUNS_BEFORE + 2):
        network.run(["disparity_px"], pair_of(8, 8), False)
    assert opened == []
