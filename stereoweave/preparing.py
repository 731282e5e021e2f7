"""Pictures as they were given become a pair that can be matched."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from stereoweave.errors import StereoweaveError
from stereoweave.io import calibrated, read_pair, read_side_by_side
from stereoweave.stereo import StereoPair


@dataclass(frozen=True, kw_only=True)
class Request:
    """What a user says about a pair beside its pictures.

    Attributes:
        arrangement: How the pictures hold the two views, a name in `pictures.FORMATS`; guessed where None.
        calibration: A calibration file of the two cameras.
        focal_px, baseline_m: What is known of the cameras without one.
        rectify: Whether the rows are brought to match: by the calibration, or by features without one.
    """

    arrangement: str | None = None
    calibration: Path | None = None
    focal_px: float | None = None
    baseline_m: float | None = None
    rectify: bool = False


@dataclass(frozen=True, kw_only=True)
class Prepared:
    """A pair that can be matched, and what was found and done on the way, in a line each."""

    pair: StereoPair
    notes: tuple[str, ...] = ()


def prepare(pictures: Sequence[Path], request: Request) -> Prepared:
    """The pair of two pictures, left first, or of one that holds both views."""
    match pictures:
        case [left, right]:
            pair = read_pair(left, right)
        case [both]:
            pair = read_side_by_side(both)
        case _:
            names = " ".join(map(str, pictures))
            raise StereoweaveError(
                f"expected LEFT RIGHT or SIDE_BY_SIDE, one or two pictures, found {len(pictures)}: {names}"
            )
    return Prepared(pair=calibrated(pair, request.calibration) if request.calibration else pair)
