from fractions import Fraction

import av
import numpy as np
import pytest
from hdr_examples import BT709, BT2020, HLG, PQ, nit_codes, srgb
from video_examples import example_pairs, packed

from stereoweave.video.colours import convert_to_rgb
from stereoweave.video.reader import open_video


def hdr_frame(rgb_codes, transfer, primaries=BT2020):
    """Return a plain frame of non-linear RGB 0..1, as 10-bit YUV of BT.2020 in limited range."""
    red, green, blue = rgb_codes
    luma = 0.2627 * red + 0.6780 * green + 0.0593 * blue
    codes = 64 + 876 * luma, 512 + 896 * (blue - luma) / 1.8814, 512 + 896 * (red - luma) / 1.4746
    frame = av.VideoFrame(32, 16, "yuv444p10le")
    for plane, code in zip(frame.planes, codes, strict=True):
        plane.update(np.full(plane.buffer_size // 2, round(code), np.uint16).tobytes())
    frame.colorspace, frame.color_range = BT2020, 1
    frame.color_trc, frame.color_primaries = transfer, primaries
    return frame


def shown(rgb_codes, transfer, primaries=BT2020):
    picture = convert_to_rgb(hdr_frame(rgb_codes, transfer, primaries))
    assert picture.dtype == np.uint8
    assert picture.shape == (16, 32, 3)
    assert (picture == picture[0, 0]).all()
    return picture[0, 0].astype(int).tolist()


def test_hlg_and_pq_show_the_same_white_and_grey_card():
    # BT.2408: white at 203 cd/m2 is 75 % HLG, the grey card at 26 cd/m2 is 38 %.
    assert shown((0.75, 0.75, 0.75), HLG) == pytest.approx(shown(nit_codes(203, 203, 203), PQ), abs=1)
    assert shown((0.38, 0.38, 0.38), HLG) == pytest.approx(shown(nit_codes(26, 26, 26), PQ), abs=2)
    assert shown((0, 0, 0), HLG) == [0, 0, 0]
    assert shown((1, 1, 1), HLG) == [255, 255, 255]


def test_hdr_with_the_primaries_of_bt709_keeps_them():
    red, green, blue = shown(nit_codes(80, 20, 20), PQ, primaries=BT709)
    assert [red, green, blue] == pytest.approx([srgb(80 / 203), srgb(20 / 203), srgb(20 / 203)], abs=1)


@pytest.mark.parametrize(
    ("primaries", "rgb", "expected"),
    [
        # Code 128 is 0.2159 of white's light. In BT.709, red of BT.2020 has 1.6605 * 0.2159 = 0.3584 of it,
        # and less than no green and blue; green of P3 has 1.0421 * 0.2159 = 0.2250.
        (BT2020, (128, 0, 0), (srgb(0.3584), 0, 0)),
        (12, (0, 128, 0), (0, srgb(0.2250), 0)),
        (BT2020, (200, 200, 200), (200, 200, 200)),
        (BT709, (128, 0, 0), (128, 0, 0)),
        (2, (128, 0, 0), (128, 0, 0)),
    ],
)
def test_wide_colours_become_those_of_bt709(primaries, rgb, expected):
    frame = av.VideoFrame.from_ndarray(np.full((16, 32, 3), rgb, np.uint8), "rgb24")
    frame.color_primaries, frame.color_trc = primaries, BT709
    assert convert_to_rgb(frame)[0, 0].tolist() == pytest.approx(expected, abs=1)


def write_ten_bits(path, codec, pairs, transfer, *, colorspace):
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=25)
        stream.height, stream.width = packed(*pairs[0]).shape[:2]
        stream.pix_fmt, context = "yuv420p10le", stream.codec_context
        context.colorspace, context.color_range = colorspace, 1
        context.color_trc, context.color_primaries = transfer, colorspace
        context.options = {"crf": "8", "preset": "fast", "x265-params": "log-level=none"}
        for index, pair in enumerate(pairs):
            frame = av.VideoFrame.from_ndarray(packed(*pair), "rgb24").reformat(
                format="yuv420p10le", src_color_range=2, dst_colorspace=colorspace, dst_color_range=1
            )
            frame.pts, frame.time_base = index, Fraction(1, 25)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


@pytest.mark.parametrize(("codec", "transfer", "name"), [("libx265", HLG, "HLG"), ("libx264", PQ, "PQ")])
def test_an_hdr_video_is_tone_mapped_with_a_note(tmp_path, codec, transfer, name):
    # Greys from black to white, which are taken as codes of HDR.
    codes = np.tile(np.repeat(np.arange(0, 256, 8), 8), (96, 1)).astype(np.uint8)
    ramp = np.stack([codes] * 3, axis=2)
    path = write_ten_bits(tmp_path / "hdr.mp4", codec, 3 * [(ramp, ramp)], transfer, colorspace=BT2020)
    video = open_video([path], "side_by_side")
    assert [str(note) for note in video.notes] == [
        f"the video is HDR ({name}); it is tone-mapped to SDR (BT.709)"
    ]
    expected = [shown(3 * (code / 255,), transfer)[1] for code in range(0, 256, 8)]
    for frame in video.frames():
        for eye in (frame.left, frame.right):
            middles = eye[10:-10, 4::8].mean(axis=(0, 2))
            np.testing.assert_allclose(middles[1:-1], expected[1:-1], atol=3)


@pytest.mark.parametrize("codec", ["libx265", "libx264"])
def test_ten_bits_without_hdr_are_read_as_eight(tmp_path, codec):
    pairs = example_pairs(3)
    path = write_ten_bits(tmp_path / "sdr.mp4", codec, pairs, BT709, colorspace=BT709)
    video = open_video([path], "side_by_side")
    assert video.notes == ()
    for frame, (left, right) in zip(video.frames(), pairs, strict=True):
        assert np.abs(frame.left.astype(float) - left).mean() < 2.5
        assert np.abs(frame.right.astype(float) - right).mean() < 2.5
        assert np.abs((frame.left.astype(float) - left).mean(axis=(0, 1))).max() < 0.5


@pytest.mark.parametrize("rgb_codes", [(0.35, 0.21, 0.14), (0.1, 0.02, 0.05), (0.78, 0.12, 0.47)])
def test_hdr_with_halved_colours_as_cameras_write_it_looks_the_same(rgb_codes):
    whole = hdr_frame(rgb_codes, HLG)
    halved = whole.reformat(format="yuv420p10le")
    halved.colorspace, halved.color_range = BT2020, 1
    halved.color_trc, halved.color_primaries = HLG, BT2020
    np.testing.assert_allclose(convert_to_rgb(halved).astype(int), convert_to_rgb(whole), atol=1)
