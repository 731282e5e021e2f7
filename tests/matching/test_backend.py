import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matcher_examples import matcher_file, painted, red_of

import stereoweave as sw
from stereoweave.errors import MatcherError, StereoweaveError
from stereoweave.matching import network
from stereoweave.matching.backend import Backend


def test_equal_backends_share_one_loaded_network_and_different_ones_do_not():
    backend = Backend(threads=1)
    assert backend.matcher() is Backend(threads=1).matcher()
    assert backend.matcher() is not replace(backend, model="base").matcher()
    assert backend.matcher() is not replace(backend, threads=2).matcher()
    assert replace(backend, model="best").matcher() is not replace(backend, model="base").matcher()


def test_a_model_is_loaded_once_and_kept(tmp_path, rng, monkeypatch):
    opened = []
    open_session = network.open_session
    monkeypatch.setattr(network, "open_session", lambda *given: opened.append(given) or open_session(*given))
    file = tmp_path / "matcher.onnx"
    matcher_file(file, red_of("left", "disparity_px"), ["disparity_px"])
    left, right = rng.integers(0, 256, (2, 32, 32, 3), np.uint8)
    for _ in range(3):
        sw.estimate(left, right, model=file)
        sw.StereoMatcher(model=file).compute(left, right)
    assert len(opened) == 1


def test_concurrent_threads_share_one_network(tmp_path):
    file = tmp_path / "matcher.onnx"
    matcher_file(file, red_of("left", "disparity_px"), ["disparity_px"])
    with ThreadPoolExecutor(6) as pool:
        matchers = list(pool.map(lambda _: Backend(model=file, threads=1).matcher(), range(6)))
    assert len(set(map(id, matchers))) == 1


def test_the_network_is_loaded_with_the_settings_of_the_backend():
    matcher = Backend(model="best", threads=1).matcher()
    assert (matcher.name, matcher.magnification) == ("base", 1.5)
    assert (matcher.threads, matcher.provider) == (1, "cpu")


@pytest.mark.parametrize(
    ("fields", "kind", "message"),
    [
        ({"model": "nonsense"}, MatcherError, "unknown model 'nonsense'"),
        (
            {"model": "none.onnx"},
            MatcherError,
            "none.onnx: expected an ONNX matcher file, found no such file",
        ),
        ({"provider": "abacus"}, MatcherError, "provider: expected one of cpu, "),
        ({"threads": 0}, StereoweaveError, "threads: expected a number from 1 to 1024, got 0"),
    ],
)
def test_a_failure_to_load_is_a_one_line_error(fields, kind, message):
    with pytest.raises(kind, match=message) as caught:
        Backend(**fields).matcher()
    assert "\n" not in str(caught.value)


def test_a_folder_is_no_matcher_file(tmp_path):
    (tmp_path / "folder.onnx").mkdir()
    with pytest.raises(MatcherError, match=r"folder\.onnx: expected an ONNX matcher file, found a folder$"):
        Backend(model=tmp_path / "folder.onnx").matcher()


def test_a_failed_load_is_tried_again(tmp_path):
    file = tmp_path / "matcher.onnx"
    with pytest.raises(MatcherError):
        Backend(model=file).matcher()
    matcher_file(file, red_of("left", "disparity_px"), ["disparity_px"])
    assert Backend(model=file).matcher().threads is None


def test_a_changed_file_is_reloaded_even_if_its_path_is_relative(tmp_path, rng, monkeypatch):
    left, right = (painted(rng.integers(0, 255, (32, 48))) for _ in range(2))
    found = []
    for turn, (folder, image) in enumerate([("a", "left"), ("a", "right"), ("b", "left")]):
        (tmp_path / folder).mkdir(exist_ok=True)
        monkeypatch.chdir(tmp_path / folder)
        file = matcher_file(Path("matcher.onnx"), red_of(image, "disparity_px"), ["disparity_px"])
        os.utime(file, ns=(turn, turn))
        found.append(sw.estimate(left, right, model="matcher.onnx", raw=True).disparity_px)
    for disparity_px, image in zip(found, (left, right, left), strict=True):
        np.testing.assert_allclose(disparity_px, image[:, :, 0], atol=1e-4)
