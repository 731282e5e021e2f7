"""Poses of the left cameras of a set's videos, and the training frame nearest to a held-out one.

Each world has a file poses/SCENE/WORLD.txt in the format of TUM's RGB-D benchmark, which ElasticFusion also
writes ("File formats" of https://cvg.cit.tum.de/data/datasets/rgbd-dataset): a line per frame, "time tx ty tz
qx qy qz qw", in seconds and metres. The unit quaternion rotates from the camera's axes (right, down, forward)
to the world's, whose z points up. Lines that start with # are comments.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from stereoweave.errors import FormatError, StereoweaveError
from stereoweave.io.files import make_folder, reading, replacing

POSES_FOLDER = "poses"
_HEADING = "# time_s tx_m ty_m tz_m qx qy qz qw: left camera (right, down, forward) to world (z up)\n"
# Two frames differ by the distance between their cameras plus the distance by which a point so far ahead of
# them shifts when the camera turns. The targets are about this far away.
_LEVER_M = 6.0


@dataclass(frozen=True, kw_only=True)
class Pose:
    """Pose of a left camera.

    Attributes:
        time_s: Time since the start of the video.
        position_m: The camera's centre [3] in the world.
        axes: Rotation [3, 3]; its rows are the camera's right, down and forward axes in the world.
    """

    time_s: float
    position_m: Float[np.ndarray, "3"]
    axes: Float[np.ndarray, "3 3"]


def write_poses(root: Path, world: str, poses: Sequence[Pose]) -> None:
    """Write the poses of a world's frames, such as those of world propeller/000."""
    path = _pose_file(root, world)
    make_folder(path.parent)
    lines = (" ".join(f"{value:.9f}" for value in _as_numbers(pose)) for pose in poses)
    with replacing(path) as temporary:
        temporary.write_text(_HEADING + "".join(f"{line}\n" for line in lines), encoding="utf-8")


def read_poses(root: Path) -> dict[str, Pose]:
    """Read the poses of all frames of a set, by frame name, such as propeller/000/000123.

    Raises:
        FormatError: There are no poses, or a file is damaged.
    """
    folder = root / POSES_FOLDER
    files = sorted(folder.rglob("[!.]*.txt"))
    if not files:
        raise FormatError(
            f"{folder}: expected the camera poses of a set of worlds, found none; make the set with "
            "`stereoweave synth make` and a number of worlds"
        )
    poses: dict[str, Pose] = {}
    for path in files:
        world = path.relative_to(folder).with_suffix("").as_posix()
        poses |= {f"{world}/{frame:06d}": pose for frame, pose in enumerate(_read_file(path))}
    return poses


def find_nearest_frames(
    names: Sequence[str], others: Sequence[str], poses: Mapping[str, Pose]
) -> dict[str, str]:
    """Return, for each frame of `names`, the frame of `others` whose left camera is nearest.

    The nearest frame is of the same world if `others` has any of that world, else of any world; worlds of a
    scene share their coordinates, with the target at the same place. Of equally near frames, the first is
    taken.

    Raises:
        StereoweaveError: `others` is empty, or a frame has no pose.
    """
    if not others:
        raise StereoweaveError("frames to search: expected at least one, found none")
    if missing := [name for name in (*names, *others) if name not in poses]:
        raise StereoweaveError(f"{missing[0]}: expected a frame with a known pose, found none")
    by_world: dict[str, list[str]] = {}
    for name in others:
        by_world.setdefault(name.rpartition("/")[0], []).append(name)
    chosen = {name: by_world.get(name.rpartition("/")[0], others) for name in names}
    return {name: _find_nearest(poses[name], where, poses) for name, where in chosen.items()}


def _find_nearest(pose: Pose, names: Sequence[str], poses: Mapping[str, Pose]) -> str:
    positions_m = np.stack([poses[name].position_m for name in names])
    axes = np.stack([poses[name].axes for name in names])
    # The trace of a rotation by an angle is 1 + 2 cos(angle).
    cosines = (np.einsum("nij,ij->n", axes, pose.axes) - 1) / 2
    turned = np.arccos(np.clip(cosines, -1, 1))
    moved_m = np.linalg.norm(positions_m - pose.position_m, axis=1)
    return names[int(np.argmin(moved_m + _LEVER_M * turned))]


def _pose_file(root: Path, world: str) -> Path:
    return root / POSES_FOLDER / f"{world}.txt"


def _as_numbers(pose: Pose) -> tuple[float, ...]:
    return pose.time_s, *pose.position_m.tolist(), *_quaternion(pose.axes.T).tolist()


def _quaternion(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "4"]:
    """Return the unit quaternion (x, y, z, w), with w >= 0, of a rotation matrix.

    It is the main eigenvector of a symmetric matrix (Bar-Itzhack, "New Method for Extracting the Quaternion
    from a Rotation Matrix", 2000), which is exact for every angle.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation
    symmetric = np.array(
        [
            [xx - yy - zz, xy + yx, xz + zx, zy - yz],
            [xy + yx, yy - xx - zz, yz + zy, xz - zx],
            [xz + zx, yz + zy, zz - xx - yy, yx - xy],
            [zy - yz, xz - zx, yx - xy, xx + yy + zz],
        ]
    )
    found = np.linalg.eigh(symmetric)[1][:, -1]
    return found if found[3] >= 0 else -found


def _rotation(quaternion: Float[np.ndarray, "4"]) -> Float[np.ndarray, "3 3"]:
    vector, w = quaternion[:3], quaternion[3]
    cross = np.cross(np.eye(3), vector)
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def _read_file(path: Path) -> list[Pose]:
    with reading(path, "camera poses, a line of 8 numbers per frame"):
        lines = path.read_text(encoding="utf-8").splitlines()
        rows = [[float(word) for word in line.split()] for line in lines if line.strip() and line[0] != "#"]
        for number, row in enumerate(rows):
            if len(row) != 8 or not np.isfinite(row).all():
                raise ValueError(f"frame {number} has {len(row)} numbers, not 8 finite ones")
            if abs(np.linalg.norm(row[4:]) - 1) > 1e-3:
                raise ValueError(f"the quaternion of frame {number} has not the length 1")
    return [_as_pose(np.array(row)) for row in rows]


def _as_pose(row: Float[np.ndarray, "8"]) -> Pose:
    quaternion = row[4:] / np.linalg.norm(row[4:])
    return Pose(time_s=float(row[0]), position_m=row[1:4], axes=_rotation(quaternion).T)
