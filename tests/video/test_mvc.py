import av
import pytest
from video_examples import example_pairs, write_side_by_side, write_video

from stereoweave.errors import FormatError
from stereoweave.video.reader import open_video

# ITU-T H.264: the parameter sets of a second view (type 15) begin with its profile; a slice of it (type 20)
# has a header extension of three bytes, whose first bit would be 1 for SVC.
STEREO_HIGH = b"\x6f\x80\x00\x28\xac\xd9"
MULTIVIEW_HIGH = b"\x6f\x76\x00\x28\xac\xd9"
SECOND_VIEW = b"\x74\x40\x00\x47\x88\x84"
SCALABLE = b"\x6f\x53\x00\x28\xac\xd9", b"\x74\xc0\x00\x47\x88\x84"


def with_units(source, target, *units):
    """Copy an H.264 video, with these NAL units at the end of each packet."""
    with av.open(str(source)) as file, av.open(str(target), "w") as copy:
        stream = copy.add_stream_from_template(file.streams.video[0])
        for packet in file.demux(video=0):
            if packet.dts is None:
                continue
            more = b"".join(len(unit).to_bytes(4) + unit for unit in units)
            changed = av.Packet(bytes(packet) + more)
            changed.pts, changed.dts, changed.time_base = packet.pts, packet.dts, packet.time_base
            changed.is_keyframe, changed.stream = packet.is_keyframe, stream
            copy.mux(changed)
    return target


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    path = tmp_path_factory.mktemp("mvc") / "plain.mp4"
    return write_side_by_side(path, example_pairs(3), codec="libx264")


@pytest.mark.parametrize("ending", ["mkv", "mp4", "ts"])
@pytest.mark.parametrize("units", [[STEREO_HIGH], [MULTIVIEW_HIGH, SECOND_VIEW], [SECOND_VIEW]])
def test_the_second_view_of_a_blu_ray_is_named(tmp_path, plain, units, ending):
    path = with_units(plain, tmp_path / f"film.{ending}", *units)
    for format in (None, "side_by_side", "frame_sequential"):
        with pytest.raises(FormatError) as caught:
            open_video([path], format)
        assert str(caught.value) == (
            f"{path}: expected views that can be decoded, found MVC (H.264 Stereo High, as on 3-D Blu-rays), "
            "of which FFmpeg decodes one view alone; convert it to side by side by a program that decodes "
            "both, such as BD3D2MK3D or FRIM"
        )


@pytest.mark.parametrize("ending", ["mkv", "mp4", "ts"])
@pytest.mark.parametrize("units", [[], SCALABLE, [b"\x74"], [b"\x6f"]])
def test_other_h264_is_read(tmp_path, plain, units, ending):
    path = with_units(plain, tmp_path / f"film.{ending}", *units)
    assert open_video([path]).frame_packing == "side_by_side"


def test_the_base_view_can_still_be_one_of_two_files(tmp_path):
    plain = write_video(tmp_path / "plain.mp4", [left for left, _ in example_pairs(2)], codec="libx264")
    base = with_units(plain, tmp_path / "base.mkv", STEREO_HIGH, SECOND_VIEW)
    assert open_video([base, plain]).frame_count == 2


def test_a_box_of_the_second_view_is_enough(tmp_path):
    """MakeMKV appends the box `mvcC` to the description of the base view."""
    plain = write_video(tmp_path / "plain.mkv", [left for left, _ in example_pairs(2)], codec="libx264")
    with av.open(str(plain)) as file:
        description = file.streams.video[0].codec_context.extradata
    content = plain.read_bytes()
    at = content.find(description)
    assert at > 0
    # The last bytes of a parameter set give way, so that all lengths stay.
    changed = description[:-4] + b"mvcC"
    plain.write_bytes(content.replace(description, changed))
    with pytest.raises(FormatError, match="found MVC"):
        open_video([plain])
