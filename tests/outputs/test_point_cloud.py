import json
import sys

import cv2
import numpy as np
import pytest
import trimesh

from stereoweave.errors import StereoweaveError
from stereoweave.outputs.point_cloud import (
    EmptyError,
    Mesh,
    PointCloud,
    find_reliable,
    make_mesh,
    make_point_cloud,
    write_glb,
    write_ply,
)
from stereoweave.stereo import Estimate, StereoCamera, StereoPair

# 100 px * 0.1 m: a disparity of 5 px is 2 m away, 20 px is 0.5 m away.
CAMERA = StereoCamera(focal_px=100.0, baseline_m=0.1, cx_px=30.0, cy_px=20.0)
FAR_PX, NEAR_PX = 5.0, 20.0


def estimate_of(disparity_px, **others) -> Estimate:
    maps = {
        "disparity_px": disparity_px.astype(np.float32),
        "right_disparity_px": disparity_px.astype(np.float32),
        "confidence": np.ones(disparity_px.shape, np.float32),
        "occluded": np.zeros(disparity_px.shape, bool),
    }
    return Estimate(**maps | others)


def pair_of(size, *, camera=CAMERA, left_seen=None) -> StereoPair:
    left = np.random.default_rng(0).integers(0, 256, (*size, 3), dtype=np.uint8)
    return StereoPair(left=left, right=left, camera=camera, left_seen=left_seen)


def two_planes(height=40, width=60) -> np.ndarray:
    """Return the disparity of a square in front of a wall."""
    disparity_px = np.full((height, width), FAR_PX, np.float32)
    disparity_px[10:30, 20:40] = NEAR_PX
    return disparity_px


@pytest.mark.parametrize("doffs_px", [0.0, 3.0])
def test_a_pixel_becomes_the_point_that_it_shows(doffs_px):
    camera = StereoCamera(focal_px=100.0, baseline_m=0.1, cx_px=30.0, cy_px=20.0, doffs_px=doffs_px)
    pair = pair_of((40, 60), camera=camera)
    cloud = make_point_cloud(pair, estimate_of(np.full((40, 60), FAR_PX - doffs_px)))
    assert cloud.points_m.shape == (2400, 3)
    # 10 px right of the middle and 8 above it, at 2 m: 10 / 100 * 2 and -8 / 100 * 2
    np.testing.assert_allclose(cloud.points_m[12 * 60 + 40], [0.2, -0.16, 2.0], rtol=1e-6)
    np.testing.assert_array_equal(cloud.colours[12 * 60 + 40], pair.left[12, 40])


@pytest.mark.parametrize("blur_px", [1, 2, 3, 4, 5, 7, 9])
@pytest.mark.parametrize("turned_degrees", [0, 30, 45])
def test_no_point_flies_between_two_planes(blur_px, turned_degrees):
    turn = cv2.getRotationMatrix2D((30, 20), turned_degrees, 1)
    sharp_px = cv2.warpAffine(
        two_planes(), turn, (60, 40), flags=cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE
    )
    blurred_px = cv2.blur(sharp_px, (blur_px, blur_px))
    flying = (blurred_px > FAR_PX + 1.5) & (blurred_px < NEAR_PX - 1.5)
    assert flying.any() == (blur_px > 1)
    pair, estimate = pair_of((40, 60)), estimate_of(blurred_px)
    for depth_m in (
        make_point_cloud(pair, estimate).points_m[:, 2],
        make_mesh(pair, estimate).points_m[:, 2],
    ):
        # Within 1.5 px of a plane: 10 / 18.5 m, 10 / 6.5 m
        assert ((depth_m < 0.541) | (depth_m > 1.538)).all()
        assert depth_m.min() < 0.51 and depth_m.max() > 1.99


def test_a_sharp_edge_loses_no_point():
    assert find_reliable(pair_of((40, 60)), estimate_of(two_planes())).all()


def test_a_thin_rod_and_a_slanted_surface_keep_all_their_points():
    slanted_px = np.broadcast_to(np.linspace(2, 26, 61)[:60], (40, 60)).copy()  # 0.4 px per px
    slanted_px[:, 30] = 60
    assert find_reliable(pair_of((40, 60)), estimate_of(slanted_px)).all()


def test_pixels_without_reliable_depth_give_no_points():
    disparity_px, confidence = np.full((40, 60), FAR_PX), np.full((40, 60), 0.5, np.float32)
    occluded, left_seen = np.zeros((40, 60), bool), np.ones((40, 60), bool)
    confidence[0, 0] = 0.49
    occluded[0, 1] = True
    left_seen[0, 2] = False
    disparity_px[0, 3:] = 0.0  # infinitely far
    disparity_px[1] = 0.5  # nearly infinitely far
    pair = pair_of((40, 60), left_seen=left_seen)
    estimate = estimate_of(disparity_px, confidence=confidence, occluded=occluded)
    expected = np.ones((40, 60), bool)
    expected[:2] = False
    np.testing.assert_array_equal(find_reliable(pair, estimate), expected)
    assert len(make_point_cloud(pair, estimate).points_m) == 38 * 60
    assert not find_reliable(pair, estimate, least_confidence=0.6).any()


def test_the_mesh_of_a_wall_has_two_triangles_per_square_facing_the_camera():
    wall = make_mesh(pair_of((40, 60)), estimate_of(np.full((40, 60), FAR_PX)))
    assert (len(wall.points_m), len(wall.faces)) == (40 * 60, 2 * 39 * 59)
    corners_m = wall.points_m[wall.faces]
    normals = np.cross(corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0])
    # A square of 1 px at 2 m is 0.02 m wide; z points away from the camera.
    np.testing.assert_allclose(normals, np.broadcast_to([0, 0, -0.0004], normals.shape), atol=1e-7)


def test_no_triangle_crosses_a_jump_of_depth():
    found = make_mesh(pair_of((40, 60)), estimate_of(two_planes()))
    depths_m = found.points_m[found.faces][..., 2]
    assert np.ptp(depths_m, axis=1).max() == 0
    # The square of 20x20 pixels, and the wall without the 21x21 grid squares that touch it.
    assert (depths_m[:, 0] == 0.5).sum() == 2 * 19 * 19
    # At two corners of the square, one triangle of three wall pixels remains.
    assert (depths_m[:, 0] == 2).sum() == 2 * (39 * 59 - 21 * 21) + 2


def test_a_point_without_a_neighbour_is_not_part_of_a_mesh():
    confidence = np.zeros((40, 60), np.float32)
    confidence[5, 5] = confidence[20:22, 20:22] = 1
    found = make_mesh(pair_of((40, 60)), estimate_of(np.full((40, 60), FAR_PX), confidence=confidence))
    assert (len(found.points_m), len(found.faces)) == (4, 2)
    assert set(found.faces.ravel()) == {0, 1, 2, 3}


def test_a_large_picture_is_thinned_to_every_nth_pixel():
    pair, estimate = pair_of((40, 60)), estimate_of(two_planes())
    cloud = make_point_cloud(pair, estimate, most_points=300)
    # Every second row and column would give 20 * 30 = 600 points, every third gives 14 * 20 = 280.
    assert (cloud.step_px, len(cloud.points_m)) == (3, 280)
    whole = make_point_cloud(pair, estimate)
    picked = np.arange(2400).reshape(40, 60)[::3, ::3].ravel()
    np.testing.assert_array_equal(cloud.points_m, whole.points_m[picked])
    np.testing.assert_array_equal(cloud.colours, whole.colours[picked])
    wall = make_mesh(pair, estimate_of(np.full((40, 60), FAR_PX)), most_points=300)
    assert (wall.step_px, len(wall.faces)) == (3, 2 * 13 * 19)


@pytest.mark.parametrize("make", [make_point_cloud, make_mesh])
@pytest.mark.parametrize("most_points", [0, -1])
def test_fewer_points_than_one_are_refused(make, most_points):
    with pytest.raises(StereoweaveError, match=f"^most_points: expected at least 1, found {most_points}$"):
        make(pair_of((4, 6)), estimate_of(np.full((4, 6), FAR_PX)), most_points=most_points)


def test_a_ply_file_holds_points_in_metres_in_the_axes_of_viewers_with_colours(tmp_path):
    cloud = make_point_cloud(pair_of((40, 60)), estimate_of(two_planes()))
    write_ply(tmp_path / "cloud.ply", cloud)
    found = trimesh.load(tmp_path / "cloud.ply")
    x, y, z = cloud.points_m.T
    np.testing.assert_array_equal(found.vertices, np.stack([x, -y, -z], axis=1))
    np.testing.assert_array_equal(found.colors[:, :3], cloud.colours)
    # The first pixel is left of the centre and above it: 30 / 100 * 2, 20 / 100 * 2, and 2 m ahead.
    np.testing.assert_allclose(found.vertices[0], [-0.6, 0.4, -2], rtol=1e-6)
    assert list(tmp_path.iterdir()) == [tmp_path / "cloud.ply"]


def test_a_ply_file_holds_a_mesh(tmp_path):
    made = make_mesh(pair_of((40, 60)), estimate_of(two_planes()))
    write_ply(tmp_path / "mesh.ply", made)
    found = trimesh.load(tmp_path / "mesh.ply", process=False)
    np.testing.assert_array_equal(found.faces, made.faces)
    np.testing.assert_array_equal(found.vertices, made.points_m * [1, -1, -1])
    np.testing.assert_array_equal(found.visual.vertex_colors[:, :3], made.colours)
    assert (found.face_normals[:, 2] > 0.99).all()  # towards the camera


GREYS = {0: 0.0, 10: 10 / 255 / 12.92, 11: 11 / 255 / 12.92, 188: 0.50289, 255: 1.0}


@pytest.mark.parametrize("kind", [PointCloud, Mesh])
def test_a_glb_file_holds_the_same_with_unlit_colours(tmp_path, kind):
    colours = np.repeat(np.array(list(GREYS), np.uint8)[:, None], 3, axis=1)
    points_m = np.array([[0, 0, 1], [1, 0, 1], [0, 1, 1], [1, 1, 1], [2, 3, 4]], np.float32)
    faces = {"faces": np.array([[0, 2, 1], [1, 2, 3], [3, 2, 4]], np.int32)} if kind is Mesh else {}
    write_glb(tmp_path / "it.glb", kind(points_m=points_m, colours=colours, **faces))
    (found,) = trimesh.load(tmp_path / "it.glb", process=False).geometry.values()
    np.testing.assert_array_equal(found.vertices, points_m * [1, -1, -1])
    if kind is Mesh:
        np.testing.assert_array_equal(found.faces, faces["faces"])
    tree, data = chunks(tmp_path / "it.glb")
    (primitive,) = tree["meshes"][0]["primitives"]
    light = values(tree, data, primitive["attributes"]["COLOR_0"])
    # glTF's colours are linear: grey 188 of 255 is half the light of white.
    np.testing.assert_allclose(
        light, np.repeat(np.array(list(GREYS.values()))[:, None], 3, axis=1), atol=1e-5
    )
    assert primitive["mode"] == (4 if kind is Mesh else 0)
    # The image already contains the scene's lighting, so the viewer must not add any.
    assert tree["extensionsUsed"] == ["KHR_materials_unlit"]
    assert "KHR_materials_unlit" in tree["materials"][primitive["material"]]["extensions"]
    assert all("matrix" not in node for node in tree["nodes"])


def chunks(path) -> tuple[dict, bytes]:
    """Return the two chunks of a GLB file: its JSON description and the binary data."""
    content = path.read_bytes()
    assert (content[:4], int.from_bytes(content[8:12], "little")) == (b"glTF", len(content))
    length = int.from_bytes(content[12:16], "little")
    return json.loads(content[20 : 20 + length]), content[28 + length :]


def values(tree: dict, data: bytes, accessor_at: int) -> np.ndarray:
    """Return the values of an accessor, float32 [N, 3]."""
    accessor = tree["accessors"][accessor_at]
    assert (accessor["componentType"], accessor["type"]) == (5126, "VEC3")
    view = tree["bufferViews"][accessor["bufferView"]]
    return np.frombuffer(data, "<f4", 3 * accessor["count"], view["byteOffset"]).reshape(-1, 3)


def test_a_point_cloud_needs_a_camera(tmp_path):
    pair = pair_of((40, 60), camera=None)
    for make in (make_point_cloud, make_mesh):
        with pytest.raises(StereoweaveError, match=r"calibration.*\(calibration, focal_px, baseline_m\)"):
            make(pair, estimate_of(two_planes()))


def test_a_pair_without_known_depth_is_an_error():
    nothing = estimate_of(two_planes(), confidence=np.zeros((40, 60), np.float32))
    with pytest.raises(EmptyError, match="known depth, found none"):
        make_point_cloud(pair_of((40, 60)), nothing)
    speckled = (np.indices((40, 60)).sum(axis=0) % 2).astype(np.float32)
    with pytest.raises(EmptyError, match="on the same surface, found none"):
        make_mesh(pair_of((40, 60)), estimate_of(two_planes(), confidence=speckled))


def test_without_trimesh_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "trimesh", None)
    cloud = PointCloud(points_m=np.zeros((1, 3), np.float32), colours=np.zeros((1, 3), np.uint8))
    with pytest.raises(StereoweaveError, match=r"stereoweave\[mesh\]"):
        write_ply(tmp_path / "cloud.ply", cloud)
    assert list(tmp_path.iterdir()) == []
