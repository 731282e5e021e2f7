"""The paper's claims beside our measurements, as Markdown tables."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats  # type: ignore[import-untyped]

from experiments.paper.trials import ADJUSTMENT, DECODER, NETWORKS, NETWORKS_SHORT, PAPER, PROJECTION


@dataclass(frozen=True, kw_only=True)
class PaperRow:
    """Scores of one training run on the held-out pairs.

    Attributes:
        claim, setting: Purpose of the run. A run that serves several claims has a row for each.
        seed: Seed of the initial weights, the training pairs and their order.
        steps: Number of training steps; the network has seen steps * batch pairs.
        prediction: Loss between codes, of the kind that was minimised in training.
        squared_error: Squared error between codes without the exponent, comparable across exponents.
        epe_px, epe_cm, mae_sourced, sourced_percent, mae_filled, psnr_db, ssim: See `ProjectionRow`.
        minutes: Wall time, including that of the run that it started from; runs may share the machine.
        machine: GPU or processor that finished the training.
    """

    claim: str
    setting: str
    seed: int
    model: str
    loss: str
    exponent: float
    alpha_p: float
    steps: int
    batch: int
    crop: str
    prediction: float
    squared_error: float
    epe_px: float
    epe_cm: float
    mae_sourced: float
    sourced_percent: float
    mae_filled: float
    psnr_db: float
    ssim: float
    minutes: float
    commit: str
    machine: str


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """A claim of the paper: a setting lowers `measure` by some percent, relative to a reference setting.

    Attributes:
        paper: The paper's words or numbers.
        paper_percent: The paper's claim as one number; None if the paper gives none.
    """

    text: str
    paper: str
    paper_percent: float | None
    claim: str
    reference: str
    changed: str
    measure: str

    @property
    def fair(self) -> bool:
        """Whether the measure means the same for both settings, unlike losses under different exponents."""
        return (self.claim, self.measure) != (ADJUSTMENT, "prediction")


# Table I: end-point error and MAE of the right view, for Sintel, Driving, Monkaa (px) and Propeller (cm).
TABLE_I = {
    "dispnet": ((5.38, 15.62, 5.99, 9.73), (9.87, 13.93, 12.84, 59.34)),
    "densemapnet": ((4.41, 6.56, 4.45, 8.67), (8.34, 9.43, 9.78, 54.69)),
    "psmnet": ((3.85, 8.12, 3.88, 2.38), (7.94, 10.32, 7.36, 41.22)),
    "fast_depth": ((3.95, 6.42, 4.08, 2.32), (7.99, 8.24, 7.93, 37.31)),
}
# Networks in the paper's words.
NAMES = {
    "dispnet": "DispNet",
    "densemapnet": "DenseMapNet",
    "psmnet": "PSMNet",
    "scvnet": "SCV-Net",
    "ganet_11": "GA-Net-11",
    "fast_depth": "the paper's network",
}
# Index of the only column whose target is depth.
_PROPELLER = 3
_COLUMNS = {
    "epe_cm": ("EPE cm", ".1f"),
    "epe_px": ("EPE px", ".2f"),
    "squared_error": ("squared error", ".5f"),
    "mae_filled": ("MAE", ".2f"),
    "mae_sourced": ("MAE of sourced", ".2f"),
    "sourced_percent": ("sourced %", ".1f"),
    "psnr_db": ("PSNR dB", ".2f"),
    "ssim": ("SSIM", ".3f"),
    "minutes": ("minutes", ".1f"),
}
# A measure that a setting is claimed to lower: column, label, the paper's words, percent.
_Measure = tuple[str, str, str, float | None]
# Column of the end-point error in the unit of the target, cm or px.
_EPE = "epe"
_VIEW: _Measure = ("mae_filled", "MAE of the right view", "-", None)
_ADJUSTMENT: tuple[_Measure, ...] = (
    (
        "prediction",
        "validation loss, each in its own code (not comparable)",
        "about 15 %",
        15.0,
    ),
    ("squared_error", "validation loss, codes without exponent", "about 15 %", 15.0),
    (_EPE, "end-point error", "up to 20 %", 20.0),
    _VIEW,
)
# For exponents that the paper does not claim to be the best.
_OTHER_EXPONENT: tuple[_Measure, ...] = ((_EPE, "end-point error", "-", None), _VIEW)
_IN_PX: _Measure = ("epe_px", "end-point error in px", "-", None)
_PROJECTION: tuple[_Measure, ...] = (
    (_EPE, "end-point error", "about 20 %, up to 25 %", 20.0),
    ("prediction", "loss between codes", "about 20 %", 20.0),
    _VIEW,
)
# The paper has no number for the decoder alone: Table I combines it with the two contributions.
_DECODER: tuple[_Measure, ...] = ((_EPE, "end-point error", "-", None), _VIEW)
# Text of a claim, its name in trials.py, reference setting, changed setting, measures.
_Change = tuple[str, str, str, str, tuple[_Measure, ...]]
_CHANGES: tuple[_Change, ...] = (
    ("projection loss", PROJECTION, "without", PAPER, _PROJECTION),
    ("step-wise decoder with skips", DECODER, "upsampled at once, no skips", PAPER, _DECODER),
)
# Run time as a multiple of DenseMapNet's, on GPUs (section IV).
RUN_TIMES = {"fast_depth": 1.05, "densemapnet": 1.0, "dispnet": 2.0, "psmnet": 10.0}


def list_comparisons(depth: bool = False, exponents: Iterable[str] = ()) -> Iterator[Comparison]:
    """Yield the claims that one number can decide.

    Args:
        depth: Whether depth is the target; end-point errors are then in cm.
        exponents: Settings of the depth adjustment to compare with p = 1 in addition to p = 1.5.
    """
    changes = (*_list_exponents(depth, exponents), *_CHANGES, *_rival_changes(depth))
    for text, claim, reference, changed, measures in changes:
        for measure, name, paper, percent in measures:
            yield Comparison(
                text=f"{text}: {name}",
                paper=paper,
                paper_percent=percent,
                claim=claim,
                reference=reference,
                changed=changed,
                measure=("epe_cm" if depth else "epe_px") if measure == _EPE else measure,
            )


def _list_exponents(depth: bool, others: Iterable[str]) -> Iterator[_Change]:
    """Yield the depth adjustments, as rows of _CHANGES."""
    # A code with a larger exponent is finer where depths are small, which an error in cm hardly shows.
    in_px = (_IN_PX,) if depth else ()
    for setting, measures in (("p = 1.5", _ADJUSTMENT), *((other, _OTHER_EXPONENT) for other in others)):
        yield f"depth adjustment, {setting} against 1", ADJUSTMENT, "p = 1", setting, (*measures, *in_px)


def _rival_changes(depth: bool) -> Iterator[_Change]:
    """Yield Table I's claims about each rival, as rows of _CHANGES; with `depth`, only for Propeller.

    SCV-Net and GA-Net, which the paper describes without numbers, are compared without a claim.
    """
    for rival in ("densemapnet", "dispnet", "psmnet", "scvnet", "ganet_11"):
        claim = NETWORKS if rival in ("densemapnet", "dispnet") else NETWORKS_SHORT
        measures = (
            _table_i_measure(rival, 0, _EPE, "end-point error", depth),
            _table_i_measure(rival, 1, "mae_filled", "MAE of the right view", depth),
        )
        yield f"the paper's network against {rival}", claim, rival, "fast_depth", measures


def _table_i_measure(rival: str, column: int, measure: str, name: str, depth: bool) -> _Measure:
    if rival not in TABLE_I:
        return measure, name, "-", None
    numbers = zip(TABLE_I[rival][column], TABLE_I["fast_depth"][column], strict=True)
    less = [reduction_percent(*both) for both in numbers]
    where = "Table I"
    if depth:
        less, where = [less[_PROPELLER]], "Table I, Propeller"
    return measure, name, f"{' '.join(f'{value:z.0f}' for value in less)} % ({where})", float(np.mean(less))


def reduction_percent(reference: float, changed: float) -> float:
    """Return the reduction from `reference` to `changed`, in percent."""
    return 100 * (1 - changed / reference)


def reductions_by_seed(rows: Sequence[PaperRow], comparison: Comparison) -> list[float]:
    """Return the reductions in percent, one for each seed that both settings were trained with."""
    reference, changed = (
        {row.seed: getattr(row, comparison.measure) for row in _select(rows, comparison.claim, setting)}
        for setting in (comparison.reference, comparison.changed)
    )
    shared = sorted(reference.keys() & changed.keys())
    return [reduction_percent(reference[seed], changed[seed]) for seed in shared]


def interval_half_width(values: Sequence[float]) -> float:
    """Return half the width of the mean's 95 % interval, by Student's t; NaN for fewer than two values."""
    if len(values) < 2:
        return float("nan")
    return float(stats.t.ppf(0.975, len(values) - 1) * np.std(values, ddof=1) / np.sqrt(len(values)))


def claims_table(rows: Sequence[PaperRow], depth: bool = False) -> str:
    """Return a Markdown table of the claims: the paper's number, ours, the difference and a verdict.

    With `depth` as the target, end-point errors are in cm, and Table I is compared by its Propeller column.
    """
    lines = [
        "| claim: reduction in percent | paper | here (95 % interval) | difference (points) | verdict |",
        "|---|---|---|---|---|",
    ]
    exponents = {row.setting: row.exponent for row in rows if row.claim == ADJUSTMENT}
    others = [
        name for name in sorted(exponents, key=exponents.__getitem__) if exponents[name] not in (1.0, 1.5)
    ]
    for comparison in list_comparisons(depth, others):
        values = reductions_by_seed(rows, comparison)
        if not values:
            lines.append(f"| {comparison.text} | {comparison.paper} | not run | | |")
            continue
        mean, half = float(np.mean(values)), interval_half_width(values)
        interval = f"{mean - half:z.0f} to {mean + half:z.0f}" if len(values) > 1 else "one seed"
        lines.append(
            f"| {comparison.text} | {comparison.paper} | {mean:z.0f} ({interval}) "
            f"| {_format_difference(mean, comparison.paper_percent, 0)} | {_judge(comparison, mean, half)} |"
        )
    return "\n".join(lines)


def propeller_table(rows: Sequence[PaperRow]) -> str:
    """Return a Markdown table of the networks on our propeller pairs, beside Table I's Propeller column."""
    lines = [
        "| network | steps | seeds | EPE cm: paper | here | difference "
        "| MAE of the right view: paper | here | difference |",
        "|---" * 9 + "|",
    ]
    # A training that serves both claims is listed for each.
    found = {
        (row.model, row.steps, row.seed): row for row in rows if row.claim in (NETWORKS, NETWORKS_SHORT)
    }.values()
    for network, steps in sorted({(row.model, row.steps) for row in found}, key=_table_i_order):
        chosen = [row for row in found if (row.model, row.steps) == (network, steps)]
        cells = [NAMES[network], str(steps), str(len(chosen))]
        for index, measure in enumerate(("epe_cm", "mae_filled")):
            paper = TABLE_I[network][index][_PROPELLER] if network in TABLE_I else None
            here = _mean(chosen, measure)
            cells += [_format_or_dash(paper, ".2f"), f"{here:.2f}", _format_difference(here, paper, 2)]
            cells[-2] += _format_deviation(chosen, measure, ".2f")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def settings_table(rows: Sequence[PaperRow], claim: str, depth: bool = False) -> str:
    """Return a Markdown table of a claim's settings, as means over their seeds, by ascending filled MAE.

    Settings with one seed come last, because a single score cannot be compared with a mean. With `depth` as
    the target, end-point errors are given in cm too.
    """
    columns = {name: column for name, column in _COLUMNS.items() if depth or name != "epe_cm"}
    headings = ["setting", "seeds", *(heading for heading, _ in columns.values())]
    lines = [f"| {' | '.join(headings)} |", "|---" * len(headings) + "|"]
    first = next(iter(columns))
    settings = dict.fromkeys(row.setting for row in rows if row.claim == claim)
    chosen = {name: _select(rows, claim, name) for name in settings}
    ranked = sorted(chosen.items(), key=lambda item: (len(item[1]) == 1, _mean(item[1], "mae_filled")))
    for name, found in ranked:
        numbers = [f"{_mean(found, measure):{digits}}" for measure, (_, digits) in columns.items()]
        numbers[0] += _format_deviation(found, first, columns[first][1])
        lines.append(f"| {name} | {len(found)} | {' | '.join(numbers)} |")
    return "\n".join(lines)


def run_time_table(rows: Iterable[Mapping[str, str]]) -> str:
    """Return a Markdown table of run times, beside the paper's, as multiples of DenseMapNet's.

    Args:
        rows: Rows of the CSV file that `python -m experiments.speed` writes. Networks that have no graph for
            ONNX Runtime and those without a time in the paper have a dash instead.
    """
    columns = (
        "network",
        "parameters",
        "G multiply-adds",
        "PyTorch ms",
        "x DenseMapNet",
        "ONNX Runtime ms",
        "x DenseMapNet",
        "paper: x DenseMapNet",
        "difference for ONNX Runtime",
    )
    lines = [f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]
    for row in rows:
        paper = RUN_TIMES.get(row["network"])
        onnx_relative, onnx_ms = (
            float(row[name]) if row[name] else None for name in ("onnx_relative", "onnx_ms")
        )
        lines.append(
            f"| {NAMES.get(row['network'], row['network'])} | {row['parameters']} "
            f"| {float(row['multiply_adds']) / 1e9:.1f} "
            f"| {float(row['eager_ms']):.0f} | {float(row['eager_relative']):.2f} "
            f"| {_format_or_dash(onnx_ms, '.0f')} | {_format_or_dash(onnx_relative, '.2f')} "
            f"| {_format_or_dash(paper, 'g')} | {_format_difference(onnx_relative, paper, 2)} |"
        )
    return "\n".join(lines)


def _format_deviation(rows: Sequence[PaperRow], measure: str, digits: str) -> str:
    """Return " ± " and the standard deviation over the seeds; an empty string for one seed."""
    values = [getattr(row, measure) for row in rows]
    return f" ± {np.std(values, ddof=1):{digits}}" if len(values) > 1 else ""


def _format_or_dash(value: float | None, digits: str) -> str:
    return "-" if value is None else f"{value:{digits}}"


def _format_difference(here: float | None, paper: float | None, digits: int) -> str:
    return "" if here is None or paper is None else f"{here - paper:+z.{digits}f}"


def _judge(comparison: Comparison, mean: float, half: float) -> str:
    if not comparison.fair:
        return "not a fair test"
    if np.isnan(half):
        return "one seed: no verdict"
    low, high = mean - half, mean + half
    if high < 0:
        return "the opposite"
    if low <= 0:
        return "undecided"
    if comparison.paper_percent is None:
        return "better"
    return "better, but less than claimed" if high < comparison.paper_percent else "holds"


def _table_i_order(trained: tuple[str, int]) -> tuple[int, int]:
    """Return a sort key: the order of Table I's rows with those that it lacks, then the number of steps."""
    return list(NAMES).index(trained[0]), trained[1]


def _select(rows: Iterable[PaperRow], claim: str, setting: str) -> list[PaperRow]:
    return [row for row in rows if row.claim == claim and row.setting == setting]


def _mean(rows: Iterable[PaperRow], measure: str) -> float:
    return float(np.mean([getattr(row, measure) for row in rows]))
