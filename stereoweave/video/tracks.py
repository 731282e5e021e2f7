"""Tracks: a video file or a series of pictures, with the times of all frames and the decodable frames."""

from array import array
from collections.abc import Collection, Iterator, Sequence
from contextlib import AbstractContextManager, suppress
from fractions import Fraction
from functools import partial
from itertools import dropwhile, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float32, UInt8

from stereoweave.errors import FormatError, Note, Remedy, StereoweaveError
from stereoweave.stereo import StereoCamera
from stereoweave.video.colours import convert_to_fine, convert_to_rgb, name_hdr, own_colours
from stereoweave.video.packings import FRAME_SEQUENTIAL
from stereoweave.video.picture_track import SAMPLED_AT, PictureTrack, list_picture_files
from stereoweave.video.spatial import RIGHT, Stereo3D, ViewPair, is_spatial, pair_views, read_stereo3d
from stereoweave.video.sphere_marks import read_sphere
from stereoweave.video.streams import decode, drop_corrupt, find_sound_streams, open_stream
from stereoweave.video.timestamps import (
    choose_rate,
    fill_missing,
    number_by_rank,
    number_by_stamp,
    read_stamps,
    separate_duplicates,
)
from stereoweave.video.track_frame import TrackFrame

if TYPE_CHECKING:
    import av

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

# A file counts as cut off if it ends before its declared duration by more than this.
_CUT_OFF_S = Fraction(1, 5)


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
        pixel_aspect: Width of a pixel divided by its height, after that rotation; 1 if unknown.
        declared_packing: Frame packing declared in the file, a packing in `PAIR_LAYOUTS` other than of half
            size, or an unsupported packing; None if the file declares no packing, or is a spatial video.
        is_spatial: Whether the video is a spatial one (MV-HEVC), with each view in a layer of its own.
        camera: Camera of the views of a spatial video, if the file declares it and rotates no views.
        sphere: Projection of a VR180, 360-degree or ordinary video, if the file declares one.
        notes: Notes on views and colours.
        own_colours: Primaries, transfer function and matrix of HDR and of wide colours, by FFmpeg's numbers;
            else None.
        sound: Path of the file if it has sound that can be copied, else None.
        unknown_sounds: Number of its sound tracks of codecs that FFmpeg does not know.
        truncation: Message about a file that ends early; None for a complete file.

    Raises:
        FormatError: The file does not exist, is not a video, or has no frame that can be decoded.
    """

    def __init__(self, path: Path, stream_index: int | None = None) -> None:
        self.name = str(path) if stream_index is None else f"{path}, stream {stream_index}"
        self._path, self._index = path, stream_index
        with self._opening() as (container, stream):
            known = find_sound_streams(container)
            self.sound = path if known else None
            self.unknown_sounds = len(container.streams.audio) - len(known)
            self._read_times(container, stream)
        with self._opening() as (container, stream):
            first = next(drop_corrupt(decode(container, stream)), None)
            if first is None:
                raise FormatError(f"{self.name}: expected a video, found a file without a decodable frame")
            self._describe(first, stream)

    def _opening(self) -> AbstractContextManager[tuple["av.container.InputContainer", "av.VideoStream"]]:
        return open_stream(self._path, self._index)

    def _describe(self, first: "av.VideoFrame", stream: "av.VideoStream") -> None:
        """Set what the first frame says about all frames."""
        self._frame_size_px = first.width, first.height
        self.size_px, self.pixel_aspect = self._frame_size_px, stream.sample_aspect_ratio or Fraction(1)
        if first.rotation % 180:
            self.size_px, self.pixel_aspect = self._frame_size_px[::-1], 1 / self.pixel_aspect
        self.is_spatial = stream.codec_context.name == "hevc" and is_spatial(first)
        declared = read_stereo3d(first) or Stereo3D()
        self._right_first = declared.is_right_first
        self.declared_packing = None if self.is_spatial else _find_packing(first)
        # The file does not say whether field of view and baseline are meant before or after a rotation.
        has_camera = self.is_spatial and first.rotation % 360 == 0
        self.camera = declared.camera(self._frame_size_px) if has_camera else None
        self._packed = declared if first.rotation % 360 == 0 and not self.is_spatial else Stereo3D()
        self.sphere = read_sphere(self.name, first)
        self.notes = [declared.note()] if self.is_spatial else []
        self.own_colours = own_colours(first)
        if hdr := name_hdr(first):
            self.notes.append(Note(f"the video is HDR ({hdr}); it is tone-mapped to SDR (BT.709)"))

    def packed_camera(self, size_px: tuple[int, int]) -> StereoCamera | None:
        """Return the camera that a video with both views in each frame declares for views of this size."""
        return self._packed.camera(size_px)

    def frames(self, start: int, first: int = 0) -> Iterator[TrackFrame]:
        """Yield the frames that can be decoded, in display order, from a key frame at or before `first` on.

        `start` is ignored. The artefacts that follow a damaged frame depend on all frames before it, so only
        decoding from the same key frame yields the same frames in every run.
        """
        with self._opening() as (container, stream):
            if first and self._stamps is not None:
                frames = self._read_after_seek(container, stream, first)
                opening = next(frames, None)
                if opening and opening.number <= first:
                    yield opening
                    yield from frames
                    return
        with self._opening() as (container, stream):
            yield from self._read_frames(container, stream)

    def can_begin(self, most: int) -> bool:
        """Return whether the first decoded images, at most this many, hold a frame with all its views."""
        with self._opening() as (container, stream):
            return next(self._read_frames(container, stream, most), None) is not None

    def _read_after_seek(
        self, container: "av.container.InputContainer", stream: "av.VideoStream", first: int
    ) -> Iterator[TrackFrame]:
        """Seek to the last key frame at or before a frame, and return the frames from a key frame on.

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
        return dropwhile(lambda frame: not frame.is_key_frame, self._read_frames(container, stream))

    def _read_frames(
        self, container: "av.container.InputContainer", stream: "av.VideoStream", most: int | None = None
    ) -> Iterator[TrackFrame]:
        decoded: Iterator[Any] = islice(decode(container, stream), most)
        moments = pair_views(decoded) if self.is_spatial else decoded
        placed = (
            number_by_rank(moments, stream)
            if self._stamps is None
            else number_by_stamp(moments, self._stamps)
        )
        for index, moment in placed:
            views = self._order_views(moment)
            if all(
                not view.is_corrupt and (view.width, view.height) == self._frame_size_px for view in views
            ):
                yield TrackFrame(
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
            pictures += map(convert_to_rgb, islice(drop_corrupt(decode(container, stream)), 1))
            for share in SAMPLED_AT:
                with suppress(av.error.FFmpegError):
                    container.seek(int(share * (container.duration or 0)))
                    pictures += map(convert_to_rgb, islice(drop_corrupt(decode(container, stream)), 1))
        return pictures

    def _read_times(self, container: "av.container.InputContainer", stream: "av.VideoStream") -> None:
        import av

        stamps, end_s, reason = read_stamps(container, stream)
        rate = stream.guessed_rate or Fraction(25)
        self.retimed: Collection[int] = ()
        self.steps: Sequence[int] = range(len(stamps))
        self.time_base = 1 / rate
        self._stamps: Sequence[int] | None = None
        self._lacks_stamps = None in stamps
        # Raw streams and some AVI files have no timestamps. Their frames are timed by order and frame rate.
        if 2 * len(set(stamps) - {None}) > len(stamps):
            self.time_base = Fraction(stream.time_base or 1)
            self._stamps = array("q", sorted(fill_missing(stamps)))
            self.steps, self.retimed = separate_duplicates(self._stamps, round(1 / rate / self.time_base))
        self.rate = choose_rate(self.steps, self.time_base, rate)
        claimed_s = Fraction(container.duration or 0, av.time_base)
        if reason is None and claimed_s > end_s + _CUT_OFF_S:
            reason = f"its declared duration is {float(claimed_s):.1f} s"
        self.truncation = f"{self.name} breaks off after this frame ({reason})" if reason else None


Track = VideoTrack | PictureTrack


def open_track(path: Path, rate: Fraction | None) -> Track:
    """Open a video file, a folder of pictures, or the pictures that match a pattern.

    Args:
        path: File, folder or pattern, such as frames/left_*.png or frames/%03d.png. Pictures are in natural
            order: 2 comes before 10.
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
    first, codec = _read_first_frame(path)
    if first is not None and codec == "hevc" and is_spatial(first):
        return True
    return not spatial_only and _find_packing(first) in FRAME_SEQUENTIAL


def read_declared_packing(path: Path) -> str | None:
    """Return the `declared_packing` of an ordinary video file; None for a file that cannot be decoded."""
    return _find_packing(_read_first_frame(path)[0])


def _read_first_frame(path: Path) -> "tuple[av.VideoFrame | None, str]":
    """Return the first frame that can be decoded, if any, and the name of its codec."""
    with suppress(StereoweaveError), open_stream(path) as (container, stream):
        return next(drop_corrupt(decode(container, stream)), None), stream.codec_context.name
    return None, ""


def _find_packing(first: "av.VideoFrame | None") -> str | None:
    declared = None if first is None else read_stereo3d(first)
    return _name_packing(declared) if declared else None


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
