"""Directional antennas face +x, and a paraboloid reflects rays along its axis to its focus."""

import numpy as np
import pytest

from stereoweave.synth.props.antennas import dipoles, drum, panel, paraboloid, satellite_dish, whip, yagi


def test_a_paraboloid_reflects_rays_along_its_axis_to_its_focus():
    mesh = paraboloid(2.0, 1.5, 1, 0)
    front = mesh.material == 1
    at, normal = (values[front].reshape(-1, 3).astype(float) for values in (mesh.corners_m, mesh.normals))
    within = np.linalg.norm(at[:, :2], axis=1) < 1.9  # the normal at the rim is the last facet's
    down = np.array([0.0, 0, -1])
    reflected = down - 2 * (normal @ down)[:, None] * normal
    to_focus = np.array([0, 0, 1.5]) - at
    to_focus /= np.linalg.norm(to_focus, axis=1, keepdims=True)
    assert (reflected * to_focus).sum(1)[within].min() > np.cos(np.radians(5))


def test_a_paraboloid_is_as_deep_as_its_equation_says():
    corners = paraboloid(2.0, 1.5, 1, 0).corners_m.reshape(-1, 3)
    assert corners[:, 2].max() == pytest.approx(2.0**2 / (4 * 1.5))
    assert np.linalg.norm(corners[:, :2], axis=1).max() == pytest.approx(2.02)


def test_the_rods_of_a_yagi_get_shorter_towards_the_front():
    corners = yagi(1.0, 10, 0, 1).corners_m.reshape(-1, 3)
    assert (corners[:, 0].min(), corners[:, 0].max()) == pytest.approx((-0.33, 0.7 + 0.0045))
    # Rods reach from 0.5 down to 0.36 of 0.32 m to each side; the first is at x = 0.12 - 0.3.
    first, last = (abs(corners[abs(corners[:, 0] - x) < 0.006][:, 1]).max() for x in (-0.18, 0.7))
    assert (first, last) == pytest.approx((0.16, 0.1152), abs=1e-5)


@pytest.mark.parametrize(
    "mesh", [panel(0.6, 0, 1), drum(0.3, 0, 1), satellite_dish(0.4, 0, 1)], ids=["panel", "drum", "dish"]
)
def test_directional_antennas_face_x(mesh):
    edges = mesh.corners_m[:, 1:] - mesh.corners_m[:, :1]
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    middle = (area @ mesh.corners_m.mean(1)) / area.sum()
    assert abs(middle[1]) < 0.02
    assert mesh.corners_m[..., 0].max() > 0.09


def test_upright_antennas_have_the_requested_height():
    assert whip(0.8, 0, 1).corners_m[..., 2].max() == pytest.approx(0.81)
    assert np.ptp(dipoles(3, 0).corners_m[..., 2]) == pytest.approx(3 * 0.42 + 0.1, abs=0.01)
