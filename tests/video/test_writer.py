"""Videos written in parts and joined: times, sound, colours and frame packing are preserved."""

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from av.sidedata.sidedata import Type
from av.video.reformatter import Interpolation
from video_examples import example_pairs, write_side_by_side

from stereoweave.errors import StereoweaveError
from stereoweave.video.mp4_marks import VideoMarks
from stereoweave.video.writer import GREY16, H264, Packing, Recorder, check_container

# Flags with which FFmpeg decodes colours exactly.
EXACT = Interpolation.BICUBIC | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT
NTSC = Fraction(30000, 1001)
FLAT_RGB = [(200, 30, 40), (20, 180, 60), (128, 128, 128), (255, 255, 255), (0, 0, 0), (30, 40, 220)]


def pictures(count: int) -> list[np.ndarray]:
    return [left for left, _ in example_pairs(count)]


def make(
    video: Path,
    shown: Sequence[tuple[Fraction, np.ndarray]],
    recorder: Recorder,
    *,
    sound: Path | None = None,
    parts: int = 2,
) -> Path:
    """Write a video of these images in several parts, and return its path."""
    files = [video.with_name(f"{number}.nut") for number in range(parts)]
    for file, chosen in zip(files, np.array_split(np.arange(len(shown)), parts), strict=True):
        recorder.write_part(file, [shown[index] for index in chosen])
    recorder.join(files, sound, video, {})
    return video


def even_times(count: int, rate: Fraction = NTSC) -> list[Fraction]:
    return [index / rate for index in range(count)]


def recorder(**changes: object) -> Recorder:
    return Recorder(**{"encoding": H264, "time_base": 1 / NTSC, "rate": NTSC, **changes})


def test_a_size_that_the_encoder_does_not_take_is_refused(tmp_path):
    with pytest.raises(StereoweaveError, match="at most 16384 px per side for H.264, found 16386x32 px"):
        recorder().write_part(tmp_path / "0.nut", [(Fraction(0), np.zeros((32, 16386, 3), np.uint8))])


def frame_times(video: Path) -> list[Fraction]:
    with av.open(str(video)) as container:
        return [frame.pts * frame.time_base for frame in container.decode(video=0)]


def first_frame(video: Path) -> av.VideoFrame:
    with av.open(str(video)) as container:
        return next(container.decode(video=0))


def sound_of(video: Path) -> list[list[tuple[Fraction, bytes]]]:
    """Return the time and content of every packet, per audio stream."""
    with av.open(str(video)) as container:
        found: dict[int, list[tuple[Fraction, bytes]]] = {
            stream.index: [] for stream in container.streams.audio
        }
        for packet in container.demux(*container.streams.audio):
            if packet.size:
                found[packet.stream_index].append((packet.pts * packet.time_base, bytes(packet)))
    return list(found.values())


@pytest.mark.parametrize("ending", [".mp4", ".mov"])
@pytest.mark.parametrize("time_base", [Fraction(1, 90_000), Fraction(1001, 30_000), Fraction(1, 7)])
def test_frame_times_are_exact_even_across_parts(tmp_path, ending, time_base):
    steps = [0, 1, 3, 4, 9, 10, 11, 12, 20, 21]
    times_s = [step * time_base for step in steps]
    writing = recorder(time_base=time_base, rate=len(steps) / times_s[-1])
    video = make(tmp_path / f"video{ending}", list(zip(times_s, pictures(10), strict=True)), writing, parts=3)
    assert frame_times(video) == times_s


def test_matroska_rounds_times_to_the_millisecond(tmp_path):
    video = make(tmp_path / "video.mkv", list(zip(even_times(6), pictures(6), strict=True)), recorder())
    assert frame_times(video) == [Fraction(ms, 1000) for ms in (0, 33, 67, 100, 133, 167)]


def test_the_last_frame_is_shown_as_long_as_the_others(tmp_path):
    video = make(tmp_path / "video.mp4", list(zip(even_times(6), pictures(6), strict=True)), recorder())
    with av.open(str(video)) as container:
        stream = container.streams.video[0]
        assert stream.duration * stream.time_base == 6 / NTSC


def test_an_odd_size_is_padded_with_the_last_row_and_column(tmp_path):
    picture = np.full((35, 37, 3), 40, np.uint8)
    picture[-1], picture[:, -1] = 200, 200
    video = make(tmp_path / "video.mp4", [(Fraction(0), picture)], recorder(), parts=1)
    levels = first_frame(video).to_ndarray(format="gray").astype(int)
    assert levels.shape == (36, 38)
    np.testing.assert_allclose(levels[-2:, 5:30], 200, atol=12)
    np.testing.assert_allclose(levels[5:30, -2:], 200, atol=12)
    np.testing.assert_allclose(levels[5:30, 5:30], 40, atol=12)


def test_colours_are_kept_within_two_levels_and_tagged_as_hd_video(tmp_path):
    picture = np.repeat(np.array(FLAT_RGB, np.uint8)[None], 64, 0).repeat(32, 1)
    video = make(tmp_path / "video.mp4", [(Fraction(0), picture)], recorder(), parts=1)
    frame = first_frame(video)
    # In ITU-T H.273, 1 is BT.709 for the matrix, the primaries and the transfer curve. In FFmpeg, 1 is the
    # limited range.
    assert (frame.colorspace, frame.color_primaries, frame.color_trc, frame.color_range) == (1, 1, 1, 1)
    seen = frame.to_ndarray(format="rgb24", interpolation=EXACT).astype(int)
    for index, rgb in enumerate(FLAT_RGB):
        patch = seen[8:-8, 32 * index + 8 : 32 * index + 24]
        assert np.abs(patch - np.array(rgb)).max() <= 2, rgb


def test_16_bit_grey_is_lossless(tmp_path, rng):
    grey = rng.integers(0, 65536, (3, 33, 45), dtype=np.uint16)
    video = make(
        tmp_path / "video.mkv",
        list(zip(even_times(3), grey, strict=True)),
        recorder(encoding=GREY16),
        parts=2,
    )
    with av.open(str(video)) as container:
        frames = list(container.decode(video=0))
    assert frames[0].format.name == "gray16le"
    np.testing.assert_array_equal([frame.to_ndarray() for frame in frames], grey)


@pytest.mark.parametrize("ending", [".mp4", ".mkv"])
@pytest.mark.parametrize(("number", "kind"), [(3, 1), (4, 2)])  # AVStereo3D: 1 side by side, 2 top and bottom
def test_the_frame_packing_is_declared_for_players(tmp_path, ending, number, kind):
    word = {3: "left_right", 4: "top_bottom"}[number]
    video = make(
        tmp_path / f"video{ending}",
        list(zip(even_times(2), pictures(2), strict=True)),
        recorder(packing=Packing(word, number)),
    )
    told = np.frombuffer(bytes(first_frame(video).side_data[Type.STEREO3D]), np.int32)
    assert told[0] == kind
    with av.open(str(video)) as container:
        assert container.streams.video[0].metadata.get("stereo_mode") == (word if ending == ".mkv" else None)


def test_crossed_views_are_declared_only_in_matroska(tmp_path):
    shown = list(zip(even_times(2), pictures(2), strict=True))
    writing = recorder(packing=Packing("right_left", None))
    assert Type.STEREO3D not in first_frame(make(tmp_path / "video.mp4", shown, writing)).side_data
    video = make(tmp_path / "video.mkv", shown, writing)
    with av.open(str(video)) as container:
        assert container.streams.video[0].metadata["stereo_mode"] == "right_left"


@pytest.mark.parametrize(
    ("source", "target", "off_s"),
    [(".mp4", ".mp4", 0), (".mp4", ".mov", 0), (".mkv", ".mkv", 0), (".mp4", ".mkv", Fraction(1, 2000))],
)
def test_sound_is_copied_bit_for_bit_at_its_times(tmp_path, source, target, off_s):
    original = write_side_by_side(tmp_path / f"in{source}", example_pairs(10), sound=True)
    video = make(
        tmp_path / f"out{target}",
        list(zip(even_times(10, Fraction(25)), pictures(10), strict=True)),
        recorder(time_base=Fraction(1, 25), rate=Fraction(25)),
        sound=original,
    )
    [before], [after] = sound_of(original), sound_of(video)
    assert len(before) > 15
    assert [content for _, content in after] == [content for _, content in before]
    # The priming samples of the encoder lie before 0, and nothing is shifted to make room for them.
    assert before[0][0] < 0
    assert max(abs(then - now) for (then, _), (now, _) in zip(before, after, strict=True)) <= off_s
    assert frame_times(video)[0] == 0


def test_all_audio_streams_are_kept_with_their_languages(tmp_path):
    original = two_languages(tmp_path / "in.mkv")
    video = make(
        tmp_path / "out.mkv",
        list(zip(even_times(4), pictures(4), strict=True)),
        recorder(),
        sound=original,
    )
    assert sound_of(video) == sound_of(original)
    with av.open(str(video)) as container:
        assert [stream.metadata["language"] for stream in container.streams.audio] == ["deu", "fra"]
        assert [stream.codec_context.name for stream in container.streams.audio] == ["opus", "flac"]


def test_sound_stays_in_sync_if_the_images_begin_late(tmp_path):
    original = write_side_by_side(tmp_path / "in.mp4", example_pairs(3), times_ms=[400, 440, 480], sound=True)
    shown = list(zip(even_times(3, Fraction(25)), pictures(3), strict=True))
    video = make(
        tmp_path / "out.mp4", shown, recorder(time_base=Fraction(1, 1000), rate=Fraction(25)), sound=original
    )
    assert frame_times(video) == frame_times(original) == [Fraction(ms, 1000) for ms in (400, 440, 480)]
    assert sound_of(video) == sound_of(original)


@pytest.mark.parametrize("ending", [".mp4", ".mov"])
def test_a_late_start_is_kept_exactly(tmp_path, ending):
    ninety_kilohertz = Fraction(1, 90_000)
    late = [(36_001 + index * 3600) * ninety_kilohertz for index in range(3)]
    writing = recorder(time_base=ninety_kilohertz, rate=Fraction(25))
    video = make(tmp_path / f"video{ending}", list(zip(late, pictures(3), strict=True)), writing)
    assert frame_times(video) == late


def test_sound_that_a_container_cannot_hold_is_refused_with_a_container_that_can(tmp_path):
    original = two_languages(tmp_path / "in.mkv")
    with pytest.raises(
        StereoweaveError,
        match=r"out\.mov: expected sound that \.mov can hold, found flac, opus in .*in\.mkv; "
        r"use \.mp4 instead$",
    ):
        check_container(tmp_path / "out.mov", original)
    check_container(tmp_path / "out.mkv", original)
    assert [path.name for path in tmp_path.iterdir()] == ["in.mkv"]


def test_a_name_without_a_video_ending_is_refused():
    with pytest.raises(
        StereoweaveError, match=r"video\.gif: expected the file extension \.mp4 or .*, found \.gif"
    ):
        check_container(Path("video.gif"), None)


def two_languages(path: Path) -> Path:
    """Write one frame with a second of two audio streams, Opus in German and FLAC in French."""
    with av.open(str(path), "w") as container:
        picture = container.add_stream("mpeg4", rate=25, width=64, height=48, pix_fmt="yuv420p")
        tracks = [container.add_stream(codec, rate=48_000) for codec in ("libopus", "flac")]
        for track, language in zip(tracks, ("deu", "fra"), strict=True):
            track.metadata["language"] = language
        container.mux(picture.encode(av.VideoFrame(64, 48, "yuv420p")))
        container.mux(picture.encode())
        wave = (3000 * np.sin(np.arange(48_000) / 10)).astype(np.int16)
        for track in tracks:
            converter = av.AudioResampler(track.codec_context.format.name, "stereo", 48_000, 960)
            frame = av.AudioFrame.from_ndarray(wave[None], format="s16", layout="mono")
            frame.sample_rate, frame.pts = 48_000, 0
            for piece in [*converter.resample(frame), *converter.resample(None)]:
                container.mux(track.encode(piece))
            container.mux(track.encode())
    return path


def test_the_bounds_of_a_panorama_are_kept_in_matroska(tmp_path):
    shown = list(zip(even_times(3), pictures(3), strict=True))
    files = [tmp_path / "1.nut"]
    recorder().write_part(files[0], shown)
    out = tmp_path / "video.mkv"
    writing = recorder(packing=Packing("left_right", 3))
    writing.join(files, None, out, {}, VideoMarks(packing="side_by_side", projection="half_equirectangular"))
    spherical = np.frombuffer(bytes(first_frame(out).side_data[Type.SPHERICAL]), np.uint32)
    # AV_SPHERICAL_EQUIRECTANGULAR_TILE without rotation, then the bounds: left, top, right and bottom.
    assert spherical.tolist() == [2, 0, 0, 0, 1 << 30, 0, 1 << 30, 0, 0]
    with av.open(str(out)) as container:
        assert container.streams.video[0].metadata["stereo_mode"] == "left_right"
    writing.join(files, None, tmp_path / "plain.mkv", {})
    assert frame_times(out) == frame_times(tmp_path / "plain.mkv")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["1.nut", "plain.mkv", "video.mkv"]
