import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matcher_examples import matcher_file, painted, red_of

import stereoweave as sw
from stereoweave.errors import MatcherError, StereoweaveError
from stereoweave.matching import matcher as matcher_module
from stereoweave.matching.backend import Backend, _load


def test_equal_backends_share_one_loaded_network_and_unlike_ones_do_not():
    backend = Backend(threads=1)
    assert backend.matcher() is Backend(threads=1).matcher()
    assert backend.matcher() is not replace(backend, model="base").matcher()
    assert backend.matcher() is not replace(backend, threads=2).matcher()
    assert replace(backend, model="best").matcher() is not replace(backend, model="base").matcher()


def test_a_model_is_loaded_once_and_kept(tmp_path, rng, monkeypatch):
    opened = []
    open_session = matcher_module.open_session
    monkeypatch.setattr(
        matcher_module, "open_session", lambda *given: opened.append(given) or open_session(*given)
    )
    file = tmp_path / "matcher.onnx"
    matcher_file(file, red_of("left", "disparity_px"), ["disparity_px"])
    left, right = rng.integers(0, 256, (2, 32, 32, 3), np.uint8)
    for _ in range(3):
        sw.estimate(left, right, model=file)
        sw.StereoMatcher(model=file).compute(left, right)
    assert len(opened) == 1


def test_a_checked_network_is_not_kept(tmp_path):
    file = tmp_path / "matcher.onnx"
    matcher_file(file, red_of("left", "disparity_px"), ["disparity_px"])
    before = _load.cache_info().misses
    Backend(model=file).check()
    assert _load.cache_info().misses == before
    file.write_bytes(b"no network")
    with pytest.raises(MatcherError, match=r"matcher\.onnx: expected an ONNX matcher"):
        Backend(model=file).check()


def test_a_pinned_network_stays_though_its_file_changes(tmp_path):
    file = tmp_path / "matcher.onnx"
    matcher_file(file, red_of("left", "disparity_px"), ["disparity_px"])
    pinned = Backend(model=file, threads=1).pin()
    matcher = pinned.matcher()
    file.write_bytes(b"no network")
    assert pinned.matcher() is matcher
    assert (pinned.model, pinned.threads, pinned.provider) == (file, 1, "cpu")


def test_threads_that_ask_at_once_share_one_network(tmp_path):
    file = tmp_path / "matcher.onnx"
    matcher_file(file, red_of("left", "disparity_px"), ["disparity_px"])
    with ThreadPoolExecutor(6) as pool:
        matchers = list(pool.map(lambda _: Backend(model=file, threads=1).matcher(), range(6)))
    assert len(set(map(id, matchers))) == 1


def test_the_network_is_loaded_as_the_backend_says():
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
        ({"threads": 0}, StereoweaveError, "threads: expected 1 or more"),
    ],
)
def test_what_cannot_be_loaded_is_one_line(fields, kind, message):
    with pytest.raises(kind, match=message) as caught:
        Backend(**fields).matcher()
    assert "\n" not in str(caught.value)


def test_a_failed_load_is_tried_again(tmp_path):
    file = tmp_path / "matcher.onnx"
    with pytest.raises(MatcherError):
        Backend(model=file).matcher()
    matcher_file(file, red_of("left", "disparity_px"), ["disparity_px"])
    assert Backend(model=file).matcher().threads is None


def test_a_file_that_has_changed_is_loaded_again_whatever_its_path_is_relative_to(tmp_path, rng, monkeypatch):
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
