"""Distances over the whole field of view of a VR180 or 360-degree pair, and their files."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8

from stereoweave.cameras.sphere_nearness import MatchedWindow, spread_nearness
from stereoweave.cameras.sphere_windows import BLIND_DEG
from stereoweave.errors import Note, StereoweaveError
from stereoweave.io.colormap import colour_disparity, find_colour_range_px, grey_confidence
from stereoweave.io.files import make_parent_folder, refuse_inputs
from stereoweave.io.images import write_image
from stereoweave.io.maps import write_npy, write_pfm
from stereoweave.io.results_folder import replacing_together
from stereoweave.matching.estimate import match
from stereoweave.outputs.results import DepthJob
from stereoweave.pictures.panoramas import spread_views
from stereoweave.pictures.prepare import Prepared, prepare
from stereoweave.stereo import Estimate
from stereoweave.system.steps import step

FILES = ("distance.pfm", "distance.npy", "distance_preview.png", "distance_confidence.png")
LEFT, FACTS = "panorama_left.png", "distance.json"
_NAMES = (*FILES, LEFT, FACTS)
_MIDDLE_PERCENT = 1, 99


@dataclass(frozen=True, kw_only=True)
class SphereDepth:
    """Equirectangular maps of the left eye.

    Attributes:
        distance: Distance along each pixel's ray, float32 [H, W], in `unit`; NaN where unknown, infinity
            where infinitely far.
        confidence: Confidence, float32 [H, W], 0..1.
        left: The left eye's image, uint8 RGB [H, W, 3].
        unit: "m" if the distance of the eyes is known, else "baselines".
    """

    distance: Float32[np.ndarray, "h w"]
    confidence: Float32[np.ndarray, "h w"]
    left: UInt8[np.ndarray, "h w 3"]
    unit: str


@dataclass(frozen=True, kw_only=True)
class SphereFacts:
    """Numbers about a result, for users.

    Attributes:
        pictures: Names of the pictures.
        projection: Projection of the maps.
        width_px, height_px: Size of the maps.
        unit: Unit of the distances.
        baseline_m: Distance of the eyes; None if unknown.
        distance_p1, distance_p99: Percentiles of the known distances; None for infinity, or if none is known.
        known_percent: Share of the pixels whose distance is known.
    """

    pictures: tuple[str, ...]
    projection: str
    width_px: int
    height_px: int
    unit: str
    baseline_m: float | None
    distance_p1: float | None
    distance_p99: float | None
    known_percent: float


def measure_sphere(prepared: Prepared, estimate: Estimate) -> SphereDepth:
    """Return the distances over the whole field of view from the estimate of its window."""
    view, pair = prepared.sphere, prepared.pair
    assert view is not None
    matched = MatchedWindow(
        view.window, view.window.nearness(estimate.disparity_px), estimate.confidence, pair.left_seen
    )
    found = spread_nearness(matched, view.whole_projection, view.whole_size_px)
    with np.errstate(divide="ignore"):
        distance = (prepared.baseline_m or 1.0) / found.nearness
    return SphereDepth(
        distance=distance.astype(np.float32),
        confidence=found.confidence,
        left=spread_views(view.spreader(), pair.left, None),
        unit="baselines" if prepared.baseline_m is None else "m",
    )


def make_sphere_depth(pictures: Sequence[Path], out: Path, job: DepthJob) -> tuple[SphereFacts, list[Note]]:
    """Write the distances over the whole field of view of a pair to `out`. Returns facts and notes.

    Raises:
        StereoweaveError: The pictures are ordinary ones, or files are asked for that need a window.
    """
    if job.files:
        raise StereoweaveError(
            f"expected no further files for the whole field of view, found {', '.join(job.files)}",
            setting="files",
        )
    make_parent_folder(*(out / name for name in _NAMES))
    refuse_inputs((out / name for name in _NAMES), pictures)
    matcher = job.backend.matcher()
    prepared = prepare(pictures, job.request)
    assert prepared.sphere is not None
    found = measure_sphere(prepared, match(matcher, prepared.pair, job.options))
    facts = _summarize(prepared, found)
    _write(out, found, facts)
    where = "above and below" if prepared.sphere.projection.turns else "to the left and right"
    blind = Note(
        f"beyond {BLIND_DEG:g} degrees {where}, distances are unknown, because hardly any of the eyes' "
        "distance is left there"
    )
    return facts, [*prepared.notes, blind]


def _summarize(prepared: Prepared, found: SphereDepth) -> SphereFacts:
    known = found.distance[~np.isnan(found.distance)]
    low, high = (
        np.percentile(known, _MIDDLE_PERCENT, method="nearest").tolist() if known.size else (np.inf,) * 2
    )
    assert prepared.sphere is not None
    return SphereFacts(
        pictures=tuple(picture.name for picture in prepared.pictures),
        projection=prepared.sphere.whole_projection.name,
        width_px=found.distance.shape[1],
        height_px=found.distance.shape[0],
        unit=found.unit,
        baseline_m=prepared.baseline_m,
        distance_p1=low if np.isfinite(low) else None,
        distance_p99=high if np.isfinite(high) else None,
        known_percent=100 * known.size / found.distance.size,
    )


@step("writing the files")
def _write(out: Path, found: SphereDepth, facts: SphereFacts) -> None:
    known = ~np.isnan(found.distance)
    nearness = np.where(known, 1 / np.where(known, found.distance, 1), 0).astype(np.float32)
    # Nearness has no pixels: scaled so that colours differ as they do for disparities.
    scaled = nearness * 1000 / max(float(nearness.max()), 1e-9)
    range_px = find_colour_range_px(scaled[known][None]) if known.any() else (0.0, 1.0)
    with replacing_together(out, _NAMES, _NAMES, marks=("distance.pfm", FACTS)) as folder:
        write_pfm(folder / "distance.pfm", np.where(known, found.distance, np.inf))
        write_npy(folder / "distance.npy", found.distance)
        write_image(folder / "distance_preview.png", colour_disparity(scaled, range_px) * known[..., None])
        write_image(folder / "distance_confidence.png", grey_confidence(found.confidence))
        write_image(folder / LEFT, found.left)
        (folder / FACTS).write_text(json.dumps(asdict(facts), indent=2, allow_nan=False) + "\n")
