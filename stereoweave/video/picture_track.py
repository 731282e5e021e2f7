"""A series of pictures as a track of frames."""

import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import suppress
from fractions import Fraction
from itertools import islice, pairwise
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from stereoweave.errors import FormatError, Note, Remedy
from stereoweave.io.decoding import ENDINGS
from stereoweave.io.images import read_image
from stereoweave.stereo import StereoCamera
from stereoweave.video.sphere_marks import SphereMark
from stereoweave.video.track_frame import TrackFrame

# Where in a track its `samples` are taken, as shares of its length.
SAMPLED_AT = 0.1, 0.3, 0.5, 0.7, 0.9
# As in printf; the group is the least number of digits.
_NUMBER = re.compile(r"%(?:0?([0-9]+))?d")


class PictureTrack:
    """Frames of a series of pictures, with the attributes of a `VideoTrack` and one more.

    Attributes:
        files: The picture of each frame, in order.

    Raises:
        FormatError: No picture in `files` can be read.
    """

    pixel_aspect = Fraction(1)
    declared_packing: str | None = None
    is_spatial = False
    camera: StereoCamera | None = None
    sphere: SphereMark | None = None
    notes: Sequence[Note] = ()
    own_colours: tuple[int, int, int] | None = None
    retimed: Collection[int] = ()
    sound: Path | None = None
    unknown_sounds = 0
    truncation: str | None = None

    def __init__(self, name: str, files: Sequence[Path], rate: Fraction) -> None:
        self.name = name
        self.files = files
        self.steps: Sequence[int] = range(len(files))
        self.rate, self.time_base = rate, 1 / rate
        first = self._read_first()
        self.size_px = first.shape[1], first.shape[0]

    def frames(self, start: int, first: int = 0) -> Iterator[TrackFrame]:
        """Yield the readable pictures, beginning with the last readable one at or before `start`.

        `first` is ignored, because every picture is a key frame.
        """
        before = next((index for index in range(start, 0, -1) if self._read_frame(index)), 0)
        yield from filter(None, map(self._read_frame, self.steps[before:]))

    def samples(self) -> list[UInt8[np.ndarray, "h w 3"]]:
        """Return one or more images from different parts of the series."""
        starts = [int(share * len(self.files)) for share in (0.0, *SAMPLED_AT)]
        frames = [frame for start in starts for frame in islice(self.frames(start), 1)]
        return [picture for frame in frames for picture in frame.pictures()]

    def _read_first(self) -> UInt8[np.ndarray, "h w 3"]:
        """Return the first picture that can be read."""
        problem: FormatError | None = None
        for file in self.files:
            try:
                return read_image(file)
            except FormatError as error:
                problem = problem or error
        raise FormatError(f"{self.name}: expected pictures, found only unreadable files: {problem}")

    def _read_frame(self, index: int) -> TrackFrame | None:
        picture = self._read_picture(index)
        if picture is None:
            return None
        return TrackFrame(index, lambda: [picture], True, lambda: [picture.astype(np.float32)])

    def _read_picture(self, index: int) -> UInt8[np.ndarray, "h w 3"] | None:
        with suppress(FormatError):
            picture = read_image(self.files[index])
            if self.size_px == (picture.shape[1], picture.shape[0]):
                return picture
        return None


def note_numbers(left: PictureTrack, right: PictureTrack) -> list[Note]:
    """Return a list with a note if a picture seems to be missing in one of two numbered series."""
    numbers = [_read_numbers(track.files) for track in (left, right)]
    steps = [_find_step(found) for found in numbers]
    if None in steps or steps[0] != steps[1]:
        return []
    offsets = [one - other for one, other in zip(*numbers, strict=False)]
    first = next((at for at, offset in enumerate(offsets) if offset != offsets[0]), None)
    if first is None:
        return []
    pair = f"{left.files[first].name} is paired with {right.files[first].name}"
    missing = Remedy("add the missing picture, or remove its counterpart")
    return [Note(f"{pair}: a picture seems to be missing in one of the sequences", missing)]


def _read_numbers(files: Sequence[Path]) -> list[int]:
    """Return the last number in each name; none if a name has none."""
    found = [re.findall(r"\d+", file.stem) for file in files]
    return [int(numbers[-1]) for numbers in found] if all(found) else []


def _find_step(numbers: Sequence[int]) -> int | None:
    """Return the step in which over half of the numbers rise; None if there is none."""
    steps = Counter(after - before for before, after in pairwise(numbers))
    step, count = steps.most_common(1)[0] if steps else (0, 0)
    return step if 2 * count > steps.total() else None


def list_picture_files(path: Path) -> list[Path] | None:
    """Return the pictures in a folder or matching a pattern, in natural order; None for other paths.

    A pattern is a glob, such as left_*.png, or has a number as in FFmpeg and OpenCV, such as left_%03d.png.
    """
    if path.is_dir():
        found: Iterable[Path] = path.iterdir()
    elif not path.exists() and (number := _NUMBER.search(path.name)):
        before, after = (re.escape(part) for part in (path.name[: number.start()], path.name[number.end() :]))
        name = re.compile(rf"{before}[0-9]{{{number[1] or 1},}}{after}")
        found = filter(lambda file: name.fullmatch(file.name), path.parent.glob("*"))
    elif not path.exists() and re.search(r"[*?\[]", path.name):
        found = path.parent.glob(path.name)
    else:
        return None
    return sorted(filter(_is_picture, found), key=_natural_key)


def _is_picture(file: Path) -> bool:
    return file.suffix.lower() in ENDINGS and not file.name.startswith(".")


def _natural_key(file: Path) -> list[tuple[int, str]]:
    parts = re.split(r"(\d+)", file.name)
    return [(int(part), part) if part.isdecimal() else (0, part) for part in parts]
