import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.colors import to_rgba

from stereoweave.bench import plots as benchmark_plots
from stereoweave.bench.metrics import sparsification
from stereoweave.bench.plots import draw_error_over_time, draw_sparsification
from stereoweave.bench.tables import Curves, MatcherRow
from stereoweave.io.images import read_image


@pytest.fixture
def drawn(monkeypatch):
    """Return the figures in the order in which they are written."""
    figures = []
    save = benchmark_plots._save

    def noted(figure, path):
        figures.append(figure)
        save(figure, path)

    monkeypatch.setattr(benchmark_plots, "_save", noted)
    return figures


def row(matcher, time_ms, bad1_percent, epe_px, calibration_error=0.1):
    others = dict.fromkeys(("bad2_percent", "d1_percent", "time_relative"), math.nan)
    edges = dict.fromkeys(("edge_epe_px", "edge_bad1_percent", "flying_percent"), math.nan)
    areas = dict.fromkeys(("ause_px", "ause_bad1_percent"), math.nan)
    errors = {"epe_px": epe_px, "bad1_percent": bad1_percent, "calibration_error": calibration_error}
    return MatcherRow(matcher=matcher, scene="mean", time_ms=time_ms, **errors, **others, **edges, **areas)


ROWS = [row("sgbm", 70, 17, 2.3, math.nan), row("small", 71, 17.1, 2.29), row("a/mine.onnx", 72, 17, 2.3)]


def test_each_matcher_is_a_point_in_both_panels_networks_apart_from_opencv(tmp_path, drawn):
    draw_error_over_time(tmp_path / "time.png", ROWS)
    left, right = drawn[0].axes
    assert [axes.get_ylabel()[:5] for axes in (left, right)] == ["bad-1", "EPE: "]
    points = [[(line.get_xdata()[0], line.get_ydata()[0]) for line in axes.lines] for axes in (left, right)]
    assert points == [[(70, 17), (71, 17.1), (72, 17)], [(70, 2.3), (71, 2.29), (72, 2.3)]]
    colours = [to_rgba(line.get_color()) for line in left.lines]
    assert colours[0] != colours[1] == colours[2]
    assert left.get_xscale() == "log"
    assert [path.name for path in tmp_path.iterdir()] == ["time.png"]
    assert (tmp_path / "time.png").read_bytes().startswith(b"\x89PNG")


def test_any_matcher_whose_confidence_is_no_probability_has_the_marker_of_opencv_s(tmp_path, drawn):
    draw_error_over_time(tmp_path / "time.png", [*ROWS, row("mc_cnn raw", 90, 20, 3, math.nan)])
    for axes in drawn[0].axes:
        assert [line.get_marker() for line in axes.lines] == ["s", "o", "o", "s"]


def test_names_of_nearly_coincident_points_do_not_overlap(tmp_path, drawn):
    draw_error_over_time(tmp_path / "time.png", ROWS)
    for axes in drawn[0].axes:
        assert [label.get_text() for label in axes.texts] == ["sgbm", "small", "mine.onnx"]
        boxes = [label.get_window_extent() for label in axes.texts]
        assert not any(one.overlaps(other) for one, other in itertools.combinations(boxes, 2))


def test_a_name_covers_no_point_of_another_matcher(tmp_path, drawn):
    opencv = [("bm", 20, 20.8, 2.25), ("sgbm", 150, 16.9, 2.33)]
    base, best = ("base", 245, 9.3, 0.69), ("best", 784, 7.8, 0.65)
    small = [("small", 114, 13.5, 0.88), ("small refined", 156, 12.3, 0.80)]
    rows = [row(*each) for each in (*opencv, base, *small, best)]
    draw_error_over_time(tmp_path / "time.png", rows)
    for axes in drawn[0].axes:
        points = [axes.transData.transform(line.get_xydata()[0]) for line in axes.lines]
        for label in axes.texts:
            assert not any(label.get_window_extent().contains(*point) for point in points)


def test_each_confidence_has_its_curve_and_its_oracle_in_one_colour(tmp_path, drawn, rng):
    curve = sparsification(rng.uniform(0, 3, 50), rng.uniform(0, 1, 50))
    curves = {"small": Curves(curve, curve), "mc_cnn raw": Curves(curve, curve)}
    draw_sparsification(tmp_path / "curves.png", curves, checked={"mc_cnn raw"})
    for axes in drawn[0].axes:
        kept, oracle, other_kept, _ = axes.lines[:4]
        np.testing.assert_array_equal(kept.get_ydata(), curve.kept)
        np.testing.assert_array_equal(oracle.get_ydata(), curve.oracle)
        np.testing.assert_array_equal(kept.get_xdata(), np.arange(96))
        assert kept.get_color() == oracle.get_color() != other_kept.get_color()
    legend = [text.get_text() for text in drawn[0].axes[1].get_legend().get_texts()]
    assert legend == ["small", "mc_cnn raw, by its left-right check", "by the true error: the oracle"]


def test_a_matcher_of_unknown_error_is_left_out_and_any_kind_of_picture_is_written(tmp_path):
    unknown = replace(ROWS[0], epe_px=float("nan"), bad1_percent=float("nan"))
    for name, rows in (("all.bmp", [unknown]), ("one.png", [unknown, *ROWS[1:]])):
        draw_error_over_time(tmp_path / name, rows)
        assert read_image(tmp_path / name).std() > 5
