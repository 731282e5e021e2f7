"""Encode and mux pan.mp4. Run: python tests/spatial_video/make.py X265 (x265 4.1 built for several views).

x265 is built by `cmake -DENABLE_MULTIVIEW=ON -DHIGH_BIT_DEPTH=OFF source && make cli` in its own source.
`--large OUT --repeats 30` writes a minute of 1280x720 for `python -m experiments.whole_films` instead.
"""

import argparse
import subprocess
import sys
import tempfile
from fractions import Fraction
from itertools import product
from pathlib import Path

import av
import cv2
import numpy as np

FOLDER = Path(__file__).resolve().parent
sys.path[:0] = [str(FOLDER.parents[1]), str(FOLDER.parent / "helpers")]

from spatial_examples import (  # noqa: E402
    SPATIAL,
    SPATIAL_FRAMES,
    SPATIAL_GROUP,
    spatial_boxes,
    spatial_pairs,
    with_boxes,
)
from video_examples import FRAME_MS, SOUND_RATE, TEXTURED, Pair, _write_sine  # noqa: E402

from stereoweave.io.images import read_image  # noqa: E402


def large_pairs() -> list[Pair]:
    """Return windows of 1280x720 of the example pair, enlarged, that move to the right."""
    left, right = (
        cv2.resize(read_image(TEXTURED / f"{eye}.png"), (1600, 1200), interpolation=cv2.INTER_CUBIC)
        for eye in ("left", "right")
    )
    windows = [np.s_[200:920, 100 + 4 * frame : 1380 + 4 * frame] for frame in range(SPATIAL_FRAMES)]
    return [(left[window], right[window]) for window in windows]


def encode(x265: str, folder: Path, pairs: list[Pair]) -> Path:
    """Encode both views as a raw stream."""
    height_px, width_px = pairs[0][0].shape[:2]
    for eye, name in enumerate(("left", "right")):
        with (folder / f"{name}.yuv").open("wb") as file:
            for pair in pairs:
                frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pair[eye]), "rgb24").reformat(
                    format="yuv420p", src_color_range=2, dst_color_range=1, dst_colorspace=1
                )
                file.write(np.ascontiguousarray(frame.to_ndarray()).tobytes())
    (folder / "views.cfg").write_text('--num-views 2\n--format 0\n--input "left.yuv"\n--input "right.yuv"\n')
    settings = f"--fps 25 --input-res {width_px}x{height_px} --input-csp i420 --preset slow --crf 18 "
    settings += f"--keyint {SPATIAL_GROUP} --min-keyint {SPATIAL_GROUP} --no-open-gop --range limited "
    settings += "--colorprim bt709 --transfer bt709 --colormatrix bt709"
    subprocess.run(
        [x265, "--multiview-config", "views.cfg", *settings.split(), "-o", "pan.hevc"], cwd=folder, check=True
    )
    return folder / "pan.hevc"


def mux(stream: Path, out: Path, repeats: int) -> None:
    """Write the repeated stream and a sine of 440 Hz to an MP4 file, with times in display order."""
    with av.open(str(stream)) as source, av.open(str(out), "w") as container:
        video = source.streams.video[0]
        video.codec_context.copy_opaque = True
        packets, decoded = [], []
        for packet in source.demux(video):
            if packet.size:
                packet.opaque = len(packets)
                packets.append(packet)
            decoded += video.decode(packet)
        shown = [frame.opaque for frame in decoded]
        key_ranks = {frame.opaque for frame in decoded if frame.key_frame}
        delay = max(rank - shown.index(rank) for rank in shown)
        track = container.add_stream_from_template(video)
        sound = container.add_stream("aac", rate=SOUND_RATE)
        # x265 writes the parameter sets of both layers once, before the first SEI message. With them in front
        # of each key frame, a player can begin there.
        head = bytes(packets[0]).split(b"\0\0\1\x4e\x01")[0].rstrip(b"\0")
        for first, (rank, encoded) in product(
            range(0, repeats * len(packets), len(packets)), enumerate(packets)
        ):
            packet = av.Packet(head * (rank > 0 and rank in key_ranks) + bytes(encoded))
            packet.stream, packet.time_base = track, Fraction(FRAME_MS, 1000)
            packet.pts, packet.dts, packet.duration = first + shown.index(rank), first + rank - delay, 1
            packet.is_keyframe = rank in key_ranks
            container.mux(packet)
        _write_sine(container, sound, repeats * len(packets) * FRAME_MS / 1000)


parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("x265")
parser.add_argument("--large", type=Path, metavar="OUT", help="write 1280x720 to this file instead")
parser.add_argument("--repeats", type=int, default=1, help="how often the two seconds are repeated")
arguments = parser.parse_args()
film = arguments.large or SPATIAL
with tempfile.TemporaryDirectory() as name:
    pairs = large_pairs() if arguments.large else spatial_pairs()
    mux(encode(str(Path(arguments.x265).resolve()), Path(name), pairs), film, arguments.repeats)
film.write_bytes(
    with_boxes(film.read_bytes(), spatial_boxes(baseline_um=63_500, degrees=60.0, adjustment=150))
)
