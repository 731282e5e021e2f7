"""From two pictures to an estimate in one call: `stereoweave.estimate`."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from inspect import signature
from pathlib import Path
from typing import Literal

from stereoweave.arguments import as_two_numbers, check_kind, describe
from stereoweave.cameras import auto_align
from stereoweave.cameras.calibration_files import read_rig
from stereoweave.cameras.diagnosis import find_problems
from stereoweave.cameras.rectify import Rectified, rectify
from stereoweave.cameras.rig import pair_size_px
from stereoweave.cameras.spherical import SphereRequest
from stereoweave.cameras.unit_check import note_units
from stereoweave.errors import Note, Remedy, StereoweaveError
from stereoweave.io.arrays import ImageLike, as_rgb
from stereoweave.io.images import check_large_enough
from stereoweave.matching.backend import Backend
from stereoweave.matching.estimate import match
from stereoweave.matching.options import MatchOptions
from stereoweave.matching.providers import CPU
from stereoweave.pictures.loading import open_two
from stereoweave.pictures.panoramas import SphereView, cut_pair
from stereoweave.pictures.prepare import Request, prepare
from stereoweave.stereo import Estimate, StereoPair

_RECTIFY_FIRST = Remedy("give pictures that are rectified by a calibration")


def estimate(  # noqa: PLR0913 - all but the images are keyword-only and optional
    left: ImageLike,
    right: ImageLike | None = None,
    *,
    model: str | Path = "small",
    threads: int | None = None,
    provider: str = CPU,
    refined: bool = False,
    raw: bool = False,
    range_px: tuple[float, float] | None = None,
    align: Literal["auto"] | None = None,
    calibration: str | Path | None = None,
    format: str | None = None,
    projection: str | None = None,
    look_deg: tuple[float, float] | None = None,
    fov_deg: float | None = None,
    lens_fov_deg: float | None = None,
) -> Estimate:
    """Estimate both views' disparities, the confidence and the occlusion mask of a pair.

    Args:
        left: Left image of at least 32x32 px: path, PIL image, RGB array [H, W, 3] or [3, H, W], or PyTorch
            tensor, of uint8, uint16 or floats in 0..1; see `arrays.as_rgb`.
        right: Right image of the same size. Default: `left` is the path of one file with both views, such as
            a spatial photo; the estimate then holds the pair, with its camera if the file tells it.
        model: Name of a shipped network, `best`, or the path of an .onnx matcher file. `base` is always
            refined; `best` runs it again at up to 1.5 times the size and settles edges by vote. The network
            is loaded on the first call and cached.
        threads: Maximum number of threads; default: all cores.
        provider: Execution provider: cpu, cuda, tensorrt, openvino, coreml or directml.
        refined: See `MatchOptions`.
        raw: See `MatchOptions`.
        range_px: See `MatchOptions`.
        align: "auto" for pictures of unknown cameras: if the rows are apart or the sides are swapped, the
            pair is aligned first (`auto_align.align`). The estimate then belongs to the aligned pair, which
            it holds as `pair`, with `notes` on what was changed and on problems that remain, such as two
            pictures of different scenes. Default: the images must be rectified, and are not checked.
        calibration: File with the calibration of both cameras (`read_rig`). The pair is rectified by it if
            the cameras are not parallel. The estimate holds the pair with its camera, and `notes`.
        format: Layout of one file with both views, such as side_by_side. Default: detected.
        projection: Projection of a VR180 or 360-degree file or pair: equirectangular, half_equirectangular,
            fisheye or rectilinear. The estimate then belongs to a window of it, and holds the window's pair.
            Default: detected if `left` is the path of one file, else rectilinear.
        look_deg: Yaw and pitch of the window in degrees; default: straight ahead.
        fov_deg: Field of view of the window in degrees, from 10 to 150; default: 90.
        lens_fov_deg: Field of view of a fisheye lens in degrees; default: as the file says, or 180.

    Raises:
        ValueError: MatcherError for an unknown model or an unavailable provider, ProviderError for a provider
            that fails, and StereoweaveError for invalid images or options.
    """
    with _keeping_own_remedies():
        options = MatchOptions(range_px=range_px, refined=refined, raw=raw)
        backend = Backend(model=model, threads=threads, provider=provider)
        sphere = _request_window(projection, look_deg, fov_deg, lens_fov_deg)
        request = _make_request(align, calibration, format, sphere)
        return _match_given(left, right, backend, options, request)


def _match_given(
    left: ImageLike, right: ImageLike | None, backend: Backend, options: MatchOptions, request: Request
) -> Estimate:
    """Match the pair in one file, in two files, or of two images."""
    if right is None:
        return _match_one_file(left, backend, options, request)
    if isinstance(left, str | Path) and isinstance(right, str | Path):
        return _match_two_files(Path(left), Path(right), backend, options, request)
    given = StereoPair(left=as_rgb(left, "left"), right=as_rgb(right, "right"))
    return _match_images(given, backend, options, request)


def _match_one_file(file: ImageLike, backend: Backend, options: MatchOptions, request: Request) -> Estimate:
    """Match the pair in one file with both views."""
    if not isinstance(file, str | Path):
        raise StereoweaveError(
            f"expected a right image besides a left one that is no path, found {describe(None)}",
            setting="right",
            remedy=Remedy("give it, or the path of one file with both views"),
        )
    prepared = prepare([Path(file)], request)
    found = match(backend.matcher(), prepared.pair, options)
    notes = (*_fit_to_python(prepared.notes), *found.notes)
    if request.rectify is None:
        notes += tuple(find_problems(prepared.pair, found, prepared.alignment, _RECTIFY_FIRST))
    elif request.calibration:
        notes += _note_units(prepared.pair)
    return replace(found, pair=prepared.pair, notes=notes)


def _match_two_files(
    left: Path, right: Path, backend: Backend, options: MatchOptions, request: Request
) -> Estimate:
    """Match the pair in two files."""
    opened = open_two(left, right, panorama=request.sphere.projection is not None)
    found = _match_images(opened.pair, backend, options, request)
    notes = (*_fit_to_python(opened.notes), *found.notes)
    # Callers that read each file alone would get another pair.
    turned = opened.pair if opened.turned_alike else None
    return replace(found, pair=found.pair or turned, notes=notes)


def _match_images(given: StereoPair, backend: Backend, options: MatchOptions, request: Request) -> Estimate:
    """Match two images, or a window of them; rectify or align them first if asked for."""
    if request.format is not None:
        raise StereoweaveError("expected none for two images, found one", setting="format")
    matcher = backend.matcher()
    chosen = request.sphere.choose("two images", None)
    if request.calibration:
        if chosen:
            raise StereoweaveError(
                "expected no calibration, which follows from the projection", setting="calibration"
            )
        rectified = _rectify(given, request.calibration)
        found = match(matcher, rectified.pair, options)
        notes = (*_fit_to_python(rectified.notes), *found.notes, *_note_units(rectified.pair))
        return replace(found, pair=rectified.pair, notes=notes)
    if chosen:
        eye_size_px = given.left.shape[1], given.left.shape[0]
        given = cut_pair(given, SphereView.chosen(chosen, eye_size_px, request.sphere))
    check_large_enough("images", given.left)
    if request.rectify is False:
        found = match(matcher, given, options)
        return replace(found, pair=given) if chosen else found
    ready = auto_align.align(given)
    found = match(matcher, ready.pair, options)
    problems = find_problems(ready.pair, found, ready.alignment, _RECTIFY_FIRST)
    notes = (*_fit_to_python((*ready.notes, *problems)), *found.notes)
    is_given = ready.pair is given and not chosen
    return replace(found, pair=None if is_given else ready.pair, notes=notes)


def _request_window(
    projection: str | None, look_deg: object, fov_deg: float | None, lens_fov_deg: float | None
) -> SphereRequest:
    """Return the request for a window; raise StereoweaveError for values of wrong types."""
    if projection is not None:
        check_kind("projection", projection, str)
    look = None if look_deg is None else as_two_numbers("look_deg", look_deg, "yaw and pitch in degrees")
    return SphereRequest(projection=projection, look_deg=look, fov_deg=fov_deg, lens_fov_deg=lens_fov_deg)


def _make_request(
    align: object, calibration: str | Path | None, format: str | None, sphere: SphereRequest
) -> Request:
    """Return the request for a pair; raise StereoweaveError for a wrong or contradictory alignment."""
    if align is not None and not (isinstance(align, str) and align == "auto"):
        raise StereoweaveError(f"expected 'auto' or None, got {describe(align)}", setting="align")
    if calibration is not None:
        check_kind("calibration", calibration, str, Path)
        if align:
            raise StereoweaveError(
                f"expected either a calibration or align='auto', found both, {calibration}",
                setting="calibration",
            )
    return Request(
        format=format,
        calibration=None if calibration is None else Path(calibration),
        rectify=None if align else calibration is not None,
        sphere=sphere,
    )


def _rectify(pair: StereoPair, calibration: Path) -> Rectified:
    return rectify(pair, read_rig(calibration, pair_size_px(pair)))


def _note_units(pair: StereoPair) -> tuple[Note, ...]:
    return tuple(note_units(pair.camera, pair.left.shape[1])) if pair.camera else ()


def _is_own(remedy: Remedy | None) -> bool:
    """Return whether a remedy names only settings that `estimate` has."""
    return remedy is None or {*signature(estimate).parameters}.issuperset(remedy.settings)


def _fit_to_python(notes: Iterable[Note]) -> tuple[Note, ...]:
    """Return notes without the remedies that name settings which `estimate` does not have."""
    return tuple(note if _is_own(note.remedy) else replace(note, remedy=None) for note in notes)


@contextmanager
def _keeping_own_remedies() -> Iterator[None]:
    """Remove from an error a remedy that names settings which `estimate` does not have."""
    try:
        yield
    except StereoweaveError as error:
        if not _is_own(error.remedy):
            error.remedy = None
        raise
