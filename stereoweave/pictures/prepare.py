"""Preparation of pictures for matching: opening, rectification and choice of the camera."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from stereoweave.cameras.alignment import RECTIFY, Alignment, check_pair
from stereoweave.cameras.auto_align import align
from stereoweave.cameras.calibration_files import read_rig
from stereoweave.cameras.diagnosis import CALIBRATE, CALIBRATE_AGAIN, GIVE_DOFFS
from stereoweave.cameras.rectify import Rectified, rectify
from stereoweave.cameras.rig import pair_size_px
from stereoweave.cameras.sphere_windows import PerspectiveWindow
from stereoweave.cameras.spherical import SphereRequest
from stereoweave.errors import Note, Remedy, StereoweaveError
from stereoweave.io.exif import Lens
from stereoweave.pictures.loading import Opened, open_pictures
from stereoweave.pictures.panoramas import SphereView
from stereoweave.stereo import StereoCamera, StereoPair
from stereoweave.system.steps import step

_NO_METRES_ON_CYLINDER = Note(
    "no depth in metres: a window of a 360-degree picture is no perspective image",
    Remedy("take the whole field of view for distances", ("whole",)),
)


@dataclass(frozen=True, kw_only=True)
class Request:
    """User settings for opening and rectifying a pair.

    Attributes:
        format: Layout of one picture with both views, a name in `loading.FORMATS`; default: detected.
        calibration: Calibration file of the two cameras (`calibration_files.read_rig`).
        focal_px, baseline_m: Focal length and baseline, instead of a calibration; default: from the
            pictures' metadata.
        rectify: Whether to rectify the pair, using the calibration or, if there is none, feature matches.
            Default: `align` the pair, unless a calibration, focal length or baseline is given.
        sphere: Projection and window of VR180 and 360-degree pictures.
    """

    format: str | None = None
    calibration: Path | None = None
    focal_px: float | None = None
    baseline_m: float | None = None
    rectify: bool | None = None
    sphere: SphereRequest = SphereRequest()

    def __post_init__(self) -> None:
        if self.calibration and not (self.focal_px is None and self.baseline_m is None):
            raise StereoweaveError(
                f"{self.calibration}: expected either a calibration or focal length and baseline, found both",
                remedy=Remedy("omit one of them", ("calibration", "focal_px", "baseline_m")),
            )

    def complete(self, calibration: Path | None) -> "Request":
        """Return the request with a pair's own calibration, unless the user's settings give a camera."""
        given = (self.calibration, self.focal_px, self.baseline_m)
        if calibration is None or any(value is not None for value in given):
            return self
        return replace(self, calibration=calibration)


@dataclass(frozen=True, kw_only=True)
class Prepared:
    """A pair ready for matching, its picture files, and notes on what was detected or changed.

    `alignment` is the alignment of the pair, if it has been measured. `remedy` is what to do if rows are
    apart nevertheless. `is_new` says whether the left picture may be in no file: the pair was rectified or
    swapped, one picture was turned as the other, or its file holds both views. `sphere` is the window of a
    VR180 or 360-degree picture, and `baseline_m` the distance of its eyes, if known.
    """

    pair: StereoPair
    pictures: tuple[Path, ...]
    notes: tuple[Note, ...] = ()
    alignment: Alignment | None = None
    remedy: Remedy = RECTIFY
    is_new: bool = False
    sphere: SphereView | None = None
    baseline_m: float | None = None


@step("opening the pictures")
def prepare(pictures: Sequence[Path], request: Request) -> Prepared:
    """Open a pair from two pictures (left first) or one picture with both views; rectify it if needed.

    The camera comes from the calibration, from the request, or from the pictures' metadata. The pair has no
    camera if the focal length or the baseline is unknown, if the cameras are not known to be parallel and
    rectification from feature matches did not find them so, or if the camera is from metadata without doffs
    and many disparities are negative.

    Raises:
        StereoweaveError: See `open_pictures`, `read_rig`, `rectify` and `rectify_by_features`; or the request
            gives only one of focal length and baseline, and EXIF lacks the other.
    """
    opened = open_pictures(pictures, request.format, request.sphere)
    if opened.sphere:
        return _prepare_window(pictures, opened, request)
    if request.calibration:
        ready = _apply_calibration(opened.pair, request.calibration, bool(request.rectify))
        return Prepared(
            pair=ready.pair,
            pictures=tuple(pictures),
            notes=(*opened.notes, *ready.notes),
            remedy=CALIBRATE_AGAIN,
            is_new=_is_new(pictures, opened, ready.pair),
        )
    lens = opened.lens or Lens()
    camera, notes = _find_camera(opened.pair, lens, request)
    pair = replace(opened.pair, camera=camera)
    in_metres = request.focal_px is not None or request.baseline_m is not None
    rectified = False if in_metres and request.rectify is None else request.rectify
    found = _align(pair, rectified, parallel=lens.parallel)
    if not in_metres:
        found = _drop_camera_without_doffs(found)
    return Prepared(
        pair=found.pair,
        pictures=tuple(pictures),
        notes=(*opened.notes, *notes, *found.notes),
        alignment=found.alignment,
        remedy=RECTIFY if rectified is False else CALIBRATE,
        is_new=_is_new(pictures, opened, found.pair),
    )


def _prepare_window(pictures: Sequence[Path], opened: Opened, request: Request) -> Prepared:
    """Prepare a window of a VR180 or 360-degree picture, whose focal length and axes are known.

    Only a perspective image is rectified where needed: homographies do not fit others.
    """
    if request.calibration or request.focal_px is not None:
        raise StereoweaveError(
            f"{pictures[0]}: expected no calibration and no focal length, which follow from the projection",
            remedy=Remedy("omit them", ("calibration", "focal_px")),
        )
    assert opened.sphere and opened.lens
    window, pair, notes = opened.sphere.window, opened.pair, list(opened.notes)
    baseline_m = opened.lens.baseline_m if request.baseline_m is None else request.baseline_m
    if baseline_m is not None:
        pair = replace(pair, camera=window.camera(baseline_m))
    is_flat = isinstance(window, PerspectiveWindow)
    if baseline_m is not None and not is_flat and not request.sphere.whole:
        notes.append(_NO_METRES_ON_CYLINDER)
    rectified = request.rectify if is_flat else False
    if request.baseline_m is not None and rectified is None:
        rectified = False
    found = _align(pair, rectified, parallel=True)
    return Prepared(
        pair=found.pair,
        pictures=tuple(pictures),
        notes=(*notes, *found.notes),
        alignment=found.alignment,
        is_new=True,
        sphere=opened.sphere,
        baseline_m=baseline_m,
    )


def _is_new(pictures: Sequence[Path], opened: Opened, ready: StereoPair) -> bool:
    """Return whether the left picture to match may be in no file (see `Prepared`)."""
    return len(pictures) == 1 or opened.turned_alike or ready.left is not opened.pair.left


def _apply_calibration(pair: StereoPair, path: Path, rectified: bool) -> Rectified:
    """Add the calibration's camera to the pair; if requested, rectify the pair with the calibration."""
    rig = read_rig(path, pair_size_px(pair))
    if rectified:
        return rectify(pair, rig)
    rig.check_size(pair_size_px(pair))
    unlike = rig.unlike_rectified()
    if unlike:
        raise StereoweaveError(
            f"{path}: expected a calibration of rectified pictures, found {unlike}",
            remedy=Remedy("rectify the pair with it", ("rectify",)),
        )
    return Rectified(pair=replace(pair, camera=rig.camera()), notes=rig.notes)


def _find_camera(
    pair: StereoPair, lens: Lens, request: Request
) -> tuple[StereoCamera | None, tuple[Note, ...]]:
    """Return the request's camera, completed from the metadata, and a note on these values."""
    focal_px = lens.focal_px if request.focal_px is None else request.focal_px
    baseline_m = lens.baseline_m if request.baseline_m is None else request.baseline_m
    if focal_px is not None and baseline_m is not None:
        camera = StereoCamera.centred(pair.left, focal_px=focal_px, baseline_m=baseline_m)
        if lens.principal_point_px and request.focal_px is None:
            cx_px, cy_px = lens.principal_point_px
            camera = replace(camera, cx_px=cx_px, cy_px=cy_px)
        read = [] if request.focal_px is not None else [f"focal length {focal_px:.0f} px"]
        read += [] if request.baseline_m is not None else [f"baseline {1000 * baseline_m:.1f} mm"]
        read += [] if lens.convergence_px is None else [f"convergence {lens.convergence_px:.0f} px"]
        return camera, (Note(f"from {lens.source}: {', '.join(read)}"),) if read else ()
    if request.focal_px is not None:
        raise StereoweaveError(
            "metres: expected a baseline besides the focal length, found none in metadata",
            remedy=Remedy("give the baseline", ("baseline_m",)),
        )
    if request.baseline_m is not None:
        raise StereoweaveError(
            "metres: expected a focal length besides the baseline, found none in metadata",
            remedy=Remedy("give the focal length", ("focal_px",)),
        )
    return None, ()


@dataclass(frozen=True)
class _Ready:
    pair: StereoPair
    notes: tuple[Note, ...] = ()
    alignment: Alignment | None = None


def _align(pair: StereoPair, rectified: bool | None, *, parallel: bool) -> _Ready:
    """Rectify the pair from feature matches, always, never, or by default where needed.

    If the cameras were not parallel, the rectified pair has no camera, as disparity at infinity is unknown.
    """
    if rectified is False:
        return _Ready(pair)
    aligned = align(pair, always=bool(rectified), parallel=parallel)
    ready = _Ready(aligned.pair, aligned.notes, aligned.alignment)
    if pair.camera is None or ready.pair.camera is not None:
        return ready
    lost = Note(
        "no depth in metres: rectification from feature matches did not find the cameras parallel",
        CALIBRATE,
    )
    return replace(ready, notes=(*ready.notes, lost))


def _drop_camera_without_doffs(ready: _Ready) -> _Ready:
    """Drop a camera whose doffs are unknown if many disparities are negative: its depths would be wrong."""
    pair = ready.pair
    if pair.camera is None:
        return ready
    alignment = ready.alignment or check_pair(pair.left, pair.right)
    if not alignment.needs_doffs:
        return replace(ready, alignment=alignment)
    text = (
        f"no depth in metres: {alignment.negative_percent:.0f} % of the matches have negative disparities, "
        "as from converged cameras, whose doffs are not in metadata"
    )
    return _Ready(
        pair=replace(pair, camera=None),
        notes=(*ready.notes, Note(text, GIVE_DOFFS)),
        alignment=alignment,
    )
