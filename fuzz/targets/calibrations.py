"""Calibrations in every supported format, and pictures rectified with them."""

from pathlib import Path

import cv2
import numpy as np

from fuzz.targets import Target, write_to_bytes
from fuzz.targets.pictures import eyes
from stereoweave.cameras.calibration_files import read_rig, write_rig
from stereoweave.cameras.rectify import rectify
from stereoweave.cameras.rig import Optics, Rig
from stereoweave.stereo import StereoPair

MIDDLEBURY = """cam0=[60 0 36; 0 60 24; 0 0 1]
cam1=[60 0 38; 0 60 24; 0 0 1]
doffs=2
baseline=193.001
width=72
height=48
ndisp=36
"""
KALIBR = """cam0:
  camera_model: pinhole
  distortion_coeffs: [-0.01, 2e-3, -3.0e-04, 0.0005]
  distortion_model: equidistant
  intrinsics: [61.6, 60.3, 36.0, 24.1]
  resolution: [72, 48]
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.11]
  - [0.0, 1.0, 0.0, 0.001]
  - [0.0, 0.0, 1.0, 0.002]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [-0.02, 0.003, -0.0004, 0.0006]
  distortion_model: equidistant
  intrinsics: [60.0, 59.0, 37.0, 24.1]
  resolution: [72, 48]
"""
_KITTI = """P0: 70 0 36 0 0 70 24 0 0 0 1 0
P1: 70 0 36 -38 0 70 24 0 0 0 1 0
P2: 70 0 36 4 0 70 24 0 0 0 1 0
P3: 70 0 36 -33 0 70 24 0 0 0 1 0
"""
_KITTI_RAW = """calib_time: 09-Jan-2012 13:57:47
S_02: 72 48
K_02: 90 0 36 0 90 24 0 0 1
D_02: -0.37 0.2 0.001 0.002 -0.07
R_02: 1 0 0 0 1 0 0 0 1
T_02: 0 0 0
S_rect_02: 70 46
P_rect_02: 70 0 36 0 0 70 24 0 0 0 1 0
S_03: 72 48
K_03: 91 0 36 0 91 24 0 0 1
D_03: -0.36 0.1 0.001 0.002 -0.06
R_03: 1 0 0 0 1 0 0 0 1
T_03: -0.5 0 0
S_rect_03: 70 46
P_rect_03: 70 0 36 -35 0 70 24 0 0 0 1 0
"""
# Each list contains the previous one nine times.
_LAUGHS = b"\nx0: &x0 [1]\n" + b"\n".join(
    b"x%d: &x%d [%s]" % (level, level, b", ".join([b"*x%d" % (level - 1)] * 9)) for level in range(1, 10)
)


def _starts() -> dict[str, bytes]:
    texts = {
        "calib.txt": MIDDLEBURY,
        "camchain.yaml": KALIBR,
        "P.txt": _KITTI,
        "cam_to_cam.txt": _KITTI_RAW,
    }
    written_by_us = write_to_bytes("rig.yml", lambda path: write_rig(path, _rig()))
    by_opencv = {f"rig{ending}": _written_by_opencv(ending) for ending in (".yml", ".xml", ".json")}
    return {name: text.encode() for name, text in texts.items()} | by_opencv | {"ours.yml": written_by_us}


def _rig() -> Rig:
    optics = Optics(
        matrix=np.array([[60.0, 0, 36], [0, 60, 24], [0, 0, 1]]),
        distortion=np.array([-0.1, 0.01, 1e-3, 0, 0]),
    )
    rotation = cv2.Rodrigues(np.array([0.01, -0.02, 0.005]))[0]
    return Rig(
        left=optics, right=optics, rotation=rotation, translation_m=np.array([-0.1, 0, 0]), size_px=(72, 48)
    )


def _written_by_opencv(ending: str) -> bytes:
    rig = _rig()
    storage = cv2.FileStorage(ending, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    entries = {"K1": rig.left.matrix, "K2": rig.right.matrix}
    entries |= {"D1": rig.left.distortion.reshape(1, -1), "D2": np.zeros((1, 5))}
    entries |= {"R": rig.rotation, "T": rig.translation_m.reshape(3, 1)}
    for name, value in entries.items():
        storage.write(name, value)
    storage.write("image_width", 72)
    storage.write("image_height", 48)
    text: str = storage.releaseAndGetString()
    return text.encode()


def _read(path: Path) -> None:
    left, right = eyes()
    pair = StereoPair(left=left, right=right)
    rectify(pair, read_rig(path, (72, 48)))


TARGET = Target(
    starts=_starts,
    read=_read,
    tokens=(
        *b"*a [ { <a> </a> &amp; <!-- [*a,*a] %YAML:1.0 data:[ type_id= \xff\xfe \0".split(),
        *(b"[" * 20_000, b'{"a":' * 20_000, b"<a>" * 30_000, b"\nM1: &a [*a, *a]\n", _LAUGHS),
        *(b"&a ", b"&a [*a, *a]", b"<<: *a", b"!!opencv-matrix", b"!!python/object:os.system", b"!!binary "),
        *(b"- ", b"? ", b"<!DOCTYPE a>", b'{"a":', b'"', b"\n", b"  ", b"---\n", b"dt: d\n", b"rows: "),
        *(b"M1: ", b"cam0: ", b"P3: ", b"distortion_model: fisheye\n", b"translation_unit: cm\n"),
    ),
)
