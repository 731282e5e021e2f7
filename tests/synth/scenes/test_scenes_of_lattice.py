"""The targets of the lattice scenes are in view, clear of the cameras, and have thin parts."""

from collections.abc import Iterator

import cv2
import numpy as np
import pytest
import trimesh

from stereoweave.stereo import StereoCamera
from stereoweave.synth.rendering.frustum import rays
from stereoweave.synth.scenes import SCENES
from stereoweave.synth.viewpoints import PosedRig, draw_viewpoint, place_rig

NAMES = ("antenna", "pylon", "crane", "wind_turbine")
# Together, these seeds give every kind of each scene: roof, mast and dish; tower and quay crane; turbines at
# sea, on a tube and on a lattice, and a pump.
SEEDS = {"antenna": (0, 2, 4), "pylon": (0, 1), "crane": (0, 3, 4), "wind_turbine": (0, 2, 5, 4)}
FARTHEST_M = 4.6


@pytest.fixture(scope="module")
def stages():
    return {name: [SCENES[name](np.random.default_rng(seed)) for seed in SEEDS[name]] for name in NAMES}


def eyes(stage, count: int) -> Iterator[PosedRig]:
    """Yield rigs at viewpoints drawn from a stage's orbit."""
    rng = np.random.default_rng(1)
    camera = StereoCamera(focal_px=580.0, baseline_m=0.2, cx_px=319.5, cy_px=239.5)
    for _ in range(count):
        yield place_rig(stage.orbit, draw_viewpoint(rng, stage.orbit), camera, (640, 480))


@pytest.mark.parametrize("name", NAMES)
def test_the_target_is_where_the_cameras_look(stages, name):
    for stage in stages[name]:
        mesh = stage.world.mesh
        away_m = np.linalg.norm(mesh.corners_m[mesh.target] - np.array(stage.orbit.centre_m), axis=-1)
        assert 2.2 < away_m.max() < FARTHEST_M
        assert (mesh.corners_m[mesh.target][..., 2] > -1).all()


@pytest.mark.parametrize("name", NAMES)
def test_nothing_stands_where_a_camera_may_be(stages, name):
    for stage in stages[name]:
        corners_m = stage.world.mesh.corners_m.reshape(-1, 3)
        for rig in eyes(stage, 8):
            assert np.linalg.norm(corners_m - rig.eye_m(0.5).astype(np.float32), axis=1).min() > 0.25


@pytest.mark.parametrize("name", NAMES)
def test_three_percent_of_the_target_s_pixels_are_on_parts_less_than_six_pixels_wide(stages, name):
    masks = [target_mask(stage, next(eyes(stage, 1))) for stage in stages[name]]
    assert all(mask.mean() > 0.01 for mask in masks)
    assert np.mean([thin_share(mask) for mask in masks]) >= 0.03


def test_the_thin_share_counts_parts_into_which_no_square_of_six_pixels_fits():
    mask = np.zeros((40, 60), bool)
    mask[10:20, 10:20] = True  # 100 pixels, thick
    mask[30:35, 5:25] = True  # 100 pixels, five wide
    assert thin_share(mask) == 0.5


def target_mask(stage, rig: PosedRig) -> np.ndarray:
    """Return the mask of pixels whose ray hits the target first, found by ray casting."""
    mesh = stage.world.mesh
    corners_m = mesh.corners_m.astype(np.float64)
    surface = trimesh.Trimesh(
        corners_m.reshape(-1, 3), np.arange(corners_m.size // 3).reshape(-1, 3), process=False
    )
    directions = rays(rig).reshape(-1, 3)
    first = surface.ray.intersects_first(np.tile(rig.position_m, (len(directions), 1)), directions)
    return (mesh.target[first] & (first >= 0)).reshape(480, 640)


def thin_share(mask: np.ndarray) -> float:
    """Return the fraction of a mask's pixels that a morphological opening by 6x6 removes."""
    square = np.ones((6, 6), np.uint8)
    # A square of even size has no centre pixel; the mirrored anchor for dilation cancels the shift.
    opened = cv2.dilate(cv2.erode(mask.astype(np.uint8), square), square, anchor=(2, 2))
    return float(1 - opened.sum() / mask.sum())
