"""Pictures as they were given become a pair that can be matched: opened, rectified, with its camera."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from stereoweave.cameras.calibration_files import read_rig
from stereoweave.cameras.rectify import Rectified, rectify
from stereoweave.cameras.rectify_uncalibrated import rectify_by_features
from stereoweave.cameras.rig import pair_size_px
from stereoweave.errors import Note, Remedy, StereoweaveError
from stereoweave.io.exif import Lens
from stereoweave.pictures.loading import open_pictures
from stereoweave.stereo import StereoCamera, StereoPair


@dataclass(frozen=True, kw_only=True)
class Request:
    """What a user says about a pair beside its pictures.

    Attributes:
        arrangement: How one picture holds both views, a name in `pictures.FORMATS`; guessed where None.
        calibration: A calibration file of the two cameras (`calibration_files.read_rig`).
        focal_px, baseline_m: Without one, what is known of the cameras; else EXIF may say it.
        rectify: Whether the rows are brought to match: by the calibration, or by features without one.
    """

    arrangement: str | None = None
    calibration: Path | None = None
    focal_px: float | None = None
    baseline_m: float | None = None
    rectify: bool = False

    def __post_init__(self) -> None:
        if self.calibration and not (self.focal_px is None and self.baseline_m is None):
            raise StereoweaveError(
                f"{self.calibration}: expected a calibration, or focal length and baseline given, found both"
            )


@dataclass(frozen=True, kw_only=True)
class Prepared:
    """A pair that can be matched, the files it was read from, and notes on what was detected or changed."""

    pair: StereoPair
    pictures: tuple[Path, ...]
    notes: tuple[Note, ...] = ()


def prepare(pictures: Sequence[Path], request: Request) -> Prepared:
    """The pair of two pictures, left first, or of one that holds both views.

    Its camera comes from the calibration, from what is known by hand, or from EXIF; where none of them says
    both focal length and baseline, or features alone rectified the pair, it has none.

    Raises:
        StereoweaveError: As `open_pictures`, `read_rig`, `rectify` and `rectify_by_features`; or only one of
            focal length and baseline is known though the other one was given.
    """
    opened = open_pictures(pictures, request.arrangement)
    if request.calibration:
        ready = _calibrated(opened.pair, request.calibration, request.rectify)
    else:
        camera, notes = _camera(opened.pair, opened.lens or Lens(), request)
        ready = Rectified(pair=replace(opened.pair, camera=camera), notes=notes)
        if request.rectify:
            ready = _by_features(ready)
    return Prepared(pair=ready.pair, pictures=tuple(pictures), notes=(*opened.notes, *ready.notes))


def _calibrated(pair: StereoPair, path: Path, rectified: bool) -> Rectified:
    """The pair with the camera of a calibration, rectified by it where that is asked for."""
    rig = read_rig(path, pair_size_px(pair))
    if rectified:
        return rectify(pair, rig)
    rig.check_size(pair)
    unlike = rig.unlike_rectified()
    if unlike:
        raise StereoweaveError(
            f"{path}: expected a calibration of rectified pictures, found {unlike}",
            remedy=Remedy("rectify the pair by it", ("rectify",)),
        )
    return Rectified(pair=replace(pair, camera=rig.camera()), notes=rig.notes)


def _camera(pair: StereoPair, lens: Lens, request: Request) -> tuple[StereoCamera | None, tuple[Note, ...]]:
    """The camera of the request, completed from EXIF; and a note on what came from EXIF."""
    focal_px = lens.focal_px if request.focal_px is None else request.focal_px
    baseline_m = lens.baseline_m if request.baseline_m is None else request.baseline_m
    if focal_px is not None and baseline_m is not None:
        camera = StereoCamera.centred(pair.left, focal_px=focal_px, baseline_m=baseline_m)
        from_exif = [] if request.focal_px is not None else [f"focal length {focal_px:.0f} px"]
        from_exif += [] if request.baseline_m is not None else [f"baseline {1000 * baseline_m:.1f} mm"]
        return camera, (Note(f"from EXIF: {', '.join(from_exif)}"),) if from_exif else ()
    if request.focal_px is not None:
        raise StereoweaveError(
            "metres: expected a baseline beside the focal length, found none",
            remedy=Remedy("give the baseline", ("baseline_m",)),
        )
    if request.baseline_m is not None:
        raise StereoweaveError(
            "metres: expected a focal length in EXIF beside the baseline, found none",
            remedy=Remedy("give the focal length", ("focal_px",)),
        )
    return None, ()


def _by_features(ready: Rectified) -> Rectified:
    """The pair rectified by what it shows, without its camera: the turn put in is known but for infinity."""
    rectified = rectify_by_features(ready.pair)
    if ready.pair.camera is None:
        return rectified
    lost = Note("no metres after rectification by features", Remedy("give a calibration", ("calibration",)))
    return replace(rectified, notes=(*rectified.notes, lost))
