"""Reading of a video file or a series of pictures: the times of all frames, and the decodable frames."""

import re
from array import array
from bisect import bisect_left
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from fractions import Fraction
from functools import partial
from itertools import count, dropwhile, islice, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float32, UInt8

from stereoweave.errors import FormatError, Note, Remedy, StereoweaveError, require_extra
from stereoweave.io.decoding import ENDINGS
from stereoweave.io.images import read_image
from stereoweave.io.unreadable import check_readable
from stereoweave.stereo import StereoCamera
from stereoweave.video.colours import convert_to_fine, convert_to_rgb, hdr_colours, name_hdr
from stereoweave.video.packings import FRAME_SEQUENTIAL
from stereoweave.video.spatial import RIGHT, Stereo3D, ViewPair, is_spatial, pair_views, read_stereo3d
from stereoweave.video.sphere_marks import SphereMark, read_sphere

if TYPE_CHECKING:
    import av

_SAMPLES = 0.1, 0.3, 0.5, 0.7, 0.9

# AVStereo3DType is one of these, 0 (not stereo) or 8 (unknown).
_STEREO_3D = {
    1: "side_by_side",
    2: "top_bottom",
    3: "frame_sequential",
    4: "checkerboard",
    5: "side_by_side_quincunx",
    6: "row_interleaved",
    7: "column_interleaved",
}

# Type of the first box in an MP4 or MOV file, which follows the four bytes of the box's length.
_MP4_BOXES = b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide", b"pnot"

# FFmpeg's AV_DISPOSITION_ATTACHED_PIC and AV_DISPOSITION_TIMED_THUMBNAILS.
_SINGLE_PICTURES = 0x400 | 0x800

# A file counts as cut off if it ends before its declared duration by more than this.
_CUT_OFF_S = Fraction(1, 5)

Decoded = TypeVar("Decoded", "av.VideoFrame", ViewPair)


class StreamFacts(NamedTuple):
    """What a file says about one of its video streams.

    Attributes:
        number: Index of the stream among all streams of the file.
        size_px: Width and height of its frames.
        rate: Frames per second.
        plane: FFmpeg's tag `stereo_mode`, such as "left_2"; "" if there is none.
    """

    number: int
    size_px: tuple[int, int]
    rate: Fraction
    plane: str


class Shot(NamedTuple):
    """Decoded frame.

    Attributes:
        number: Index of the frame in the track.
        pictures: Function that converts the frame to uint8 RGB [H, W, 3]; of a spatial video, to the left and
            the right view. It is called only for needed frames.
        is_key_frame: Whether the frame can be decoded without any earlier frame.
        fine_pictures: The same pictures with all their bits and in the file's own colours, from 0 to 255.
    """

    number: int
    pictures: Callable[[], Sequence[UInt8[np.ndarray, "h w 3"]]]
    is_key_frame: bool
    fine_pictures: Callable[[], Sequence[Float32[np.ndarray, "h w 3"]]]


class VideoTrack:
    """Frames of one video file, of the stream that FFmpeg finds best or of the one with this index.

    Attributes:
        name: Path as given by the caller, with the index of the stream if it is given.
        steps: Display time of each frame, strictly increasing, in units of `time_base`.
        retimed: Indices of the frames that are shown later because their timestamp was missing or a
            duplicate.
        time_base: Time unit in seconds.
        rate: Average frames per second.
        size_px: Width and height of a whole frame after the rotation that players apply.
        declared_packing: Frame packing declared in the file, a packing in `PAIR_LAYOUTS` other than of half
            size, or an unsupported packing; None if the file declares no packing, or is a spatial video.
        is_spatial: Whether the video is a spatial one (MV-HEVC), with each view in a layer of its own.
        camera: Camera of the views of a spatial video, if the file declares it and rotates no views.
        sphere: Projection of a VR180, 360-degree or ordinary video, if the file declares one.
        notes: Notes on views and colours.
        hdr_colours: Primaries, transfer function and matrix of HDR, by FFmpeg's numbers; else None.
        sound: Path of the file if it has sound, else None.
        truncation: Message about a file that ends early; None for a complete file.

    Raises:
        FormatError: The file does not exist, is not a video, or has no frame that can be decoded.
    """

    def __init__(self, path: Path, stream_index: int | None = None) -> None:
        self.name = str(path) if stream_index is None else f"{path}, stream {stream_index}"
        self._path, self._index = path, stream_index
        with self._opening() as (container, stream):
            self.sound = path if container.streams.audio else None
            self._read_times(container, stream)
        with self._opening() as (container, stream):
            first = next(_drop_corrupt(_decode(container, stream)), None)
            if first is None:
                raise FormatError(f"{self.name}: expected a video, found a file without a decodable frame")
            self._describe(first, stream.codec_context.name)

    def _opening(self) -> AbstractContextManager[tuple["av.container.InputContainer", "av.VideoStream"]]:
        return _opening(self._path, self._index)

    def _describe(self, first: "av.VideoFrame", codec: str) -> None:
        """Set what the first frame says about all frames."""
        self._frame_size_px = first.width, first.height
        self.size_px = self._frame_size_px if first.rotation % 180 == 0 else self._frame_size_px[::-1]
        self.is_spatial = codec == "hevc" and is_spatial(first)
        declared = read_stereo3d(first) or Stereo3D()
        self._right_first = declared.is_right_first
        self.declared_packing = None if self.is_spatial else _name_packing(declared)
        # The file does not say whether field of view and baseline are meant before or after a rotation.
        has_camera = self.is_spatial and first.rotation % 360 == 0
        self.camera = declared.camera(self._frame_size_px) if has_camera else None
        self._packed = declared if first.rotation % 360 == 0 and not self.is_spatial else Stereo3D()
        self.sphere = read_sphere(self.name, first)
        self.notes = [declared.note()] if self.is_spatial else []
        self.hdr_colours = hdr_colours(first)
        if hdr := name_hdr(first):
            self.notes.append(Note(f"the video is HDR ({hdr}); it is tone-mapped to SDR (BT.709)"))

    def packed_camera(self, size_px: tuple[int, int]) -> StereoCamera | None:
        """Return the camera that a video with both views in each frame declares for views of this size."""
        return self._packed.camera(size_px)

    def shots(self, start: int, first: int = 0) -> Iterator[Shot]:
        """Yield the frames that can be decoded, in display order, from a key frame at or before `first` on.

        `start` is ignored. The artefacts that follow a damaged frame depend on all frames before it, so only
        decoding from the same key frame yields the same frames in every run.
        """
        with self._opening() as (container, stream):
            if first and self._stamps is not None:
                shots = self._read_after_seek(container, stream, first)
                opening = next(shots, None)
                if opening and opening.number <= first:
                    yield opening
                    yield from shots
                    return
        with self._opening() as (container, stream):
            yield from self._read_shots(container, stream)

    def can_begin(self, most: int) -> bool:
        """Return whether the first decoded images, at most this many, hold a frame with all its views."""
        with self._opening() as (container, stream):
            return next(self._read_shots(container, stream, most), None) is not None

    def _read_after_seek(
        self, container: "av.container.InputContainer", stream: "av.VideoStream", first: int
    ) -> Iterator[Shot]:
        """Seek to the last key frame at or before a frame, and return the shots from a key frame on.

        Containers without an index may seek to a later one. There are none if timestamps are missing: a frame
        without one is numbered by the frames before it.
        """
        import av

        assert self._stamps is not None
        if self._lacks_stamps:
            return iter(())
        try:
            container.seek(self._stamps[first], stream=stream)
        except av.error.FFmpegError:
            return iter(())
        # Frames before the key frame in display order refer to frames that are not decoded.
        return dropwhile(lambda shot: not shot.is_key_frame, self._read_shots(container, stream))

    def _read_shots(
        self, container: "av.container.InputContainer", stream: "av.VideoStream", most: int | None = None
    ) -> Iterator[Shot]:
        decoded: Iterator[Any] = islice(_decode(container, stream), most)
        moments = pair_views(decoded) if self.is_spatial else decoded
        placed = (
            _number_by_rank(moments, stream)
            if self._stamps is None
            else _number_by_stamp(moments, self._stamps)
        )
        for index, moment in placed:
            views = self._order_views(moment)
            if all(
                not view.is_corrupt and (view.width, view.height) == self._frame_size_px for view in views
            ):
                yield Shot(
                    index,
                    partial(_convert_all, views),
                    moment.key_frame,
                    partial(_convert_all_fine, views),
                )

    def _order_views(self, moment: "av.VideoFrame | ViewPair") -> Sequence["av.VideoFrame"]:
        """Return one frame, or the left and the right view of a spatial video."""
        if not isinstance(moment, ViewPair):
            return (moment,)
        return (moment.other, moment.base) if self._right_first else (moment.base, moment.other)

    def samples(self) -> list[UInt8[np.ndarray, "h w 3"]]:
        """Return one or more images from different parts of the video."""
        import av

        pictures: list[UInt8[np.ndarray, "h w 3"]] = []
        with self._opening() as (container, stream):
            pictures += map(convert_to_rgb, islice(_drop_corrupt(_decode(container, stream)), 1))
            for share in _SAMPLES:
                with suppress(av.error.FFmpegError):
                    container.seek(int(share * (container.duration or 0)))
                    pictures += map(convert_to_rgb, islice(_drop_corrupt(_decode(container, stream)), 1))
        return pictures

    def _read_times(self, container: "av.container.InputContainer", stream: "av.VideoStream") -> None:
        import av

        stamps, end_s, reason = _stamps(container, stream)
        rate = stream.guessed_rate or Fraction(25)
        self.retimed: Collection[int] = ()
        self.steps: Sequence[int] = range(len(stamps))
        self.time_base = 1 / rate
        self._stamps: Sequence[int] | None = None
        self._lacks_stamps = None in stamps
        # Raw streams and some AVI files have no timestamps. Their frames are timed by order and frame rate.
        if 2 * len(set(stamps) - {None}) > len(stamps):
            self.time_base = Fraction(stream.time_base or 1)
            self._stamps = array("q", sorted(_fill_missing(stamps)))
            self.steps, self.retimed = _separate_duplicates(self._stamps, round(1 / rate / self.time_base))
        self.rate = _choose_rate(self.steps, self.time_base, rate)
        claimed_s = Fraction(container.duration or 0, av.time_base)
        if reason is None and claimed_s > end_s + _CUT_OFF_S:
            reason = f"its declared duration is {float(claimed_s):.1f} s"
        self.truncation = f"{self.name} breaks off after this frame ({reason})" if reason else None


class PictureTrack:
    """Frames of a series of pictures, with the attributes of a `VideoTrack`.

    Raises:
        FormatError: No picture in `files` can be read.
    """

    declared_packing: str | None = None
    is_spatial = False
    camera: StereoCamera | None = None
    sphere: SphereMark | None = None
    notes: Sequence[Note] = ()
    hdr_colours: tuple[int, int, int] | None = None
    retimed: Collection[int] = ()
    sound: Path | None = None
    truncation: str | None = None

    def __init__(self, name: str, files: Sequence[Path], rate: Fraction) -> None:
        self.name = name
        self._files = files
        self.steps: Sequence[int] = range(len(files))
        self.rate, self.time_base = rate, 1 / rate
        first = self._read_first()
        self.size_px = first.shape[1], first.shape[0]

    def shots(self, start: int, first: int = 0) -> Iterator[Shot]:
        """Yield the readable pictures, beginning with the last readable one at or before `start`.

        `first` is ignored, because every picture is a key frame.
        """
        before = next((index for index in range(start, 0, -1) if self._read_shot(index)), 0)
        yield from filter(None, map(self._read_shot, self.steps[before:]))

    def samples(self) -> list[UInt8[np.ndarray, "h w 3"]]:
        """Return one or more images from different parts of the series."""
        starts = [int(share * len(self._files)) for share in (0.0, *_SAMPLES)]
        shots = [shot for start in starts for shot in islice(self.shots(start), 1)]
        return [picture for shot in shots for picture in shot.pictures()]

    def _read_first(self) -> UInt8[np.ndarray, "h w 3"]:
        """Return the first picture that can be read."""
        problem: FormatError | None = None
        for file in self._files:
            try:
                return read_image(file)
            except FormatError as error:
                problem = problem or error
        raise FormatError(f"{self.name}: expected pictures, found only unreadable files: {problem}")

    def _read_shot(self, index: int) -> Shot | None:
        picture = self._read_picture(index)
        if picture is None:
            return None
        return Shot(index, lambda: [picture], True, lambda: [picture.astype(np.float32)])

    def _read_picture(self, index: int) -> UInt8[np.ndarray, "h w 3"] | None:
        with suppress(FormatError):
            picture = read_image(self._files[index])
            if self.size_px == (picture.shape[1], picture.shape[0]):
                return picture
        return None


Track = VideoTrack | PictureTrack


def open_track(path: Path, rate: Fraction | None) -> Track:
    """Open a video file, a folder of pictures, or the pictures that match a glob pattern.

    Args:
        path: File, folder or pattern, such as frames/left_*.png. Pictures are in natural order: 2 comes
            before 10.
        rate: Frame rate for pictures, in frames per second. Default: 25.

    Raises:
        FormatError: The path does not exist, contains no pictures, or contains nothing that can be read.
        StereoweaveError: `rate` is given for a video.
    """
    files = list_picture_files(path)
    if files is None:
        if rate is not None:
            raise StereoweaveError(
                f"{path}: expected pictures, found a video, which has a rate of its own",
                remedy=Remedy("leave the rate out", ("rate",)),
            )
        return VideoTrack(path)
    if not files:
        raise FormatError(
            f"{path}: expected at least one picture, found none; name a folder that holds pictures"
        )
    return PictureTrack(str(path), files, rate or Fraction(25))


def shows_one_view(path: Path, *, spatial_only: bool = False) -> bool:
    """Return whether a file says that each frame shows one view: of a spatial video, or of two views in turn.

    False for a file that cannot be decoded.
    """
    with suppress(StereoweaveError), _opening(path) as (container, stream):
        first = next(_drop_corrupt(_decode(container, stream)), None)
        if first is not None and stream.codec_context.name == "hevc" and is_spatial(first):
            return True
        declared = None if spatial_only or first is None else read_stereo3d(first)
        return declared is not None and _name_packing(declared) in FRAME_SEQUENTIAL
    return False


def list_picture_files(path: Path) -> list[Path] | None:
    """Return the pictures in a folder or matching a glob pattern, in natural order; None for other paths."""
    if path.is_dir():
        found = path.iterdir()
    elif not path.exists() and re.search(r"[*?\[]", path.name):
        found = path.parent.glob(path.name)
    else:
        return None
    return sorted(filter(_is_picture, found), key=_natural_key)


def list_video_streams(path: Path) -> list[StreamFacts]:
    """Return the video streams of a file, without those that hold a cover or nothing.

    Raises:
        FormatError: The file cannot be opened.
    """
    with open_container(path) as container:
        return [
            StreamFacts(
                number=stream.index,
                size_px=(stream.codec_context.width, stream.codec_context.height),
                rate=stream.guessed_rate or Fraction(25),
                plane=stream.metadata.get("stereo_mode", ""),
            )
            for stream in container.streams.video
            if stream.codec_context is not None
            and stream.codec_context.width * stream.codec_context.height > 0
            and not stream.disposition & _SINGLE_PICTURES
        ]


def open_container(path: Path) -> "av.container.InputContainer":
    """Open a video file. Raises FormatError."""
    check_readable(path, "a video")
    with require_extra("video", f"{path}: reading video needs PyAV"):
        import av
    try:
        return av.open(str(path), metadata_errors="replace")
    except av.error.FFmpegError as error:
        raise FormatError(f"{path}: expected a video, found {_describe_unopened(path, error)}") from error


@contextmanager
def _opening(
    path: Path, index: int | None = None
) -> Iterator[tuple["av.container.InputContainer", "av.VideoStream"]]:
    with open_container(path) as container:
        import av

        stream = container.streams.best("video") if index is None else container.streams[index]
        if not isinstance(stream, av.VideoStream) or stream.codec_context is None:
            raise FormatError(f"{path}: expected a video, found a file without a decodable video track")
        # With several threads, FFmpeg conceals damage in H.264 poorly, if at all, and not reproducibly.
        stream.codec_context.thread_count = 1
        stream.codec_context.copy_opaque = True  # passes the packet's rank on to the frame
        if stream.codec_context.name == "hevc":
            stream.codec_context.options = {"view_ids": "-1"}  # both views of a spatial video
        if stream.codec_context.name == "mjpeg":
            # By default, the decoder returns truncated pictures, grey at the bottom, as if they were intact.
            stream.codec_context.options = {"err_detect": "explode"}
        yield container, stream


def _decode(container: "av.container.InputContainer", stream: "av.VideoStream") -> Iterator["av.VideoFrame"]:
    """Yield the decoded frames in display order, up to the end of the file or unrecoverable damage."""
    import av

    ranks = count()
    with suppress(av.error.FFmpegError):
        for packet in container.demux(stream):
            if _is_frame(packet):
                packet.opaque = next(ranks)
            with suppress(av.error.FFmpegError):
                yield from stream.decode(packet)
    # If the file was read to its end, the decoder is already flushed and raises an error.
    with suppress(av.error.FFmpegError):
        yield from stream.decode(None)


def _stamps(
    container: "av.container.InputContainer", stream: "av.VideoStream"
) -> tuple[list[int | None], Fraction, str | None]:
    """Return all timestamps of a stream, the latest end of any track, and the reason for an early stop.

    The end is in seconds. The reason is None if the whole file could be read.
    """
    import av

    stamps: list[int | None] = []
    end_s = Fraction(0)
    try:
        for packet in container.demux():
            if packet.stream is stream and _is_frame(packet):
                stamps.append(packet.pts)
            if packet.pts is not None and packet.time_base:
                end_s = max(end_s, (packet.pts + (packet.duration or 0)) * packet.time_base)
    except av.error.FFmpegError as error:
        return stamps, end_s, _describe_error(error)
    return stamps, end_s, None


def _is_frame(packet: "av.Packet[Any]") -> bool:
    return bool(packet.size) and not packet.is_discard


def _fill_missing(stamps: Sequence[int | None]) -> list[int]:
    """Replace each missing timestamp with the last known timestamp before it in the file."""
    known = next(stamp for stamp in stamps if stamp is not None)
    return [known := known if stamp is None else stamp for stamp in stamps]


def _separate_duplicates(stamps: Sequence[int], frame_steps: int) -> tuple["array[int]", list[int]]:
    """Make sorted timestamps strictly increasing by delaying duplicates.

    A duplicate is delayed by the usual interval, or by half the time to the next frame if that is shorter.

    Args:
        stamps: Sorted timestamps, in units of a time base.
        frame_steps: Usual interval between frames, in the same units.

    Returns:
        The new times, and the indices of the delayed frames.
    """
    steps, retimed = array("q", stamps[:1]), []
    later = [b for a, b in pairwise(stamps) if b > a]
    after = 0
    for index in range(1, len(stamps)):
        if stamps[index] > stamps[index - 1]:
            after += 1
            steps.append(max(stamps[index], steps[-1] + 1))
            continue
        room = (later[after] - steps[-1]) // 2 if after < len(later) else frame_steps
        steps.append(steps[-1] + max(min(frame_steps, room), 1))
        retimed.append(index)
    return steps, retimed


def _number_by_stamp(frames: Iterator[Decoded], stamps: Sequence[int]) -> Iterator[tuple[int, Decoded]]:
    """Yield each frame with its index, found by timestamp. Frames with equal timestamps keep their order."""
    last = -1
    for frame in frames:
        stamp = stamps[max(last, 0)] if frame.pts is None else frame.pts
        index = max(bisect_left(stamps, stamp), last + 1)
        if index < len(stamps) and stamps[index] == stamp:
            yield index, frame
            last = index


def _number_by_rank(frames: Iterator[Decoded], stream: "av.VideoStream") -> Iterator[tuple[int, Decoded]]:
    """Yield each frame with its index, found by the position of its packet among all packets.

    Without B-frames, a lost frame is noticed at the next frame; with B-frames, only at the next key frame.
    """
    index = -1
    for frame in frames:
        ranked: Any = frame
        in_turn = frame.key_frame or not stream.codec_context.has_b_frames
        index = max(index + 1, ranked.opaque) if in_turn and ranked.opaque is not None else index + 1
        yield index, frame


def _drop_corrupt(frames: Iterator["av.VideoFrame"]) -> Iterator["av.VideoFrame"]:
    return (frame for frame in frames if not frame.is_corrupt)


def _describe_unopened(path: Path, error: "av.error.FFmpegError") -> str:
    """Describe what was found instead of a video, for an error message."""
    beginning = b""
    with suppress(OSError), path.open("rb") as file:
        beginning = file.read(8)
        if not beginning:
            return "an empty file"
    found = f"none that FFmpeg can open ({_describe_error(error)})"
    if beginning[4:] in _MP4_BOXES:
        found += "; if the file was cut off, its index is lost: record or download it again"
    return found


def _describe_error(error: "av.error.FFmpegError") -> str:
    return (error.strerror or "error in FFmpeg").lower()


def _convert_all(views: Sequence["av.VideoFrame"]) -> list[UInt8[np.ndarray, "h w 3"]]:
    return [convert_to_rgb(view) for view in views]


def _convert_all_fine(views: Sequence["av.VideoFrame"]) -> list[Float32[np.ndarray, "h w 3"]]:
    return [convert_to_fine(view) for view in views]


def _name_packing(declared: Stereo3D) -> str | None:
    name = _STEREO_3D.get(declared.kind)
    right_first = {None: None, "side_by_side": "crossed"}
    # Of a frame sequence, each H.264 frame says which view it is; the caller gives the first one.
    is_inverted = declared.is_inverted != (name == "frame_sequential" and declared.view == RIGHT)
    return right_first.get(name, f"{name}_right_first") if is_inverted else name


def _choose_rate(steps: Sequence[int], time_base: Fraction, average: Fraction) -> Fraction:
    """Return the container's frame rate, or the measured rate if the two differ by more than 1 %."""
    if len(steps) < 2:
        return average
    measured = Fraction(len(steps) - 1) / ((steps[-1] - steps[0]) * time_base)
    return average if abs(average / measured - 1) <= Fraction(1, 100) else measured


def _is_picture(file: Path) -> bool:
    return file.suffix.lower() in ENDINGS and not file.name.startswith(".")


def _natural_key(file: Path) -> list[tuple[int, str]]:
    parts = re.split(r"(\d+)", file.name)
    return [(int(part), part) if part.isdecimal() else (0, part) for part in parts]
