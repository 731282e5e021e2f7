"""What `depth` writes of a pair: maps, pictures of them, and the report."""

import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from stereoweave.colour import colour_disparity, colour_range_px, grey_confidence
from stereoweave.hints import hints
from stereoweave.io import RangeError, place_for, write_depth_png, write_disparity_png, write_image, write_pfm
from stereoweave.matcher import Matcher
from stereoweave.preparing import Request, prepare
from stereoweave.report import Summary, summarize, write_report
from stereoweave.stereo import Estimate, StereoPair

FILES = ("disparity.pfm", "disparity.png", "depth.png", "preview.png", "confidence.png", "report.html")


@dataclass(frozen=True, kw_only=True)
class DepthOrder:
    """What is to be made of every pair: what is said of the pictures, with which network and how."""

    request: Request = Request()
    model: str = "small"
    threads: int | None = None


def make_depth(
    pictures: Sequence[Path], out: Path, order: DepthOrder, matcher: Matcher
) -> tuple[Summary, list[str]]:
    """Writes the results of a pair into the folder `out`, all or none; its numbers, and lines to tell."""
    prepared = prepare(pictures, order.request)
    pair = prepared.pair
    with _results_in(out) as folder:
        start_s = time.perf_counter()
        estimate = matcher.estimate(pair.left, pair.right)
        estimate_ms = 1000 * (time.perf_counter() - start_s)
        names = tuple(picture.name for picture in pictures)
        summary = summarize(pair, estimate, pictures=names, model=order.model, estimate_ms=estimate_ms)
        notes = [*prepared.notes, *_write_maps(folder, pair, estimate, summary)]
        notes += hints(pair, estimate, matcher)
        write_report(folder / "report.html", pair, estimate, summary, order.threads)
    return summary, notes


@contextmanager
def _results_in(out: Path) -> Iterator[Path]:
    """A temporary folder, whose files move into `out` in the end; after an error nothing of either is left.

    Files of an earlier result that this one does not have are removed, so that all in `out` belong together.
    """
    standing = place_for(*(out / file for file in FILES))
    with tempfile.TemporaryDirectory(prefix=".stereoweave-", dir=standing) as name:
        yield Path(name)
        out.mkdir(parents=True, exist_ok=True)
        for file in FILES:
            fresh = Path(name, file)
            fresh.replace(out / file) if fresh.exists() else (out / file).unlink(missing_ok=True)


def _write_maps(folder: Path, pair: StereoPair, estimate: Estimate, summary: Summary) -> list[str]:
    """Writes every map and picture; the lines that say which of them could not be, and why."""
    notes = []
    write_pfm(folder / "disparity.pfm", estimate.disparity_px)
    try:
        write_disparity_png(folder / "disparity.png", estimate.disparity_px)
    except RangeError:
        notes.append(
            "no disparity.png: it holds 0 to 255.99 px, found "
            f"{summary.disparity_min_px:.2f} to {summary.disparity_max_px:.2f} px; disparity.pfm has them"
        )
    if pair.camera:
        write_depth_png(folder / "depth.png", pair.camera.depth_m(estimate.disparity_px))
    preview = colour_disparity(estimate.disparity_px, colour_range_px(estimate.disparity_px))
    write_image(folder / "preview.png", preview)
    write_image(folder / "confidence.png", grey_confidence(estimate.confidence))
    return notes
