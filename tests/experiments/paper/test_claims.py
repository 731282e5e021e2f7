import math
import random

import pytest

from experiments.paper.claims import (
    TABLE_I,
    PaperRow,
    claims_table,
    interval_half_width,
    list_comparisons,
    propeller_table,
    reduction_percent,
    reductions_by_seed,
    run_time_table,
    settings_table,
)
from experiments.paper.trials import ADJUSTMENT, DECODER, NETWORKS, NETWORKS_SHORT, PAPER, PROJECTION

COMPARISONS = {comparison.text: comparison for comparison in list_comparisons()}
PROJECTED = "projection loss: end-point error"


def row(claim, setting, seed=0, model="fast_depth", steps=600, **scores):
    found = dict.fromkeys(("prediction", "squared_error", "epe_px", "mae_sourced", "sourced_percent"), 1.0)
    found |= {"epe_cm": math.nan, "exponent": 1.5}
    found |= dict.fromkeys(("mae_filled", "psnr_db", "ssim", "minutes"), 1.0) | scores
    return PaperRow(
        claim=claim,
        setting=setting,
        seed=seed,
        model=model,
        loss="l2",
        alpha_p=1.0,
        steps=steps,
        batch=4,
        crop="192x128",
        commit="0123abc",
        machine="x86_64 AVX512",
        **found,
    )


def projected(*less):
    """Return rows of one seed per value, the percentage by which the projection loss reduces the error."""
    without = [row(PROJECTION, "without", seed, epe_px=2.0) for seed in range(len(less))]
    return without + [
        row(PROJECTION, PAPER, seed, epe_px=2 * (1 - value / 100)) for seed, value in enumerate(less)
    ]


def line_of(table, text):
    """Return the cells of the line that begins with this text."""
    (line,) = (line for line in table.splitlines() if line.startswith(f"| {text} |"))
    return [cell.strip() for cell in line.strip("|").split("|")][1:]


def test_a_reduction_is_relative_to_the_reference():
    assert reduction_percent(4.0, 3.0) == 25
    assert reduction_percent(4.0, 5.0) == -25


def test_a_seed_is_compared_with_itself():
    rows = [
        *(
            row(PROJECTION, "without", seed, epe_px=error)
            for seed, error in ((0, 90.0), (1, 10.0), (2, 20.0))
        ),
        *(row(PROJECTION, PAPER, seed, epe_px=error) for seed, error in ((1, 8.0), (2, 10.0), (3, 90.0))),
        row(ADJUSTMENT, PAPER, 1, epe_px=90.0),
    ]
    random.Random(0).shuffle(rows)
    # Only seeds 1 and 2 have both settings: 8 instead of 10, and 10 instead of 20.
    assert reductions_by_seed(rows, COMPARISONS[PROJECTED]) == pytest.approx([20, 50])


def test_the_interval_is_students():
    # t is 4.303 for two degrees of freedom, 12.706 for one; the deviations are 1 and sqrt(2).
    assert interval_half_width([1.0, 2.0, 3.0]) == pytest.approx(4.303 / math.sqrt(3), rel=1e-3)
    assert interval_half_width([0.0, 2.0]) == pytest.approx(12.706, rel=1e-4)
    assert math.isnan(interval_half_width([5.0]))


@pytest.mark.parametrize(
    ("less", "measured", "difference", "verdict"),
    [
        ((20, 21, 22), "21 (19 to 23)", "+1", "holds"),
        ((-20, -21, -22), "-21 (-23 to -19)", "-41", "the opposite"),
        ((10, 11, 12), "11 (9 to 13)", "-9", "better, but less than claimed"),
        ((-9, 1, 11), "1 (-24 to 26)", "-19", "undecided"),
        ((15,), "15 (one seed)", "-5", "one seed: no verdict"),
    ],
)
def test_a_claim_holds_where_its_whole_interval_does(less, measured, difference, verdict):
    cells = line_of(claims_table(projected(*less)), PROJECTED)
    assert cells == ["about 20 %, up to 25 %", measured, difference, verdict]


def test_a_claim_without_rows_is_listed_as_not_run():
    lines = claims_table([]).splitlines()[2:]
    assert len(lines) == len(COMPARISONS) == 19
    assert all(line.endswith("| not run | | |") for line in lines)
    run = [line for line in claims_table(projected(20)).splitlines()[2:] if "not run" not in line]
    texts = [line.split(" | ")[0] for line in run]
    assert texts == [
        f"| {PROJECTED}",
        "| projection loss: loss between codes",
        "| projection loss: MAE of the right view",
    ]


def test_the_depth_adjustment_is_claimed_of_loss_and_error():
    claimed = {one.measure: one.paper_percent for one in COMPARISONS.values() if one.claim == ADJUSTMENT}
    assert claimed == {"prediction": 15, "squared_error": 15, "epe_px": 20, "mae_filled": None}
    rows = [row(ADJUSTMENT, "p = 1", epe_px=5.0), row(ADJUSTMENT, "p = 1.5", epe_px=4.0)]
    cells = line_of(claims_table(rows), "depth adjustment, p = 1.5 against 1: end-point error")
    assert cells == ["up to 20 %", "20 (one seed)", "+0", "one seed: no verdict"]


def test_losses_in_codes_of_two_exponents_decide_nothing():
    rows = [
        row(ADJUSTMENT, setting, seed, prediction=loss)
        for setting, loss in (("p = 1", 2.0), ("p = 1.5", 1.0))
        for seed in range(3)
    ]
    text = "depth adjustment, p = 1.5 against 1: validation loss, each in its own code (not comparable)"
    assert line_of(claims_table(rows), text) == ["about 15 %", "50 (50 to 50)", "+35", "not a fair test"]


def test_every_other_exponent_is_compared_with_none_without_a_claim():
    errors = {
        "p = 1": (1.0, 4.0),
        "p = 2": (2.0, 3.0),
        "p = 2.47 (fitted)": (2.47, 2.0),
        "p = 1.5": (1.5, 3.0),
    }
    rows = [
        row(ADJUSTMENT, setting, exponent=exponent, epe_cm=10 * px, epe_px=px, mae_filled=px)
        for setting, (exponent, px) in errors.items()
    ]
    # 1 - 2 / 4.
    for measure in ("end-point error", "end-point error in px", "MAE of the right view"):
        text = f"depth adjustment, p = 2.47 (fitted) against 1: {measure}"
        cells = line_of(claims_table(rows, depth=True), text)
        assert cells == ["-", "50 (one seed)", "", "one seed: no verdict"]
    of_pixels = claims_table(rows)
    assert "p = 2.47 (fitted) against 1: end-point error |" in of_pixels
    assert "in px" not in of_pixels
    # The fit may end at its bound, 1.
    rows = [row(ADJUSTMENT, setting, exponent=1.0) for setting in ("p = 1", "p = 1 (fitted)")]
    assert "p = 1 (fitted)" not in claims_table(rows)


@pytest.mark.parametrize(
    ("less", "verdict"),
    [((20, 21, 22), "better"), ((-9, 1, 11), "undecided"), ((-20, -21, -22), "the opposite")],
)
def test_a_claim_without_a_number_in_the_paper_has_no_difference(less, verdict):
    reference = [row(DECODER, "upsampled at once, no skips", seed, epe_px=2.0) for seed in range(3)]
    changed = [row(DECODER, PAPER, seed, epe_px=2 * (1 - value / 100)) for seed, value in enumerate(less)]
    cells = line_of(claims_table(reference + changed), "step-wise decoder with skips: end-point error")
    assert (cells[0], cells[2], cells[3]) == ("-", "", verdict)


def test_table_i_is_the_papers():
    errors = {name: columns[0] for name, columns in TABLE_I.items()}
    assert errors == {
        "dispnet": (5.38, 15.62, 5.99, 9.73),
        "densemapnet": (4.41, 6.56, 4.45, 8.67),
        "psmnet": (3.85, 8.12, 3.88, 2.38),
        "fast_depth": (3.95, 6.42, 4.08, 2.32),
    }
    assert {name: columns[1] for name, columns in TABLE_I.items()} == {
        "dispnet": (9.87, 13.93, 12.84, 59.34),
        "densemapnet": (8.34, 9.43, 9.78, 54.69),
        "psmnet": (7.94, 10.32, 7.36, 41.22),
        "fast_depth": (7.99, 8.24, 7.93, 37.31),
    }


def test_the_networks_are_claimed_what_table_i_comes_to():
    # 1 - 3.95 / 4.41, 1 - 6.42 / 6.56, 1 - 4.08 / 4.45, 1 - 2.32 / 8.67
    parent = COMPARISONS["the paper's network against densemapnet: end-point error"]
    assert parent.paper == "10 2 8 73 % (Table I)"
    assert parent.paper_percent == pytest.approx((10.43 + 2.13 + 8.31 + 73.24) / 4, abs=0.01)
    assert (parent.claim, parent.reference, parent.changed) == (NETWORKS, "densemapnet", "fast_depth")
    # 1 - 7.99 / 7.94, 1 - 8.24 / 10.32, 1 - 7.93 / 7.36, 1 - 37.31 / 41.22
    slow = COMPARISONS["the paper's network against psmnet: MAE of the right view"]
    assert slow.paper == "-1 20 -8 9 % (Table I)"
    assert (slow.claim, slow.measure) == (NETWORKS_SHORT, "mae_filled")


@pytest.mark.parametrize("rival", ["scvnet", "ganet_11"])
def test_networks_without_numbers_in_the_paper_are_compared_after_psmnets_steps(rival):
    found = COMPARISONS[f"the paper's network against {rival}: end-point error"]
    assert (found.paper, found.paper_percent) == ("-", None)
    assert (found.claim, found.reference, found.changed) == (NETWORKS_SHORT, rival, "fast_depth")
    rows = [
        row(NETWORKS_SHORT, rival, steps=150, epe_px=10.0),
        row(NETWORKS_SHORT, "fast_depth", steps=150, epe_px=8.0),
    ]
    cells = line_of(claims_table(rows), f"the paper's network against {rival}: end-point error")
    assert cells == ["-", "20 (one seed)", "", "one seed: no verdict"]


def test_the_settings_of_a_claim_are_ranked_by_the_mae_of_the_filled_view():
    rows = [
        row(PROJECTION, "without", 0, epe_px=1.0, mae_filled=9.0, mae_sourced=1.0),
        row(PROJECTION, PAPER, 0, epe_px=1.0, mae_filled=6.0, mae_sourced=5.0),
        row(PROJECTION, PAPER, 1, epe_px=3.0, mae_filled=8.0, mae_sourced=5.0),
        row(ADJUSTMENT, "p = 1", 0, mae_filled=1.0),
    ]
    header, _, first, second = settings_table(rows, PROJECTION).splitlines()
    # Means over the seeds; the deviation of 1 and 3 is sqrt(2).
    assert first == (f"| {PAPER} | 2 | 2.00 ± 1.41 | 1.00000 | 7.00 | 5.00 | 1.0 | 1.00 | 1.000 | 1.0 |")
    assert second == "| without | 1 | 1.00 | 1.00000 | 9.00 | 1.00 | 1.0 | 1.00 | 1.000 | 1.0 |"
    assert header.count("|") == first.count("|")


def test_depth_is_claimed_of_the_error_in_cm_and_of_propeller_alone():
    found = {comparison.text: comparison for comparison in list_comparisons(depth=True)}
    in_px = "depth adjustment, p = 1.5 against 1: end-point error in px"
    assert found.keys() == COMPARISONS.keys() | {in_px}
    assert found.pop(in_px).measure == "epe_px"
    assert {one.measure for one in found.values()} == {"prediction", "squared_error", "epe_cm", "mae_filled"}
    # 1 - 2.32 / 8.67, and 1 - 37.31 / 41.22.
    parent = found["the paper's network against densemapnet: end-point error"]
    assert (parent.paper, parent.measure) == ("73 % (Table I, Propeller)", "epe_cm")
    assert parent.paper_percent == pytest.approx(73.24, abs=0.01)
    slow = found["the paper's network against psmnet: MAE of the right view"]
    assert slow.paper == "9 % (Table I, Propeller)"
    assert slow.paper_percent == pytest.approx(9.49, abs=0.01)
    rows = [
        row(PROJECTION, setting, epe_px=1.0, epe_cm=error)
        for setting, error in (("without", 50.0), (PAPER, 40.0))
    ]
    assert line_of(claims_table(rows, depth=True), PROJECTED)[1] == "20 (one seed)"


def test_networks_stand_beside_the_papers_propeller():
    rows = [
        row(NETWORKS, "fast_depth", 0, epe_cm=40.0, mae_filled=30.0),
        row(NETWORKS, "fast_depth", 1, epe_cm=50.0, mae_filled=32.0),
        row(NETWORKS_SHORT, "psmnet", model="psmnet", steps=150, epe_cm=1.38, mae_filled=41.22),
        row(NETWORKS_SHORT, "ganet_11", model="ganet_11", steps=150, epe_cm=1.5, mae_filled=42.0),
        row(NETWORKS_SHORT, "scvnet", model="scvnet", steps=150, epe_cm=2.5, mae_filled=43.0),
        row(NETWORKS_SHORT, "fast_depth", steps=150, epe_cm=60.0, mae_filled=40.0),
        row(PROJECTION, PAPER, epe_cm=0.0, mae_filled=0.0),
        # One training may serve both claims.
        row(NETWORKS_SHORT, "fast_depth", 0, epe_cm=40.0, mae_filled=30.0),
    ]
    lines = propeller_table(rows).splitlines()
    assert lines[2:] == [
        "| PSMNet | 150 | 1 | 2.38 | 1.38 | -1.00 | 41.22 | 41.22 | +0.00 |",
        "| SCV-Net | 150 | 1 | - | 2.50 |  | - | 43.00 |  |",
        "| GA-Net-11 | 150 | 1 | - | 1.50 |  | - | 42.00 |  |",
        "| the paper's network | 150 | 1 | 2.32 | 60.00 | +57.68 | 37.31 | 40.00 | +2.69 |",
        # The deviation of 40 and 50 is 10 / sqrt(2), that of 30 and 32 is sqrt(2).
        "| the paper's network | 600 | 2 | 2.32 | 45.00 ± 7.07 | +42.68 | 37.31 | 31.00 ± 1.41 | -6.31 |",
    ]
    assert {line.count("|") for line in lines} == {10}


def test_the_settings_of_depth_have_their_errors_in_cm_first():
    rows = [row(PROJECTION, PAPER, seed, epe_cm=error) for seed, error in enumerate((30.0, 50.0))]
    header, _, line = settings_table(rows, PROJECTION, depth=True).splitlines()
    assert header.startswith("| setting | seeds | EPE cm | EPE px | ")
    # The deviation of 30 and 50 is 10 sqrt(2).
    assert line.startswith(f"| {PAPER} | 2 | 40.0 ± 14.1 | 1.00 | ")
    assert header.count("|") == line.count("|")


def test_a_single_score_is_ranked_after_the_means():
    rows = [
        row(PROJECTION, "without", 0, mae_filled=1.0),
        row(PROJECTION, PAPER, 0, mae_filled=9.0),
        row(PROJECTION, PAPER, 1, mae_filled=9.0),
    ]
    lines = settings_table(rows, PROJECTION).splitlines()[2:]
    assert [line.split(" | ")[:2] for line in lines] == [[f"| {PAPER}", "2"], ["| without", "1"]]


def test_run_times_stand_beside_the_papers():
    numbers = {"parameters": "300", "multiply_adds": "8410000000", "eager_ms": "400", "onnx_ms": "80"}
    rows = [
        {"network": "psmnet", **numbers, "eager_relative": "21", "onnx_relative": "12.5"},
        {"network": "another", **numbers, "eager_relative": "2", "onnx_relative": "3"},
        {"network": "ganet_11", **numbers, "eager_relative": "30", "onnx_ms": "", "onnx_relative": ""},
    ]
    table = run_time_table(rows)
    assert line_of(table, "PSMNet") == ["300", "8.4", "400", "21.00", "80", "12.50", "10", "+2.50"]
    assert line_of(table, "GA-Net-11") == ["300", "8.4", "400", "30.00", "-", "-", "-", ""]
    assert line_of(table, "another")[-2:] == ["-", ""]
    assert table.splitlines()[0].count("|") == table.splitlines()[2].count("|")
