import re
from fractions import Fraction

import av
import numpy as np
import pytest
from video_examples import damage, example_pairs, packets, write_side_by_side

from stereoweave.cli.root import main
from stereoweave.errors import StereoweaveError
from stereoweave.video.job import VideoJob
from stereoweave.video.reader import open_video

HLG, PQ, BT2020, BT709 = 18, 16, 9, 1
PACKED = ["--format", "side_by_side", "--threads", "1"]


def run(source, out, *words):
    return main(["video", str(source), "-o", str(out), *PACKED, *words])


def write_hdr(path, pairs, *, transfer=HLG, primaries=BT2020, pix_fmt="yuv420p10le", matrix=BT2020):
    """Write packed pairs as HEVC of 10 bits, whose codes are those of the pictures."""
    # With B-frames, x265 gives a video of one or two frames random decoding times, which MP4 cannot store.
    parameters = "bframes=0:log-level=error"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx265", 25, {"crf": "4", "x265-params": parameters})
        stream.pix_fmt = pix_fmt
        stream.color_range, stream.colorspace = 1, matrix
        stream.color_primaries, stream.color_trc = primaries, transfer
        for index, (left, right) in enumerate(pairs):
            codes = np.hstack([left, right]).astype(np.uint16) * 257
            if not index:
                stream.height, stream.width = codes.shape[:2]
            frame = av.VideoFrame.from_ndarray(codes, "rgb48le").reformat(
                format=pix_fmt, src_color_range=2, dst_color_range=1, dst_colorspace=BT2020
            )
            frame.pts, frame.time_base = index, Fraction(1, 25)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def decoded(path):
    with av.open(str(path)) as container:
        return list(container.decode(video=0))


def values(plane):
    """Return a plane of 16 bits."""
    rows = np.frombuffer(bytes(plane), np.uint16).reshape(plane.height, -1)
    return rows[:, : plane.width].astype(int)


def luma(frame):
    return values(frame.planes[0])


def test_wide_colours_keep_their_primaries_in_ten_bits_alone(tmp_path):
    source = write_hdr(tmp_path / "in.mp4", example_pairs(2), transfer=BT709)
    for bits, expected in (("10", (BT2020, BT709, BT2020)), ("8", (BT709, BT709, BT709))):
        out = tmp_path / f"{bits}.mp4"
        assert run(source, out, "--position", "0", "--bits", bits) == 0
        frame = decoded(out)[0]
        assert (frame.color_primaries, frame.color_trc, frame.colorspace) == expected


@pytest.fixture(scope="module")
def hlg(tmp_path_factory):
    path = tmp_path_factory.mktemp("hdr") / "hlg.mp4"
    return write_hdr(path, example_pairs(4, width=192, height=128))


@pytest.mark.parametrize("ending", [".mp4", ".mkv"])
def test_hdr_is_kept_in_10_bits(hlg, tmp_path, capsys, ending):
    out = tmp_path / f"out{ending}"
    assert run(hlg, out, "--layout", "side_by_side", "--bits", "10", "--no-rectify") == 0
    assert "the video is HDR (HLG); it is kept in 10 bits" in capsys.readouterr().err
    made = tmp_path / f"out_LRF_Full_SBS{ending}"
    frames, sources = decoded(made), decoded(hlg)
    assert (len(frames), frames[0].format.name) == (4, "yuv420p10le")
    assert (frames[0].color_trc, frames[0].color_primaries, frames[0].colorspace) == (HLG, BT2020, BT2020)
    for frame, source in zip(frames, sources, strict=True):
        # Encoded at crf 16; tone mapping would brighten it by over 100 of 1023.
        assert np.abs(luma(frame) - luma(source)).mean() < 6
        assert abs((luma(frame) - luma(source)).mean()) < 0.5


def test_a_view_between_the_cameras_is_as_bright_as_the_cameras_pictures(hlg, tmp_path):
    for name, position in (("left", "0"), ("between", "0.5")):
        assert run(hlg, tmp_path / f"{name}.mp4", "--position", position, "--bits", "10") == 0
    left, between = (luma(decoded(tmp_path / f"{name}.mp4")[2]) for name in ("left", "between"))
    assert left.shape == between.shape == (128, 192)
    assert abs(left.mean() - between.mean()) < 5
    assert np.abs(left - between).mean() > 5  # it is another view


def test_other_layouts_of_hdr_are_tone_mapped(hlg, tmp_path, capsys):
    assert run(hlg, tmp_path / "out.mp4", "--layout", "anaglyph_dubois", "--bits", "10") == 0
    assert "it is tone-mapped to SDR (BT.709)" in capsys.readouterr().err
    [frame, *_] = decoded(tmp_path / "out.mp4")
    assert (frame.format.name, frame.color_trc, frame.colorspace) == ("yuv420p10le", BT709, BT709)


def test_hevc_in_mp4_has_the_name_that_apples_players_know(hlg, tmp_path):
    assert run(hlg, tmp_path / "out.mov", "--position", "0", "--bits", "10") == 0
    assert b"hvc1" in (tmp_path / "out.mov").read_bytes()


@pytest.mark.parametrize("layout", ["side_by_side", "top_bottom_half"])
def test_sdr_in_10_bits_equals_8_bits_also_where_shots_are_swapped_back(tmp_path, layout):
    pairs = [(right, left) for left, right in example_pairs(3, width=192, height=128)]
    source = write_side_by_side(tmp_path / "in.mkv", pairs, codec="libx264")
    pictures = []
    for bits in ("8", "10"):
        assert run(source, tmp_path / f"{bits}.mp4", "--layout", layout, "--bits", bits) == 0
        [made] = tmp_path.glob(f"{bits}_*.mp4")
        pictures.append([frame.left for frame in open_video([made, made]).frames()])
    for coarse, fine in zip(*pictures, strict=True):
        assert coarse.shape == fine.shape
        assert np.abs(coarse.astype(int) - fine).mean() < 2.5


def test_shots_out_of_line_are_rectified_in_all_bits(tmp_path):
    lowered = [(left, np.roll(right, 4, axis=0)) for left, right in example_pairs(3, width=240, height=160)]
    source = write_side_by_side(tmp_path / "in.mkv", lowered, codec="libx264")
    pictures = []
    for bits in ("8", "10"):
        assert run(source, tmp_path / f"{bits}.mp4", "--layout", "side_by_side", "--bits", bits) == 0
        [made] = tmp_path.glob(f"{bits}_*.mp4")
        pictures.append(next(open_video([made], "side_by_side").frames()).right.astype(int))
    coarse, fine = pictures
    assert np.abs(coarse - fine)[8:-8].mean() < 2.5
    assert np.abs(coarse - lowered[0][1])[8:-8].mean() > 5  # the right view did move


def test_depth_in_10_bits_is_linear_over_the_range_of_the_video(tmp_path):
    source = write_side_by_side(tmp_path / "in.mp4", example_pairs(3), codec="libx264", sound=True)
    assert run(source, tmp_path / "10.mp4", "--depth10") == 0
    assert run(source, tmp_path / "16.mkv", "--depth16") == 0
    with av.open(str(tmp_path / "10.mp4")) as container:
        comment = container.metadata["comment"]
    assert comment.endswith("for values from 64 to 940")
    low_px, step_px = map(float, re.search(r"= (\S+) \+ (\S+) \* \(value - 64\)", comment).groups())
    high_px = low_px + 876 * step_px
    frames, exact = decoded(tmp_path / "10.mp4"), decoded(tmp_path / "16.mkv")
    for frame, grey in zip(frames, exact, strict=True):
        expected_px = np.clip(grey.to_ndarray() / 256, low_px, high_px)
        found_px = low_px + step_px * (luma(frame) - 64)
        assert np.abs(found_px - expected_px).mean() < 3 * step_px
        assert np.abs(values(frame.planes[1]) - 512).max() <= 4
    assert [frame.pts * frame.time_base for frame in frames] == [Fraction(index, 25) for index in range(3)]
    assert [body for _, body in packets(tmp_path / "10.mp4", "audio")] == [
        body for _, body in packets(source, "audio")
    ]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--depth", "--bits", "10"], "--bits: expected a view or a layout in 10 bits, found depth; choose "
         "depth in 10 or 16 bits (--depth10, --depth16)"),
        (["--depth16", "--bits", "10"], "--bits: expected a view or a layout in 10 bits, found depth16"),
        (["--position", "0", "--bits", "12"], "--bits: expected 8 or 10, found 12"),
        (["--position", "0", "--bits", "0"], "--bits: expected 8 or 10, found 0"),
        (["--depth10", "--depth16"], "expected one kind of output, found depth10 and depth16"),
        (["--depth10", "--strength", "2"], "as output, found depth10"),
        (["--layout", "mvhevc"], "--layout: expected a layout in one layer, found 'mvhevc', for which PyAV "
         "brings no encoder; choose side_by_side, which is marked for headsets"),
    ],
)  # fmt: skip
def test_what_cannot_be_written_is_refused_in_one_line(tmp_path, capsys, words, said):
    source = write_side_by_side(tmp_path / "in.mp4", example_pairs(1), codec="mpeg4")
    assert run(source, tmp_path / "out.mkv", *words) == 2
    told = capsys.readouterr().err
    assert told.startswith("stereoweave: ") and told.count("\n") == 1
    assert said in told


@pytest.mark.parametrize(
    "changes",
    [
        {"transfer": PQ},
        {"primaries": 2},
        {"matrix": 2},
        {"pix_fmt": "yuv420p"},
        {"pix_fmt": "yuv444p12le"},
    ],
    ids=["PQ", "no primaries", "no matrix", "8 bits", "12 bits without lost colours"],
)
def test_odd_hdr_is_kept_and_tagged(tmp_path, changes):
    source = write_hdr(tmp_path / "in.mkv", example_pairs(2), **changes)
    assert run(source, tmp_path / "out.mp4", "--position", "0", "--bits", "10") == 0
    frames = decoded(tmp_path / "out.mp4")
    transfer = changes.get("transfer", HLG)
    assert (frames[0].color_trc, frames[0].color_primaries, frames[0].colorspace) == (transfer, 9, 9)
    left = luma(frames[0])
    scale = {"yuv420p": 0.25, "yuv444p12le": 4}.get(changes.get("pix_fmt"), 1)
    plane = decoded(source)[0].planes[0]
    kind = np.uint8 if scale == 0.25 else np.uint16
    codes = np.frombuffer(bytes(plane), kind).reshape(plane.height, -1)[:, :160] / scale
    assert abs(left.mean() - codes.mean()) < 2


def test_a_damaged_frame_of_hdr_is_bridged_in_all_bits(tmp_path, capsys):
    source = damage(write_hdr(tmp_path / "in.mkv", example_pairs(6)), 3)
    assert run(source, tmp_path / "out.mp4", "--position", "0", "--bits", "10") == 0
    assert len(decoded(tmp_path / "out.mp4")) == 6


def test_an_odd_size_is_padded_in_10_bits(tmp_path):
    pairs = [(left[:95, :159], right[:95, :159]) for left, right in example_pairs(2)]
    source = write_side_by_side(tmp_path / "in.mkv", pairs, codec="ffv1")
    for words in (["--position", "0.5", "--bits", "10"], ["--depth10"]):
        assert run(source, tmp_path / "out.mp4", *words) == 0
        assert (decoded(tmp_path / "out.mp4")[0].width, decoded(tmp_path / "out.mp4")[0].height) == (160, 96)


def test_bits_are_a_setting_of_python_too():
    assert VideoJob(layout="crossed", bits=10).is_fine
    assert not VideoJob(layout="quilt", bits=10).is_fine
    with pytest.raises(StereoweaveError, match="bits: expected 8 or 10, found -8"):
        VideoJob(position=0.5, bits=-8)
