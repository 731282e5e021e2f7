"""Animations are read back as they were written; failed ones leave nothing behind."""

import sys
import weakref

import av
import numpy as np
import pytest
from full_disks import disk_with_room
from PIL import Image, ImageSequence

from stereoweave.errors import StereoweaveError
from stereoweave.io.animation import check_animation_ending, write_animation

ENDINGS = [".mp4", ".gif", ".webp"]


@pytest.fixture
def moving(rng) -> list[np.ndarray]:
    """Return seven images of 64x48 px: a soft, colourful pattern that moves left by 4 px per frame."""
    coarse = Image.fromarray(rng.integers(0, 256, (6, 11, 3), dtype=np.uint8))
    wide = np.asarray(coarse.resize((88, 48), Image.BICUBIC))
    return [wide[:, start : start + 64].copy() for start in range(0, 28, 4)]


def read_again(path) -> list[np.ndarray]:
    if path.suffix == ".mp4":
        with av.open(path) as film:
            return [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
    with Image.open(path) as file:
        return [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(file)]


@pytest.mark.parametrize("ending", ENDINGS)
def test_frames_are_read_back_in_order(tmp_path, moving, ending):
    write_animation(tmp_path / f"a{ending}", iter(moving), 60)
    found = read_again(tmp_path / f"a{ending}")
    assert len(found) == 7
    for frame, expected in zip(found, moving, strict=True):
        assert np.abs(frame.astype(int) - expected).mean() < 12  # the next frame differs by 50
    assert [file.name for file in tmp_path.iterdir()] == [f"a{ending}"]


def test_an_mp4_uses_the_most_compatible_format_and_keeps_frame_durations(tmp_path, moving):
    write_animation(tmp_path / "a.mp4", moving, 60)
    with av.open(tmp_path / "a.mp4") as film:
        (stream,) = film.streams
        context = stream.codec_context
        assert (context.name, context.pix_fmt) == ("h264", "yuv420p")
        times_ms = [float(1000 * frame.pts * frame.time_base) for frame in film.decode(video=0)]
    assert times_ms == [60 * index for index in range(7)]
    content = (tmp_path / "a.mp4").read_bytes()
    assert content.index(b"moov") < content.index(b"mdat")  # starts to play before the download is complete


@pytest.mark.parametrize("ending", [".gif", ".webp"])
def test_a_gif_and_a_webp_keep_frame_durations_and_loop_forever(tmp_path, moving, ending):
    write_animation(tmp_path / f"a{ending}", moving, 60)
    with Image.open(tmp_path / f"a{ending}") as file:
        assert file.info["loop"] == 0
        durations_ms = []
        for index in range(file.n_frames):
            file.seek(index)
            file.load()
            durations_ms.append(file.info["duration"])
    assert durations_ms == [60] * 7


def test_an_mp4_declares_its_colour_space(tmp_path):
    colours = [(200, 30, 40), (20, 180, 60), (10, 40, 210), (230, 230, 230)]
    frame = np.repeat(np.array([colours], np.uint8), 16, axis=1).repeat(32, axis=0)
    write_animation(tmp_path / "a.mp4", [frame] * 2, 40)
    with av.open(tmp_path / "a.mp4") as film:
        picture = next(film.decode(video=0))
    # BT.709 with limited range, which players assume for high definition: 16 + 219 * (0.2126 R + ...)
    luma = picture.to_ndarray()[8, 8::16]
    expected = [
        16 + 219 / 255 * (0.2126 * red + 0.7152 * green + 0.0722 * blue) for red, green, blue in colours
    ]
    np.testing.assert_allclose(luma, expected, atol=1.5)
    assert (picture.colorspace, picture.color_range) == (1, 1)
    np.testing.assert_allclose(picture.to_ndarray(format="rgb24")[8, 8::16], colours, atol=4)


def test_the_last_column_and_row_of_odd_sides_are_repeated_in_an_mp4(tmp_path, moving):
    odd = [frame[:47, :63] for frame in moving]
    write_animation(tmp_path / "a.mp4", odd, 40)
    found = read_again(tmp_path / "a.mp4")[0].astype(int)
    assert found.shape == (48, 64, 3)
    assert np.abs(found[:47, :63] - odd[0]).mean() < 10
    assert np.abs(found[:47, 63] - odd[0][:, 62]).mean() < 12


@pytest.mark.parametrize("ending", [".gif", ".webp"])
def test_odd_sides_are_kept_if_the_format_allows_them(tmp_path, moving, ending):
    write_animation(tmp_path / f"a{ending}", [frame[:47, :63] for frame in moving], 40)
    assert read_again(tmp_path / f"a{ending}")[0].shape == (47, 63, 3)


def test_the_frames_of_an_mp4_are_not_all_in_memory_at_once(tmp_path):
    alive: list[weakref.ref] = []
    most = 0

    def coming():
        nonlocal most
        for level in range(40):
            frame = np.full((64, 64, 3), level, np.uint8)
            alive.append(weakref.ref(frame))
            most = max(most, sum(each() is not None for each in alive))
            yield frame

    write_animation(tmp_path / "a.mp4", coming(), 40)
    assert len(read_again(tmp_path / "a.mp4")) == 40
    assert most <= 4


def test_the_frames_of_a_gif_share_their_256_colours(tmp_path, moving):
    write_animation(tmp_path / "a.gif", moving, 40)
    colours = np.concatenate(read_again(tmp_path / "a.gif")).reshape(-1, 3)
    assert 128 < len(np.unique(colours, axis=0)) <= 256


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_single_frame_is_enough_and_no_frame_is_an_error(tmp_path, moving, ending):
    write_animation(tmp_path / f"a{ending}", moving[:1], 40)
    assert len(read_again(tmp_path / f"a{ending}")) == 1
    with pytest.raises(StereoweaveError, match="frames: expected at least one frame"):
        write_animation(tmp_path / f"b{ending}", [], 40)
    assert [file.name for file in tmp_path.iterdir()] == [f"a{ending}"]


@pytest.mark.parametrize("ending", ENDINGS)
def test_frames_of_two_sizes_are_refused_and_leave_no_file(tmp_path, moving, ending, without_shape_checks):
    with pytest.raises(
        StereoweaveError, match="^frames: expected frames of the same size, found 64x48 and 60x48"
    ):
        write_animation(tmp_path / f"a{ending}", [*moving, moving[0][:, :60]], 40)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("ending", "most_px"), [(".mp4", 16384), (".gif", 65535), (".webp", 16383)])
def test_frames_that_are_too_large_for_the_format_are_refused(tmp_path, ending, most_px):
    frames = np.zeros((2, 2, most_px + 1, 3), np.uint8)
    message = f"expected frames of at most {most_px} px per side, found {most_px + 1}x2; limit their size"
    with pytest.raises(StereoweaveError, match=message):
        write_animation(tmp_path / f"a{ending}", frames, 40)
    assert list(tmp_path.iterdir()) == []
    assert write_animation(tmp_path / f"a{ending}", frames[:, :, 1:], 40) >= 1


@pytest.mark.parametrize("ending", ENDINGS)
def test_an_error_halfway_keeps_the_earlier_file(tmp_path, moving, ending):
    (tmp_path / f"a{ending}").write_text("kept")

    def breaking():
        yield from moving
        raise StereoweaveError("no more views")

    with pytest.raises(StereoweaveError, match="^no more views"):
        write_animation(tmp_path / f"a{ending}", breaking(), 40)
    assert [file.read_text() for file in tmp_path.iterdir()] == ["kept"]


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_full_disk_is_a_one_line_error_and_leaves_no_file(tmp_path, rng, ending):
    noise = rng.integers(0, 256, (4, 128, 128, 3), dtype=np.uint8)
    with (
        pytest.raises(StereoweaveError, match=f"a{ending}: expected a writable file") as told,
        disk_with_room(4096),
    ):
        write_animation(tmp_path / f"a{ending}", noise, 40)
    assert len(str(told.value).splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("path", ["a.avi", "a.png", "a"])
def test_an_unknown_ending_is_refused_with_a_list_of_the_known_ones(path):
    with pytest.raises(StereoweaveError, match=rf"{path}: expected .* \(\.mp4, \.gif, \.webp\), found"):
        check_animation_ending(path)


def test_an_mp4_without_pyav_names_the_extra_before_a_frame_is_rendered(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)

    def never():
        raise AssertionError
        yield

    with pytest.raises(StereoweaveError, match=r'an MP4 file needs PyAV, .*"stereoweave\[video\]"'):
        write_animation(tmp_path / "a.mp4", never(), 40)
    assert list(tmp_path.iterdir()) == []
    assert check_animation_ending("a.gif") == ".gif"


@pytest.mark.parametrize("ending", ENDINGS)
def test_the_number_of_frames_in_the_file_is_returned(tmp_path, moving, ending):
    path = tmp_path / f"a{ending}"
    count = write_animation(path, [moving[0]] * 5, 60)
    assert count == len(read_again(path)) == (5 if ending == ".mp4" else 1)
    assert write_animation(path, moving, 60) == 7
