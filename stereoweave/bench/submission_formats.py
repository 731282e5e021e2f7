"""Files of a submission to a public benchmark: their names, and what they contain.

Sources: the readme.txt of KITTI's development kits of 2012 and 2015 (`_check_steps`); Middlebury's
submit3/upload-format.html; the section "Result submission" of www.eth3d.net/documentation, with ETH3D's
evaluation program (github.com/ETH3D/two-view-evaluation) and the stereo kit of the Robust Vision Challenge
(github.com/ozendelait/rvc_devkit), which writes such archives for ETH3D, Middlebury and KITTI 2015.
"""

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from stereoweave.data.benchmarks import BenchmarkPair
from stereoweave.errors import StereoweaveError
from stereoweave.io.maps import read_pfm, read_pixels, write_disparity_png, write_pfm

DEFAULT_METHOD = "Stereoweave"
# A name is part of the names of files. "_s" at the end marks a sparse map.
_METHOD = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,39}(?<!_s)")
# Greatest disparity in px that 16 bits hold at 256 steps per px.
_MOST_PNG_PX = 65535 / 256
_PNG_BYTES_A_PIXEL, _PFM_BYTES_A_PIXEL = 3, 4
_HEADER_BYTES = 4096
MOST_TIME_BYTES = 256


@dataclass(frozen=True, kw_only=True)
class SubmissionFormat:
    """What a benchmark's site expects in an archive.

    Attributes:
        map_name: Name of a pair's disparity map, with {pair} and {method}.
        time_name: Name of the file with the pair's run time; None if the site has none.
        time_text: Content of that file, with {seconds}.
        write_map: Function that writes a map of disparities in px [H, W] to a path.
        find_problem: Function that returns what is wrong with a map of a width and height; None if nothing.
        bytes_a_pixel: Greatest number of bytes per pixel of a map.
    """

    map_name: str
    time_name: str | None = None
    time_text: str = "{seconds}"
    write_map: Callable[[Path, Float[np.ndarray, "h w"]], None]
    find_problem: Callable[[Path, tuple[int, int]], str | None]
    bytes_a_pixel: int

    def most_bytes(self, size_px: tuple[int, int]) -> int:
        """Return the greatest size of a valid map in bytes."""
        return self.bytes_a_pixel * math.prod(size_px) + _HEADER_BYTES

    def format_time(self, time_s: float) -> str:
        """Return the content of a time file."""
        return self.time_text.format(seconds=f"{time_s:.6g}")

    def parse_time(self, text: str) -> float | None:
        """Return the seconds that a time file states; None if it is not valid."""
        before, after = self.time_text.split("{seconds}")
        words = text.strip()
        if not (words.startswith(before) and words.endswith(after)):
            return None
        try:
            time_s = float(words.removeprefix(before).removesuffix(after))
        except ValueError:
            return None
        return time_s if math.isfinite(time_s) and time_s > 0 else None


@dataclass(frozen=True, kw_only=True)
class Submission:
    """The pairs of a benchmark, and the files that a submission has for them.

    Attributes:
        dataset: Name in `FORMATS`.
        pairs: The pairs, in the order of the archive.
        method: Name of the method.

    Raises:
        StereoweaveError: The method's name is not made of letters, digits, "_" and "-", ends in "_s", or is
            given for a benchmark whose files are not named after the method.
    """

    dataset: str
    pairs: list[BenchmarkPair]
    method: str = DEFAULT_METHOD

    def __post_init__(self) -> None:
        if not _METHOD.fullmatch(self.method):
            raise StereoweaveError(
                "expected at most 40 letters, digits, '-' and '_', and no '_s' at the end, which marks "
                f"sparse maps, found {self.method!r:.60}",
                setting="method",
            )
        if self.method != DEFAULT_METHOD and "{method}" not in self.format.map_name:
            raise StereoweaveError(
                f"cannot be combined with {self.dataset}, whose files are not named after the method",
                setting="method",
            )

    @property
    def format(self) -> SubmissionFormat:
        """The benchmark's format."""
        return FORMATS[self.dataset]

    def map_file(self, pair: BenchmarkPair) -> str:
        """Return the name of the pair's disparity map in the archive."""
        return self.format.map_name.format(pair=pair.name, method=self.method)

    def time_file(self, pair: BenchmarkPair) -> str | None:
        """Return the name of the pair's time file in the archive; None if the site has none."""
        name = self.format.time_name
        return name and name.format(pair=pair.name, method=self.method)

    def files(self) -> Iterator[str]:
        """Yield the names of all files of the archive."""
        for pair in self.pairs:
            yield self.map_file(pair)
            if time_file := self.time_file(pair):
                yield time_file


def find_method(dataset: str, names: Iterator[str]) -> str:
    """Return the method that the names of an archive's maps contain; the default if it is not exactly one."""
    parts = [part for part in re.split(r"(\{pair\}|\{method\})", FORMATS[dataset].map_name) if part]
    known = {"{pair}": ".+", "{method}": f"(?P<method>{_METHOD.pattern})"}
    pattern = re.compile("".join(known.get(part, re.escape(part)) for part in parts))
    matches = filter(None, map(pattern.fullmatch, names))
    found = {match["method"] for match in matches if "method" in match.groupdict()}
    return found.pop() if len(found) == 1 else DEFAULT_METHOD


def _write_steps(path: Path, disparity_px: Float[np.ndarray, "h w"]) -> None:
    """Write KITTI's map: 16 bits, px * 256, where 0 means that there is no estimate.

    Every pixel has an estimate: disparities below 1/256 px and above 255.996 px become these.
    """
    write_disparity_png(path, np.clip(disparity_px, 0, _MOST_PNG_PX))


def _check_steps(path: Path, size_px: tuple[int, int]) -> str | None:
    """Return what is wrong with KITTI's map.

    "Disparity maps are saved as uint16 PNG images"; a disparity is the value / 256, and 0 means that the
    method has no estimate for the pixel, which KITTI then interpolates.
    """
    steps = read_pixels(path, "I;16")
    return _describe_size(steps.shape, size_px) or _describe_empty(steps > 0)


def _check_dense(path: Path, size_px: tuple[int, int]) -> str | None:
    """Return what is wrong with Middlebury's map, whose name says that no disparity is missing."""
    known = np.isfinite(disparity_px := read_pfm(path))
    if wrong := _describe_size(disparity_px.shape, size_px):
        return wrong
    return None if known.all() else f"expected a number at every pixel, found {np.sum(~known)} without"


def _check_sparse(path: Path, size_px: tuple[int, int]) -> str | None:
    """Return what is wrong with ETH3D's map.

    Pixels that are not finite, or beyond the width, count as missing in ETH3D's evaluation program.
    """
    disparity_px = read_pfm(path)
    known = np.isfinite(disparity_px) & (np.abs(disparity_px) <= size_px[0])
    return _describe_size(disparity_px.shape, size_px) or _describe_empty(known)


def _describe_size(shape: tuple[int, ...], size_px: tuple[int, int]) -> str | None:
    if shape == size_px[::-1]:
        return None
    return f"expected {size_px[0]}x{size_px[1]} pixels, the size of the pictures, found {shape[1]}x{shape[0]}"


def _describe_empty(known: np.ndarray) -> str | None:
    return None if known.any() else "expected disparities, found none at any pixel"


def _make_kitti_format(map_name: str) -> SubmissionFormat:
    return SubmissionFormat(
        map_name=map_name,
        write_map=_write_steps,
        find_problem=_check_steps,
        bytes_a_pixel=_PNG_BYTES_A_PIXEL,
    )


FORMATS = {
    # "Create a zip archive of them and store your results in its root folder".
    "kitti2012": _make_kitti_format("{pair}.png"),
    # "Only the folders disp_0 or flow must be present in the zip file".
    "kitti2015": _make_kitti_format("disp_0/{pair}.png"),
    # No parent folder; "the file must contain only that number".
    "middlebury_v3": SubmissionFormat(
        map_name="{pair}/disp0{method}.pfm",
        time_name="{pair}/time{method}.txt",
        write_map=write_pfm,
        find_problem=_check_dense,
        bytes_a_pixel=_PFM_BYTES_A_PIXEL,
    ),
    "eth3d": SubmissionFormat(
        map_name="low_res_two_view/{pair}.pfm",
        time_name="low_res_two_view/{pair}.txt",
        time_text="runtime {seconds}",
        write_map=write_pfm,
        find_problem=_check_sparse,
        bytes_a_pixel=_PFM_BYTES_A_PIXEL,
    ),
}
"""Formats by the name of the dataset in `data.benchmarks.BENCHMARKS`."""
