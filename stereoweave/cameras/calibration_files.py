"""Reading of calibration files from common programs, and writing of OpenCV's format."""

import base64
import contextlib
import math
import re
import reprlib
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from stereoweave.cameras.rig import Optics, Rig, Size, format_size, make_rectified_rig, pair_size_px
from stereoweave.errors import Note, Remedy, StereoweaveError
from stereoweave.io.files import read_small, reading, replacing
from stereoweave.io.structured_text import BASE64, parse_entries
from stereoweave.stereo import StereoPair

_MM_ABOVE = 2.0
_YES, _NO = ("true", "yes", "on", "y"), ("false", "no", "off", "n")
# Rectified pictures may be off-centre, but their principal point is within this share of their sides.
_OFF_CENTRE = 0.2
_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}
_FISHEYE_NAMES = {"fisheye", "equidistant", "equi", "kannalabrandt", "kb4"}
_PINHOLE_NAMES = {"pinhole", "radtan", "plumbbob", "rationalpolynomial", "brownconrady", "none"}
# NumPy types by OpenCV's type names, for base64 data and for decimal data that OpenCV rounds to that type.
_BASE64_TYPES = {"u": "u1", "c": "i1", "w": "<u2", "s": "<i2", "i": "<i4", "f": "<f4", "d": "<f8"}
_ROUNDED = {"h": np.float16, "f": np.float32}
_HEXADECIMAL = re.compile(r"[-+]?0[xX][0-9a-fA-F]{1,16}")
_EXPECTED = "a calibration of two cameras (OpenCV's YAML or XML, Kalibr's camchain, KITTI's or Middlebury's)"


def read_rig(path: str | Path, size_px: Size | None = None) -> Rig:
    """Read the rig from a calibration file, whose format is detected from the content.

    Formats:
        OpenCV's YAML, XML or JSON (cv2.FileStorage), with the entry names from OpenCV's examples (M1, D1, M2,
        D2, R and T) or common variants such as K1 or cameraMatrix1. An extrinsics.yml is completed by the
        intrinsics.yml beside it, and vice versa. If there is no entry translation_unit (m, cm or mm), a
        translation longer than 2 is assumed to be in millimetres and a shorter translation in metres. If
        there is no entry distortion_model, the lens is assumed to be a pinhole.
        Kalibr's camchain.yaml, with cam0 as the left camera and cam1 as the right one.
        KITTI's calib.txt (P0 to P3) and calib_cam_to_cam.txt; the colour cameras 2 and 3 are used if present.
        Middlebury's calib.txt.

    Args:
        path: The file.
        size_px: Width and height of the pictures. KITTI's calib_cam_to_cam.txt also has a calibration for the
            raw pictures, which is used if the pictures have the raw size.

    Raises:
        FormatError: The file is missing, not regular or larger than 256 KB; an entry is missing or invalid;
            or the content is nested more than 20 levels deep or has more than 10,000 values, an anchor, an
            alias or a DTD.
    """
    # Overflows and divisions by 0 give values that are not finite, which are rejected at the end.
    with reading(path, _EXPECTED), np.errstate(all="ignore"):
        text = _read_text(Path(path))
        if re.search(r"^(cam0|doffs|baseline)\s*=", text, re.MULTILINE):
            rig = _parse_middlebury(text)
        # OpenCV names projection matrices P1 and P2 too, but begins them with a tag or a bracket.
        elif re.search(r"^(P\d|P_rect_\d\d|K_\d\d):[ \t]*[-+.\d]", text, re.MULTILINE):
            rig = _parse_kitti(text, size_px)
        elif "cam0" in (entries := parse_entries(text)):
            rig = _parse_kalibr(entries)
        else:
            rig = _parse_opencv(_add_companion(entries, Path(path)))
        return replace(rig, name=str(path), notes=(*rig.notes, *_note_size(rig, size_px)))


def _note_size(rig: Rig, size_px: Size | None) -> list[Note]:
    """Return a note if a rig of unknown size seems to be for pictures of a different size."""
    if rig.size_px or not size_px:
        return []
    centre_px = rig.left.matrix[:2, 2]
    if (np.abs(centre_px / size_px - 0.5) < _OFF_CENTRE).all():
        return []
    column, row = centre_px
    text = (
        f"the calibration seems to be for pictures of another size: its principal point, {column:.0f}, "
        f"{row:.0f}, is far from the centre of {format_size(size_px)}"
    )
    return [
        Note(text, Remedy("scale its focal lengths and principal points with the pictures", ("calibration",)))
    ]


def read_calibration_bytes(path: str | Path) -> bytes:
    """Return the content of a calibration file.

    Raises:
        FormatError: The file is missing, too large or not a regular file.
    """
    with reading(path, _EXPECTED):
        return read_small(path)


def add_camera(pair: StereoPair, path: str | Path) -> StereoPair:
    """Return a rectified pair with the camera from a calibration file for pictures of the same size."""
    rig = read_rig(path, pair_size_px(pair))
    rig.check_size(pair_size_px(pair))
    return replace(pair, camera=rig.camera())


def check_rig_name(path: str | Path) -> None:
    """Raise StereoweaveError if the file extension is not that of YAML."""
    if Path(path).suffix.lower() not in (".yml", ".yaml"):
        found = Path(path).suffix or "none"
        raise StereoweaveError(f"{path}: expected the file extension .yml or .yaml, found {found}")


def write_rig(path: str | Path, rig: Rig) -> None:
    """Write a rig as OpenCV's YAML, from which `read_rig` restores the rig exactly.

    OpenCV's cv2.FileStorage also reads the file. The entries are image_width, image_height, distortion_model,
    M1, D1, M2, D2, R, T and translation_unit.
    """
    check_rig_name(path)
    if rig.left.fisheye != rig.right.fisheye:
        raise StereoweaveError(
            f"{path}: expected two lenses of the same model, found a pinhole and a fisheye lens"
        )
    storage = cv2.FileStorage(".yml", cv2.FileStorage_WRITE | cv2.FileStorage_MEMORY)
    if rig.size_px is not None:
        storage.write("image_width", rig.size_px[0])
        storage.write("image_height", rig.size_px[1])
    storage.write("distortion_model", "fisheye" if rig.left.fisheye else "pinhole")
    for side, optics in (("1", rig.left), ("2", rig.right)):
        storage.write(f"M{side}", optics.matrix)
        storage.write(f"D{side}", optics.distortion.reshape(1, -1))
    storage.write("R", rig.rotation)
    storage.write("T", rig.translation_m.reshape(3, 1))
    storage.write("translation_unit", "m")
    with replacing(path) as temporary:
        temporary.write_text(storage.releaseAndGetString())


def _read_text(path: Path) -> str:
    return read_calibration_bytes(path).decode("utf-8-sig", errors="replace")


# OpenCV and Kalibr


def _add_companion(entries: dict[str, Any], path: Path) -> dict[str, Any]:
    """Add the entries of the companion file, if any, to those of an intrinsics or extrinsics file."""
    for this, other in (("intrinsics", "extrinsics"), ("extrinsics", "intrinsics")):
        beside = path.with_name(path.name.replace(this, other))
        if this in path.name and beside.exists():
            with reading(beside, _EXPECTED):
                return parse_entries(_read_text(beside)) | entries
    return entries


def _parse_opencv(entries: Mapping[str, Any]) -> Rig:
    # Names vary in case and separators: for example, camera_matrix_left and cameraMatrixLeft.
    plain = {_normalise_name(key): value for key, value in entries.items()}
    parts = _parse_opencv_parts(plain)
    model = _find_model(plain)
    left, right = (
        Optics(
            matrix=parts[f"matrix {side}"].reshape(3, 3),
            distortion=parts[f"distortion {side}"].ravel(),
            fisheye=model == "fisheye",
        )
        for side in ("left", "right")
    )
    translation = parts["translation"].reshape(3)
    unit, notes = _find_unit(translation, plain.get("translationunit"))
    if model is None and left.distortion.size == 4:
        notes += (
            Note(
                "the calibration does not state its lens model: a pinhole with k1 k2 p1 p2 is assumed",
                Remedy("add the entry distortion_model: fisheye if that is wrong"),
            ),
        )
    return Rig(
        left=left,
        right=right,
        rotation=parts["rotation"].reshape(3, 3),
        translation_m=translation * _METRES[unit],
        size_px=_find_size(plain),
        notes=notes,
    )


def _parse_opencv_parts(plain: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return the intrinsics and extrinsics, under whichever of their known names the file stores them."""
    found = {
        f"{what} {side}": _find_side(plain, names, sides)
        for side, sides in (("left", ("1", "left", "l")), ("right", ("2", "right", "r")))
        for what, names in (
            ("matrix", ("m", "k", "cm", "cameramatrix", "mtx")),
            ("distortion", ("d", "dist", "distcoeffs", "distortion", "distortioncoefficients")),
        )
    }
    found["rotation"] = _find_first(plain, ("r", "rotation", "rotationmatrix", "rot"))
    found["translation"] = _find_first(plain, ("t", "translation", "translationvector", "trans"))
    missing = [name for name, value in found.items() if value is None]
    if missing:
        raise ValueError(f"no entry for {', '.join(missing)} (M1, D1, M2, D2, R and T are required)")
    return {name: _parse_numbers(value) for name, value in found.items()}


def _normalise_name(word: object) -> str:
    return re.sub(r"[^a-z0-9]", "", str(word).lower())


def _find_first(entries: Mapping[str, Any], names: Iterable[str]) -> Any:
    return next((entries[name] for name in names if name in entries), None)


def _find_side(entries: Mapping[str, Any], names: Iterable[str], sides: Iterable[str]) -> Any:
    pairs = [(name, side) for name in names for side in sides]
    return _find_first(entries, [name + side for name, side in pairs] + [side + name for name, side in pairs])


def _find_model(entries: Mapping[str, Any]) -> str | None:
    """Return the lens model in an OpenCV file, fisheye or pinhole; None if the file does not state it."""
    if _parse_bool(_find_first(entries, ("fisheyemodel", "fisheye")) or "no"):
        return "fisheye"
    named = _find_first(entries, ("distortionmodel", "cameramodel", "model"))
    return None if named is None else _parse_model(named)


def _parse_bool(said: object) -> bool:
    word = str(said).lower()
    if word in _YES or word in _NO:
        return word in _YES
    with contextlib.suppress(ValueError):
        if math.isfinite(number := float(word)):
            return number != 0
    raise ValueError(f"fisheye: {reprlib.repr(said)}, not one of {', '.join(_YES + _NO)} or a number")


def _parse_model(named: object) -> str:
    word = _normalise_name(named)
    if word in _FISHEYE_NAMES:
        return "fisheye"
    if word in _PINHOLE_NAMES:
        return "pinhole"
    raise ValueError(
        f"the unknown lens model {reprlib.repr(named)}; use radtan (pinhole) or equidistant (fisheye)"
    )


def _find_unit(translation: Float[np.ndarray, "3"], stated: object) -> tuple[str, tuple[Note, ...]]:
    """Return the translation's unit of length, and a note if the unit is assumed."""
    if stated is not None:
        if str(stated) not in _METRES:
            raise ValueError(f"translation_unit {reprlib.repr(stated)}, not one of {', '.join(_METRES)}")
        return str(stated), ()
    length = float(np.linalg.norm(translation))
    unit, word = ("mm", "millimetres") if length > _MM_ABOVE else ("m", "metres")
    note = Note(
        f"the calibration does not state its unit of length: the baseline of {length:g} is assumed to be in "
        f"{word}",
        Remedy("add the entry translation_unit: m, cm or mm if that is wrong"),
    )
    return unit, (note,)


def _find_size(entries: Mapping[str, Any]) -> Size | None:
    both = _find_first(entries, ("imagesize", "resolution", "size"))
    if both is None:
        both = [entries.get("image" + side, entries.get(side)) for side in ("width", "height")]
        if None in both:
            return None
    sides_px = _parse_numbers(both).ravel()
    if sides_px.size != 2:
        raise ValueError(f"a picture size {reprlib.repr(both)} instead of width and height")
    width, height = sides_px
    return int(width), int(height)


def _parse_kalibr(entries: Mapping[str, Any]) -> Rig:
    first, second = entries["cam0"], entries.get("cam1")
    if not isinstance(first, dict) or not isinstance(second, dict):
        raise ValueError("no cameras cam0 and cam1")
    transform = second.get("T_cn_cnm1")
    if transform is None:
        raise ValueError("no entry T_cn_cnm1 in cam1, the transform from cam0 to cam1")
    to_right = _parse_numbers(transform).reshape(4, 4)
    left, right = _parse_kalibr_optics("cam0", first), _parse_kalibr_optics("cam1", second)
    return Rig(
        left=left,
        right=right,
        rotation=to_right[:3, :3],
        translation_m=to_right[:3, 3],
        size_px=_find_size({_normalise_name(key): value for key, value in first.items()}),
    )


def _parse_kalibr_optics(name: str, entries: Mapping[str, Any]) -> Optics:
    missing = {"intrinsics", "distortion_coeffs"} - entries.keys()
    if missing:
        raise ValueError(f"no entry {' and no entry '.join(sorted(missing))} in {name}")
    camera, intrinsics = entries.get("camera_model", "pinhole"), _parse_numbers(entries["intrinsics"])
    if camera != "pinhole" or intrinsics.size != 4:
        raise ValueError(
            f"the unsupported camera model {reprlib.repr(camera)} in {name}; "
            "calibrate with pinhole-radtan or pinhole-equi"
        )
    fisheye = _parse_model(entries.get("distortion_model", "radtan")) == "fisheye"
    matrix = _make_camera_matrix(*intrinsics.tolist())
    return Optics(
        matrix=matrix, distortion=_parse_numbers(entries["distortion_coeffs"]).ravel(), fisheye=fisheye
    )


# KITTI and Middlebury


def _parse_kitti(text: str, size_px: Size | None) -> Rig:
    """Parse KITTI's calib.txt or calib_cam_to_cam.txt.

    Source: the development kits of KITTI's raw data, stereo, object and odometry benchmarks.
    """
    lines = (line.split(":", 1) for line in text.splitlines() if ":" in line)
    rows = {
        key.strip(): _parse_numbers(values.split())
        for key, values in lines
        if re.match(r"[PKDRTS]_?(rect_)?\d", key.strip())
    }
    first, second = (2, 3) if {"P3", "P_rect_03", "K_03"} & rows.keys() else (0, 1)
    notes = (Note(f"KITTI's camera {first} is used as the left one and camera {second} as the right one"),)
    raw_px = _find_kitti_size(rows, f"S_{first:02}")
    keys = (f"P_rect_{first:02}", f"P_rect_{second:02}")
    if keys[0] not in rows:
        keys = f"P{first}", f"P{second}"
    if keys[0] not in rows or (size_px is not None and size_px == raw_px):
        return replace(_make_kitti_raw_rig(rows, f"{first:02}", f"{second:02}"), size_px=raw_px, notes=notes)
    left, right = (_require_kitti_row(rows, key).reshape(3, 4) for key in keys)
    return replace(
        make_rectified_rig(left, right, right[0, 3] / right[0, 0] - left[0, 3] / left[0, 0]),
        size_px=_find_kitti_size(rows, f"S_rect_{first:02}"),
        notes=notes,
    )


def _make_kitti_raw_rig(rows: Mapping[str, Float[np.ndarray, " _"]], first: str, second: str) -> Rig:
    """Return the rig for KITTI's raw pictures; the file's poses are relative to camera 0."""
    left, right = (
        Optics(
            matrix=_require_kitti_row(rows, f"K_{number}").reshape(3, 3),
            distortion=_require_kitti_row(rows, f"D_{number}"),
        )
        for number in (first, second)
    )
    left_rotation, right_rotation = (
        _require_kitti_row(rows, f"R_{number}").reshape(3, 3) for number in (first, second)
    )
    rotation = right_rotation @ left_rotation.T
    translation_m = _require_kitti_row(rows, f"T_{second}") - rotation @ _require_kitti_row(
        rows, f"T_{first}"
    )
    return Rig(left=left, right=right, rotation=rotation, translation_m=translation_m)


def _require_kitti_row(rows: Mapping[str, Float[np.ndarray, " _"]], key: str) -> Float[np.ndarray, " _"]:
    if key not in rows:
        raise ValueError(f"no entry {key}")
    return rows[key]


def _find_kitti_size(rows: Mapping[str, Float[np.ndarray, " _"]], key: str) -> Size | None:
    if key not in rows:
        return None
    width, height = rows[key].tolist()
    return int(width), int(height)


def _parse_middlebury(text: str) -> Rig:
    """Parse Middlebury's calib.txt, with cam0=[f 0 cx; 0 f cy; 0 0 1] and the baseline in millimetres.

    Source: the Middlebury stereo datasets of 2014.
    """
    lines = (line.split("=", 1) for line in text.splitlines() if "=" in line)
    entries = {key.strip(): value for key, value in lines}
    missing = {"cam0", "doffs", "baseline", "width", "height"} - entries.keys()
    if missing:
        raise ValueError(f"no entry {', '.join(sorted(missing))}, which a Middlebury calib.txt has")
    rows = entries["cam0"].strip(" []").split(";", 3)  # a fourth row of any length is rejected
    left = _parse_numbers([row.split() for row in rows]).reshape(3, 3)
    right = left + np.array([[0, 0, float(entries["doffs"])], [0, 0, 0], [0, 0, 0]])
    baseline_m = float(entries["baseline"]) / 1000
    if not baseline_m > 0:
        raise ValueError(f"a baseline of {entries['baseline']}, which is not positive")
    size_px = int(entries["width"]), int(entries["height"])
    return replace(make_rectified_rig(left, right, -baseline_m), size_px=size_px)


def _make_camera_matrix(fx: float, fy: float, cx: float, cy: float) -> Float[np.ndarray, "3 3"]:
    return _parse_numbers([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def _parse_numbers(values: Any) -> Float[np.ndarray, "..."]:
    """Parse the numbers of an entry: a single number, a list, a list of rows, or an OpenCV matrix."""
    if isinstance(values, dict) and "data" in values:
        return _parse_matrix(values)
    if isinstance(values, str) and values.startswith(BASE64):
        return _decode_base64(values)
    try:
        return np.asarray(_parse_hexadecimal(values), dtype=np.float64)
    except (TypeError, ValueError) as error:  # for example, TypeError for a dict
        raise ValueError(f"{reprlib.repr(values)} instead of numbers") from error


def _parse_hexadecimal(values: Any) -> Any:
    """Replace hexadecimal strings with numbers."""
    if isinstance(values, list):
        return [_parse_hexadecimal(value) for value in values]
    return int(values, 16) if isinstance(values, str) and _HEXADECIMAL.fullmatch(values) else values


def _parse_matrix(entries: Mapping[str, Any]) -> Float[np.ndarray, "..."]:
    """Parse an OpenCV matrix to float64, with the same values as cv2.FileStorage."""
    written = re.fullmatch(r"(\d*)([A-Za-z])", str(entries.get("dt", "d")))
    if written is None:
        raise ValueError(f"the unsupported matrix type {reprlib.repr(entries['dt'])}")
    numbers = _parse_numbers(entries["data"])
    if written[2] in _ROUNDED:
        numbers = numbers.astype(_ROUNDED[written[2]]).astype(np.float64)
    sides = entries.get("sizes", [entries.get("rows", ""), entries.get("cols", "")])
    shape = [
        *map(int, _parse_numbers(sides).ravel().tolist()),
        int(written[1] or 1),
    ]  # the last one is the number of channels
    if min(shape) < 0 or math.prod(shape) != numbers.size:
        raise ValueError(f"{numbers.size} numbers for a matrix of shape {reprlib.repr(shape)}")
    return numbers.reshape(shape)


def _decode_base64(data: str) -> Float[np.ndarray, " _"]:
    """Decode OpenCV's base64: a header of 24 bytes that states the type, followed by the numbers."""
    content = base64.b64decode(data.removeprefix(BASE64))
    written = re.fullmatch(rb"\d*([a-z]) *", content[:24])
    if written is None or written[1].decode() not in _BASE64_TYPES:
        raise ValueError(f"the unsupported base64 type {content[:24]!r}")
    return np.frombuffer(content, _BASE64_TYPES[written[1].decode()], offset=24).astype(np.float64)
