"""What the paper claims, what was measured here, and the difference."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats  # type: ignore[import-untyped]

from stereoweave.learn.trials import ADJUSTMENT, NETWORKS, NETWORKS_SHORT, PAPER, PROJECTION


@dataclass(frozen=True, kw_only=True)
class PaperRow:
    """What one training of the experiment gave on the held-out pairs.

    Attributes:
        claim, setting: What the training is for; one that serves several claims has a row for each.
        seed: Of first weights, training pairs and their order.
        steps: Of the training; pairs it saw are steps * batch.
        prediction: Loss between codes, as the network was trained with it.
        squared_error: The same between codes without exponent, which can be compared between exponents.
        epe_px, mae_sourced, sourced_percent, mae_filled, psnr_db, ssim: See `ViewRow`.
        minutes: Wall time of the training and of the one it started from, beside others on the same machine.
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
    mae_sourced: float
    sourced_percent: float
    mae_filled: float
    psnr_db: float
    ssim: float
    minutes: float
    commit: str


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """A claim of the paper: how many percent less of `measure` a setting has than the reference.

    Attributes:
        paper: The paper's words or numbers; `paper_percent` is what they come to.
    """

    text: str
    paper: str
    paper_percent: float
    claim: str
    reference: str
    changed: str
    measure: str


# Table I: end-point error and MAE of the right view, for Sintel, Driving, Monkaa (px) and Propeller (cm).
TABLE_I = {
    "dispnet": ((5.38, 15.62, 5.99, 9.73), (9.87, 13.93, 12.84, 59.34)),
    "densemapnet": ((4.41, 6.56, 4.45, 8.67), (8.34, 9.43, 9.78, 54.69)),
    "psmnet": ((3.85, 8.12, 3.88, 2.38), (7.94, 10.32, 7.36, 41.22)),
    "fast_depth": ((3.95, 6.42, 4.08, 2.32), (7.99, 8.24, 7.93, 37.31)),
}
MEASURES = {"epe_px": "end-point error", "mae_filled": "MAE of the right view"}
_COLUMNS = {
    "epe_px": ".2f",
    "squared_error": ".5f",
    "mae_filled": ".2f",
    "mae_sourced": ".2f",
    "sourced_percent": ".1f",
    "psnr_db": ".2f",
    "ssim": ".3f",
    "minutes": ".1f",
}
# What the text claims of a measure: what we call it, the paper's words, percent.
_ADJUSTMENT = {
    "prediction": ("validation loss", "about 15 %", 15.0),
    "squared_error": ("validation loss, codes without exponent", "about 15 %", 15.0),
    "epe_px": ("end-point error", "up to 20 %", 20.0),
}
_PROJECTION = {"epe_px": ("end-point error", "about 20 %, up to 25 %", 20.0)}


def comparisons() -> Iterator[Comparison]:
    """The claims that one number can decide."""
    for measure, (name, paper, percent) in _ADJUSTMENT.items():
        yield Comparison(
            text=f"depth adjustment, p = 1.5 against 1: {name}",
            paper=paper,
            paper_percent=percent,
            claim=ADJUSTMENT,
            reference="p = 1",
            changed="p = 1.5",
            measure=measure,
        )
    for measure, (name, paper, percent) in _PROJECTION.items():
        yield Comparison(
            text=f"projection loss: {name}",
            paper=paper,
            paper_percent=percent,
            claim=PROJECTION,
            reference="without",
            changed=PAPER,
            measure=measure,
        )
    for rival in ("densemapnet", "dispnet", "psmnet"):
        for column, (measure, name) in enumerate(MEASURES.items()):
            numbers = zip(TABLE_I[rival][column], TABLE_I["fast_depth"][column], strict=True)
            less = [less_percent(*both) for both in numbers]
            yield Comparison(
                text=f"the paper's network against {rival}: {name}",
                paper=" ".join(f"{value:z.0f}" for value in less) + " % (Table I)",
                paper_percent=float(np.mean(less)),
                claim=NETWORKS_SHORT if rival == "psmnet" else NETWORKS,
                reference=rival,
                changed="fast_depth",
                measure=measure,
            )


def less_percent(reference: float, changed: float) -> float:
    """How many percent less `changed` is than `reference`."""
    return 100 * (1 - changed / reference)


def by_seed(rows: Sequence[PaperRow], comparison: Comparison) -> list[float]:
    """Percent less, for each seed that both settings were trained with."""
    reference, changed = (
        {row.seed: getattr(row, comparison.measure) for row in rows if _of(row, comparison.claim, setting)}
        for setting in (comparison.reference, comparison.changed)
    )
    return [
        less_percent(reference[seed], changed[seed]) for seed in sorted(reference.keys() & changed.keys())
    ]


def half_width(values: Sequence[float]) -> float:
    """Half of the 95 % interval of the mean, by Student's t over the seeds; NaN for less than two."""
    if len(values) < 2:
        return float("nan")
    return float(stats.t.ppf(0.975, len(values) - 1) * np.std(values, ddof=1) / np.sqrt(len(values)))


def claims_table(rows: Sequence[PaperRow]) -> str:
    """Markdown: what the paper says, what was measured, the difference, and whether that holds here."""
    lines = [
        "| claim: percent less | paper | here (95 % interval) | difference | verdict |",
        "|---|---|---|---|---|",
    ]
    for comparison in comparisons():
        values = by_seed(rows, comparison)
        if not values:
            lines.append(f"| {comparison.text} | {comparison.paper} | not run | | |")
            continue
        mean, half = float(np.mean(values)), half_width(values)
        interval = f"{mean - half:z.0f} to {mean + half:z.0f}" if len(values) > 1 else "one seed"
        lines.append(
            f"| {comparison.text} | {comparison.paper} | {mean:z.0f} ({interval}) "
            f"| {mean - comparison.paper_percent:+z.0f} | {_verdict(mean, half)} |"
        )
    return "\n".join(lines)


def settings_table(rows: Sequence[PaperRow], claim: str) -> str:
    """Markdown: the settings of one claim with the means over their seeds; the lowest filled MAE first."""
    columns = "setting", "seeds", "EPE px", "squared error", "MAE", "MAE of sourced", "sourced %", "PSNR dB"
    lines = [f"| {' | '.join((*columns, 'SSIM', 'minutes'))} |", "|---" * 10 + "|"]
    settings = dict.fromkeys(row.setting for row in rows if row.claim == claim)
    chosen = {name: [row for row in rows if _of(row, claim, name)] for name in settings}
    for name, found in sorted(chosen.items(), key=lambda item: _mean(item[1], "mae_filled")):
        spread = f" ± {np.std([row.epe_px for row in found], ddof=1):.2f}" if len(found) > 1 else ""
        numbers = [f"{_mean(found, measure):{digits}}" for measure, digits in _COLUMNS.items()]
        numbers[0] += spread
        lines.append(f"| {name} | {len(found)} | {' | '.join(numbers)} |")
    return "\n".join(lines)


def _verdict(mean: float, half: float) -> str:
    if np.isnan(half):
        return "one seed: no verdict"
    if mean - half > 0:
        return "holds"
    return "does not hold" if mean + half < 0 else "undecided"


def _of(row: PaperRow, claim: str, setting: str) -> bool:
    return row.claim == claim and row.setting == setting


def _mean(rows: Iterable[PaperRow], measure: str) -> float:
    return float(np.mean([getattr(row, measure) for row in rows]))
