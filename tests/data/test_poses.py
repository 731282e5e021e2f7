import numpy as np
import pytest
from dataset_examples import error_of

from stereoweave.data.poses import Pose, find_nearest_frames, read_poses, write_poses


def turned(angle_deg, axis):
    """Return the axes of a camera that is turned about one of the world's axes."""
    cos, sin = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    axes, (first, second) = np.eye(3), [(1, 2), (2, 0), (0, 1)][axis]
    axes[first, first] = axes[second, second] = cos
    axes[first, second], axes[second, first] = sin, -sin
    return axes


def pose(x=0.0, y=0.0, z=0.0, axes=None, time_s=0.0):
    return Pose(time_s=time_s, position_m=np.array([x, y, z]), axes=np.eye(3) if axes is None else axes)


def test_poses_are_read_back_by_the_names_of_their_frames(tmp_path):
    rng = np.random.default_rng(0)
    made = [
        pose(*rng.normal(size=3), axes=np.linalg.qr(rng.normal(size=(3, 3)))[0], time_s=i / 30)
        for i in range(6)
    ]
    made = [pose(*p.position_m, axes=p.axes * np.linalg.det(p.axes), time_s=p.time_s) for p in made]
    write_poses(tmp_path, "ship/000", made[:4])
    write_poses(tmp_path, "ship/001", made[4:])
    found = read_poses(tmp_path)
    assert list(found) == [*(f"ship/000/00000{i}" for i in range(4)), "ship/001/000000", "ship/001/000001"]
    for one, other in zip(found.values(), made, strict=True):
        assert one.time_s == pytest.approx(other.time_s, abs=1e-9)
        np.testing.assert_allclose(one.position_m, other.position_m, atol=1e-9)
        np.testing.assert_allclose(one.axes, other.axes, atol=1e-8)


def test_a_file_of_poses_is_tum_s_from_the_camera_to_the_world(tmp_path):
    """A camera that looks along the world's y has its right along x and its down along -z."""
    axes = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    write_poses(tmp_path, "ship/000", [pose(1.5, -2, 3, axes, time_s=0.1)])
    comment, line = (tmp_path / "poses/ship/000.txt").read_text().splitlines()
    assert comment[0] == "#"
    half = 0.5**0.5  # a turn by -90 degrees about x takes forward (z) to y, and down (y) to -z
    numbers = [float(word) for word in line.split()]
    np.testing.assert_allclose(numbers, [0.1, 1.5, -2, 3, -half, 0, 0, half], atol=1e-9)


@pytest.mark.parametrize("angle_deg", [0.0, 90.0, 180.0])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_turns_up_to_half_a_circle_are_kept(tmp_path, angle_deg, axis):
    write_poses(tmp_path, "ship/000", [pose(axes=turned(angle_deg, axis))])
    np.testing.assert_allclose(
        read_poses(tmp_path)["ship/000/000000"].axes, turned(angle_deg, axis), atol=1e-8
    )


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("0 0 0 0 0 0 1\n", "frame 0 has 7 numbers"),
        ("0 0 0 0 0 0 0 1\n0 0 0 nan 0 0 0 1\n", "frame 1 has 8 numbers, not 8 finite ones"),
        ("0 0 0 0 0 0 0 2\n", "the quaternion of frame 0 has not the length 1"),
        ("0 0 0 0 0 0 0 one\n", "could not convert"),
    ],
)
def test_damaged_poses_are_a_one_line_error(tmp_path, text, told):
    (tmp_path / "poses/ship").mkdir(parents=True)
    (tmp_path / "poses/ship/000.txt").write_text(text)
    message = error_of(read_poses, tmp_path)
    assert message.startswith(f"{tmp_path}/poses/ship/000.txt: expected camera poses")
    assert told in message


def test_a_set_without_poses_is_a_one_line_error(tmp_path):
    assert error_of(read_poses, tmp_path).startswith(f"{tmp_path}/poses: expected the camera poses")


def test_the_nearest_frame_is_the_one_of_the_same_world_whose_camera_is_nearest():
    poses = {f"ship/000/{i:06d}": pose(x=float(x)) for i, x in enumerate([0, 1, 2, 10])}
    poses["ship/001/000000"] = pose(x=2.1)
    names = ["ship/000/000002"]
    others = ["ship/000/000000", "ship/000/000001", "ship/000/000003", "ship/001/000000"]
    assert find_nearest_frames(names, others, poses) == {"ship/000/000002": "ship/000/000001"}


def test_in_an_unseen_world_the_nearest_frame_is_of_any_other_world():
    poses = {"ship/000/000000": pose(x=5), "ship/001/000000": pose(x=3), "ship/002/000000": pose(x=2)}
    names = ["ship/002/000000"]
    assert find_nearest_frames(names, list(poses)[:2], poses) == {"ship/002/000000": "ship/001/000000"}


@pytest.mark.parametrize(("moved_m", "nearest"), [(1.0, 1), (1.1, 0)])
def test_a_turn_counts_like_the_shift_of_a_point_6_m_ahead(moved_m, nearest):
    """6 m times 10 degrees are 1.047 m."""
    poses = {"ship/000/000000": pose(axes=turned(10, 1)), "ship/000/000001": pose(y=moved_m)}
    poses["ship/000/000002"] = pose()
    found = find_nearest_frames(["ship/000/000002"], list(poses)[:2], poses)
    assert found == {"ship/000/000002": f"ship/000/00000{nearest}"}


def test_frames_without_a_pose_and_nothing_to_search_are_one_line_errors():
    poses = {"ship/000/000000": pose()}
    assert "ship/000/000001: expected a frame with a known pose" in error_of(
        find_nearest_frames, ["ship/000/000001"], list(poses), poses
    )
    assert "expected at least one, found none" in error_of(find_nearest_frames, list(poses), [], poses)
