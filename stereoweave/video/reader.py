"""Reading of stereo videos as timed pairs of frames, for all supported frame packings."""

import copy
import math
from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8

from stereoweave.arguments import check_choice
from stereoweave.cameras.rectify import plan_rectification
from stereoweave.cameras.rig import Rig, format_size
from stereoweave.cameras.spherical import SphereRequest
from stereoweave.errors import FormatError, Note, Remedy, StereoweaveError
from stereoweave.io.images import SMALLEST_SIDE_PX
from stereoweave.pictures.interleaved import InterleavedLayout
from stereoweave.pictures.pair_layouts import PAIR_LAYOUTS, PairLayout, detect_layout
from stereoweave.pictures.panoramas import SphereView, choose_layout, guess_projection
from stereoweave.video.frame_sequence import FrameSequence
from stereoweave.video.mvc import check_not_mvc
from stereoweave.video.packings import FRAME_PACKINGS, FRAME_SEQUENTIAL, TWO_STREAMS
from stereoweave.video.picture_track import PictureTrack, list_picture_files, note_numbers
from stereoweave.video.times import format_frame_time
from stereoweave.video.track_frame import TrackFrame
from stereoweave.video.tracks import Track, VideoTrack, open_track
from stereoweave.video.twin_streams import open_twins

# A spatial or frame-sequential video is refused if none of this many images is followed by its second
# view.
_MOST_ALONE = 300

_REPEATED_LAST, _REPEATED_NEXT = (
    "damaged: replaced by the frame before it",
    "damaged: replaced by the frame after it",
)
_AFTER_DAMAGE = "decoded from a damaged frame before it"
# Error of a time that is given in seconds with three decimals.
_ROUNDED_S = 0.0005
_RETIMED = "its timestamp was missing or a duplicate, so it is shown slightly later"


FinePair = tuple[np.ndarray, np.ndarray]
Remap = Callable[[np.ndarray], np.ndarray]
_Source = Track | FrameSequence


class StereoFrame(NamedTuple):
    """Pair of frames from a video.

    Attributes:
        left, right: uint8 RGB [H, W, 3].
        time: Exact time since the start of the video, in seconds.
        problem: Description of damage to this frame, of a changed timestamp, of two frames that are apart,
            or of an early end of the video; None if there is no problem.
        fine: Function that returns left and right with all their bits and in the file's own colours, HDR too,
            float32 RGB from 0 to 255; None unless the video reads them.
    """

    left: UInt8[np.ndarray, "h w 3"]
    right: UInt8[np.ndarray, "h w 3"]
    time: Fraction
    problem: str | None
    fine: Callable[[], FinePair] | None = None

    def change_fine(self, change: Callable[[FinePair], FinePair]) -> "StereoFrame":
        """Return the frame with a change of its fine pictures, which is made when they are needed."""
        fine = self.fine
        return self if fine is None else self._replace(fine=lambda: change(fine()))


class StereoVideo:
    """Stereo video that yields pairs of frames with their times; opened by `open_video`.

    Attributes:
        name: Paths of the files, as given by the caller.
        frame_packing: Frame packing, a name in `FRAME_PACKINGS`; None for two files, and for a spatial video.
        size_px: Width and height of each eye's image at full size.
        pixel_aspect: Width of a pixel of this image divided by its height.
        frame_count: Number of frames that `frames` yields, including damaged frames. For two files with
            different numbers of frames, this is the lower number.
        rate: Average frames per second.
        time_base: Time unit in seconds; every frame time is a multiple of this unit.
        camera: Camera of the views, as the file declares it or by a calibration; None if it is unknown.
        sound: File that contains the sound; None for a silent video.
        unknown_sounds: Number of a file's sound tracks that cannot be copied, as FFmpeg does not know them.
        excerpted: Name of the part of a longer video that this is, such as "1440+120" for 120 frames from
            frame 1440 on; None for a whole video.
        notes: Notes on views and colours, and on the column or row that is dropped from frames of odd width
            or height.
        declared_sphere: Projection of a VR180, 360-degree or ordinary video, if the file declares one.
        sphere: Of a VR180 or 360-degree video, the window that its frames show; see `show`.
        baseline_m: Distance of the eyes of such a video; None if it is unknown.
        rig: Calibration by which the frames are rectified; see `rectify`.
        own_colours: Primaries, transfer function and matrix of HDR and of wide colours, by FFmpeg's numbers;
            None for others.
        on_frame: Function that `frames` calls with the number of each frame that it yields, to show progress.
    """

    def __init__(
        self, tracks: Sequence[_Source], frame_packing: str | None, notes: Sequence[Note] = ()
    ) -> None:
        """Combine a left and a right track, or split one track with both eyes in each frame.

        Without a frame packing in `PAIR_LAYOUTS`, a single track must be spatial or a `FrameSequence`.
        """
        self._tracks = tracks
        self._split = PAIR_LAYOUTS.get(frame_packing or "")
        first = tracks[0]
        self.name = ", ".join(track.name for track in tracks)
        self.frame_packing = frame_packing
        self.size_px = self._split.eye_size_px(*first.size_px) if self._split else first.size_px
        self.pixel_aspect = _find_pixel_aspect(self._split, first.pixel_aspect)
        odd = self._split.note_odd_size(*first.size_px) if self._split else []
        self.notes = (*notes, *first.notes, *odd)
        self.camera = first.camera
        if self._split and isinstance(first, VideoTrack):
            self.camera = first.packed_camera(self.size_px)
        self.frame_count = min(len(track.steps) for track in tracks)
        self.rate, self.time_base = first.rate, first.time_base
        self.sound = next((track.sound for track in tracks if track.sound), None)
        self.unknown_sounds = max(track.unknown_sounds for track in tracks)
        self.on_frame: Callable[[int], None] = lambda number: None
        self.excerpted: str | None = None
        self.declared_sphere = first.sphere
        self.sphere: SphereView | None = None
        self.baseline_m: float | None = None
        self.rig: Rig | None = None
        self._remaps: tuple[Remap, Remap] | None = None
        self._first, self._last = 0, self.frame_count - 1
        self.own_colours = first.own_colours
        self._reads_fine = False

    def read_fine(self) -> None:
        """From now on, yield frames with fine pictures; notes no longer say that HDR is tone-mapped."""
        self._reads_fine = True
        self.notes = tuple(_note_kept(note) for note in self.notes)

    def show(self, view: SphereView, baseline_m: float | None, note: Note) -> "StereoVideo":
        """Return the same video with windows of its VR180 or 360-degree frames as frames."""
        shown = copy.copy(self)
        cut = view.cutter().cut
        shown.sphere, shown._remaps = view, (cut, cut)
        shown.size_px, shown.pixel_aspect = view.window.size_px, Fraction(1)
        shown.baseline_m = baseline_m
        shown.camera = None if baseline_m is None else view.window.camera(baseline_m)
        shown.notes = (*self.notes, note)
        return shown

    def rectify(self, rig: Rig) -> "StereoVideo":
        """Return the same video with frames that are rectified by a calibration, and its camera.

        Rectified frames are cropped to what both cameras see.

        Raises:
            StereoweaveError: The frames are windows of a VR180 or 360-degree video; see also
                `plan_rectification`.
        """
        if self.sphere is not None:
            raise StereoweaveError(
                f"{self.name}: expected no calibration for a VR180 or 360-degree video, found {rig.name}",
                remedy=Remedy(
                    "omit it, or choose rectilinear if the video is an ordinary one",
                    ("calibration", "projection"),
                ),
            )
        plan = plan_rectification(rig, self.size_px).crop()
        shown = copy.copy(self)
        replaced = (
            [] if self.camera is None else [Note(f"{rig.name} replaces the camera that the video declares")]
        )
        shown.rig, shown.camera = rig, plan.camera
        if plan.views is not None:
            left, right = plan.views
            shown._remaps = left.apply, right.apply
            shown.size_px, shown.pixel_aspect = left.size_px, Fraction(1)
        if min(shown.size_px) < SMALLEST_SIDE_PX:
            raise StereoweaveError(
                f"{rig.name}: expected at least {SMALLEST_SIDE_PX}x{SMALLEST_SIDE_PX} pixels that both "
                f"cameras see, found {format_size(shown.size_px)}; check the rotation"
            )
        shown.notes = (*self.notes, *replaced, *plan.notes)
        return shown

    def excerpt(self, start_s: float, length_s: float) -> "StereoVideo":
        """Return a part of the video as a silent video of its own, whose times and numbers begin at 0.

        Raises:
            StereoweaveError: The video ends before the part begins.
        """
        first = self._find_frame(start_s)
        if start_s < 0 or first >= self.frame_count:
            length = format_frame_time(self.length_s)
            raise StereoweaveError(
                f"expected a start within the video of {length}, found {start_s:g} s; choose an earlier one"
            )
        part = copy.copy(self)
        part._first = self._first + first
        wanted = self._find_frame(length_s, first) - first
        part.frame_count = min(max(1, wanted), self.frame_count - first)
        part.excerpted = f"{part._first}+{part.frame_count}"
        part.sound, part.unknown_sounds = None, 0
        return part

    @property
    def length_s(self) -> Fraction:
        """Time from the beginning of the first frame to the end of the last one."""
        steps = self._tracks[0].steps
        last = steps[self._first + self.frame_count - 1]
        return (last - steps[self._first]) * self.time_base + 1 / self.rate

    def _find_frame(self, after_s: float, start: int = 0) -> int:
        """Return the number of the first frame that begins at least this time after frame number `start`."""
        steps, begin = self._tracks[0].steps, self._first + start
        # Decimal times are rounded, and some files round those of their frames to milliseconds.
        rounded_s = min(_ROUNDED_S, 0.25 / float(self.rate))
        step = steps[begin] + math.ceil((after_s - rounded_s) / float(self.time_base))
        return bisect_left(steps, step, begin) - self._first

    def frames(self, start: int = 0) -> Iterator[StereoFrame]:
        """Yield the frames from number `start` on, the same as if reading had begun at the first frame.

        An excerpt is decoded from the last key frame before it.

        A frame that cannot be decoded is replaced by the last decoded frame. The frames that depend on the
        missing frame, up to the next key frame, are yielded as decoded. In both cases, the frame's `problem`
        says so.
        """
        steps, first = self._tracks[0].steps, self._first
        every_track = zip(
            *(_bridge_gaps(track, first + start, first) for track in self._tracks), strict=False
        )
        for index, seen in zip(range(first + start, first + self.frame_count), every_track, strict=False):
            pictures = [picture for frame, _ in seen for picture in frame.pictures()]
            left, right = self._eyes(pictures)
            time = (steps[index] - steps[first]) * self.time_base
            self.on_frame(index - first)
            problem = self._describe_problem(index, [problem for _, problem in seen])
            fine = partial(self._split_fine, [frame for frame, _ in seen]) if self._reads_fine else None
            yield StereoFrame(left, right, time, problem, fine)

    def _split_fine(self, frames: Sequence[TrackFrame]) -> FinePair:
        return self._eyes([picture for frame in frames for picture in frame.fine_pictures()])

    def _eyes(self, pictures: Sequence[np.ndarray]) -> FinePair:
        """Return the pictures of both views of a frame."""
        left, right = self._split.eyes(*pictures) if self._split else pictures
        if self._remaps is None:
            return left, right
        return self._remaps[0](left), self._remaps[1](right)

    def _describe_problem(self, index: int, problems: Sequence[str | None]) -> str | None:
        of_two = len(self._tracks) == 2
        found = [
            f"{track.name}: {problem}" if of_two else problem
            for track, problem in zip(self._tracks, problems, strict=True)
            if problem
        ]
        if of_two and (apart_s := self._find_offset_s(index)):
            found.append(f"the left and the right frame are {1000 * float(apart_s):.0f} ms apart")
        found += [_RETIMED] if index in self._tracks[0].retimed else []
        if index == self._last:
            found += [ending for track in self._tracks if (ending := self._describe_ending(track))]
        return "; ".join(found) or None

    def _find_offset_s(self, index: int) -> Fraction | None:
        """Return how far the frames of two tracks are apart; None for less than half a frame."""
        left_s, right_s = ((track.steps[index] - track.steps[0]) * track.time_base for track in self._tracks)
        apart_s = abs(left_s - right_s)
        return apart_s if apart_s > Fraction(1, 2) / self.rate else None

    def _describe_ending(self, track: _Source) -> str | None:
        more = len(track.steps) - (self._last + 1)
        frames = "1 more frame" if more == 1 else f"{more} more frames"
        return f"{track.name} has {frames} than the other video" if more else track.truncation


def open_video(
    paths: Sequence[Path],
    format: str | None = None,
    *,
    rate: Fraction | None = None,
    sphere: SphereRequest | None = None,
) -> StereoVideo:
    """Open a stereo video from one file with both eyes, or from a left and a right file.

    Each file is read once to find the times of all frames, and some frames are decoded to detect the frame
    packing. A spatial video (MV-HEVC) says itself which view is the left one.

    Args:
        paths: One or two videos, folders of pictures, or patterns that match pictures.
        format: Frame packing of a single video, a name in `FRAME_PACKINGS`; none for a spatial video.
            Default: detected.
        rate: Frame rate for pictures, in frames per second. Default: 25.
        sphere: Projection of the video, and the window to show. Default: detected, straight ahead.

    Raises:
        FormatError: A file cannot be read, is not 3-D, does not match the other file, or has frames that
            are too small for two views.
        StereoweaveError: The frame packing is unknown, the number of paths is not one or two, a rate is given
            for a video, or PyAV is missing.
    """
    if format is not None:
        check_choice("format", format, FRAME_PACKINGS)
    if not 1 <= len(paths) <= 2 or (len(paths) == 2 and format):
        raise StereoweaveError(
            "expected one video with both eyes, or a left and a right video without a frame packing, "
            f"found {len(paths)}: {' '.join(map(str, paths))}"
        )
    sphere = sphere or SphereRequest()
    if len(paths) == 1:
        return _show_window(_open_single(paths[0], format, rate, sphere), sphere)
    left, right = (open_track(path, rate) for path in paths)
    _check_alike(left, right)
    notes: list[Note] = []
    if isinstance(left, PictureTrack) and isinstance(right, PictureTrack):
        notes = note_numbers(left, right)
    return _show_window(StereoVideo([left, right], None, notes), sphere)


def _open_single(path: Path, format: str | None, rate: Fraction | None, sphere: SphereRequest) -> StereoVideo:
    """Open a video with both eyes."""
    if rate is None and list_picture_files(path) is None:
        check_not_mvc(path)
        twins = open_twins(path, format) if format in (None, *TWO_STREAMS) else None
        if twins:
            _check_alike(*twins.tracks)
            video = StereoVideo(twins.tracks, twins.packing, [twins.note])
            video.name = str(path)
            return video
    track = open_track(path, rate)
    if isinstance(track, VideoTrack) and track.is_spatial:
        check_unpacked(track.name, format)
        _check_second_view(track)
        return StereoVideo([track], None)
    if (format or track.declared_packing) in FRAME_SEQUENTIAL:
        return _open_sequence(track, format)
    name = format or detect_layout(track.name, track.samples(), track.declared_packing)
    is_ordinary = track.sphere is not None and track.sphere.projection is None
    if sphere.projection is not None or not (format or is_ordinary):
        named = None if track.sphere else track.name
        name = choose_layout(name, named, track.size_px, sphere)
    try:
        return StereoVideo([track], name)
    except FormatError as error:
        raise FormatError(f"{track.name}: {error}") from error


def _show_window(video: StereoVideo, request: SphereRequest) -> StereoVideo:
    """Return what is to be shown of a VR180 or 360-degree video; other videos are returned unchanged."""
    declared = video.declared_sphere
    by_name = declared is None and request.projection is None
    named = guess_projection(video.name, video.size_px) if by_name else None
    projection = request.choose(video.name, declared.projection if declared else named)
    if projection is None:
        return video
    view = SphereView.chosen(projection, video.size_px, request)
    note = view.note(request, ", detected from the name" if by_name else "")
    return video.show(view, declared.baseline_m if declared else None, note)


def _open_sequence(track: Track, format: str | None) -> StereoVideo:
    """Open a video whose left and right frames alternate, as `format` says or the file declares."""
    name = format or str(track.declared_packing)
    declared = Note(f"{name}, as the file declares", Remedy("override it if it is wrong", ("format",)))
    frames = FrameSequence(track, right_first=FRAME_SEQUENTIAL[name])
    if not frames.can_begin(_MOST_ALONE):
        raise FormatError(
            f"{track.name}: expected left and right frames in turn, found no left frame that can be decoded "
            f"together with its right frame among the first {_MOST_ALONE}",
            remedy=Remedy("copy the video again"),
        )
    return StereoVideo([frames], name, [] if format else [declared])


def check_unpacked(name: str, format: str | None) -> None:
    """Raise StereoweaveError if a frame packing is given for a spatial video."""
    if format:
        raise StereoweaveError(
            f"{name}: expected no frame packing for a spatial video (MV-HEVC), whose views are in two "
            f"layers, found {format}",
            remedy=Remedy("leave it out", ("format",)),
        )


def _find_pixel_aspect(split: PairLayout | InterleavedLayout | None, stated: Fraction) -> Fraction:
    """Return the pixel aspect of views at full size.

    Some files state another one: of half size, that of the squeezed views; of full size, that by which a flat
    screen shows both views in the shape of one.
    """
    if isinstance(split, PairLayout):
        squeezed = Fraction(2) if split.beside else Fraction(1, 2)
        if stated == (squeezed if split.half else 1 / squeezed):
            return Fraction(1)
    return stated


def _note_kept(note: Note) -> Note:
    return replace(note, text=note.text.replace("it is tone-mapped to SDR (BT.709)", "it is kept in 10 bits"))


def _check_second_view(track: VideoTrack) -> None:
    if not track.can_begin(_MOST_ALONE):
        raise FormatError(
            f"{track.name}: expected both views of a spatial video (MV-HEVC), found no frame with a second "
            f"view among the first {_MOST_ALONE}; export the video again"
        )


def _check_alike(left: Track, right: Track) -> None:
    """Raise FormatError unless both videos have the same size and end in sync, to within half a frame."""
    for track in (left, right):
        if track.is_spatial:
            raise FormatError(
                f"expected a left and a right video with one view each, found {track.name}, a spatial video "
                "(MV-HEVC) with both views; give it alone"
            )
    if left.size_px != right.size_px:
        sizes = ["{}x{}".format(*track.size_px) for track in (left, right)]
        raise FormatError(
            f"expected left and right videos of the same size, found {left.name} with {sizes[0]} "
            f"and {right.name} with {sizes[1]} pixels; scale one of them first"
        )
    last = min(len(left.steps), len(right.steps)) - 1
    ends_s = [(track.steps[last] - track.steps[0]) * track.time_base for track in (left, right)]
    if abs(ends_s[0] - ends_s[1]) > Fraction(1, 2) / left.rate:
        raise FormatError(
            f"expected left and right videos with the same frame rate, found frame {last} at "
            f"{float(ends_s[0]):.3f} s in {left.name} and at {float(ends_s[1]):.3f} s in {right.name}; "
            "convert one of them first"
        )


def _bridge_gaps(track: _Source, start: int, first: int) -> Iterator[tuple[TrackFrame, str | None]]:
    """Yield each frame from number `start` on, and its problem if it has one; replace missing frames.

    Decoding begins at a key frame at or before frame `first`.
    """
    upcoming, last, after_damage = 0, None, False
    for frame in track.frames(start, first):
        index = frame.number
        if not upcoming <= index < len(track.steps):
            continue
        missing = range(upcoming, index)
        yield from (
            (last or frame, _REPEATED_LAST if last else _REPEATED_NEXT)
            for number in missing
            if number >= start
        )
        after_damage = not frame.is_key_frame and (after_damage or bool(missing))
        if index >= start:
            yield frame, _AFTER_DAMAGE if after_damage else None
        upcoming, last = index + 1, frame
    if last:
        yield from ((last, _REPEATED_LAST) for number in range(upcoming, len(track.steps)) if number >= start)
