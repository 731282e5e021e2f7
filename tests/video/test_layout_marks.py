from math import sqrt

import av
import numpy as np
import pytest
from av.sidedata.sidedata import Type
from spatial_examples import SPATIAL, spatial_boxes, with_boxes
from video_examples import example_pairs, write_side_by_side

from stereoweave.cli.root import main
from stereoweave.stereo import StereoCamera
from stereoweave.video.layout_marks import find_baseline_m, mark_layout
from stereoweave.video.reader import open_video

# 90 degrees at a width of 200 px.
CAMERA = StereoCamera(focal_px=100.0, baseline_m=0.06, cx_px=99.5, cy_px=49.5)


def run(*words):
    return main(["video", *map(str, words), "--threads", "1"])


def stereo_3d(path):
    """Return FFmpeg's AVStereo3D as a list, but for the primary eye."""
    with av.open(str(path)) as container:
        side_data = next(container.decode(video=0)).side_data
    # The container's comes first, then what H.264 itself says.
    data = next(side_data[at] for at in range(len(side_data)) if side_data[at].type == Type.STEREO3D)
    numbers = np.frombuffer(bytes(data), np.int32).tolist()
    return [*numbers[:3], *numbers[4:]]


UNCHANGED = {"strength": 1.0, "convergence_px": 0.0, "fitted": False}


def test_strength_scales_the_baseline():
    baseline_m = find_baseline_m(0.06, **UNCHANGED | {"strength": 1.5})
    marks = mark_layout("top_bottom", CAMERA, 200, baseline_m)
    assert (marks.packing, marks.right_first) == ("top_bottom", False)
    assert marks.field_of_view_deg == pytest.approx(90)
    assert marks.baseline_m == pytest.approx(0.09)


@pytest.mark.parametrize("changes", [{"strength": 0.0}, {"convergence_px": 3.0}, {"fitted": True}])
def test_a_baseline_that_gives_no_depth_is_left_out(changes):
    baseline_m = find_baseline_m(0.06, **UNCHANGED | changes)
    marks = mark_layout("side_by_side", CAMERA, 200, baseline_m)
    assert marks.baseline_m is None
    assert marks.field_of_view_deg == pytest.approx(90)


@pytest.mark.parametrize("layout", [None, "anaglyph_dubois", "quilt", "rgbd", "contact_sheet"])
def test_layouts_without_a_view_for_each_eye_are_not_marked(layout):
    assert mark_layout(layout, CAMERA, 200, 0.06) is None


@pytest.mark.parametrize(
    ("layout", "mark", "kind"),
    [("side_by_side", "_LRF_Full_SBS", 1), ("top_bottom_half", "_half_TB", 2)],
)
def test_a_layout_of_a_spatial_video_is_marked_with_its_camera(tmp_path, layout, mark, kind):
    assert run(SPATIAL, "-o", tmp_path / "out.mov", "--layout", layout, "--preview", "0.1s") == 0
    made = tmp_path / f"out_preview{mark}.mov"
    # Packed, not inverted, both views; 63500 um, no adjustment, 60 degrees.
    assert stereo_3d(made) == [kind, 0, 0, 63500, 0, 1, 60000, 1000]
    video = open_video([made])
    assert (video.frame_packing, video.size_px) == (layout, (320, 192))
    assert video.camera.focal_px == pytest.approx(160 * sqrt(3))
    assert video.camera.baseline_m == 0.0635


def test_views_fitted_to_a_screen_are_marked_without_a_baseline(tmp_path):
    words = "--layout", "side_by_side", "--screen", "television", "--preview", "0.1s"
    assert run(SPATIAL, "-o", tmp_path / "out.mov", *words) == 0
    assert stereo_3d(tmp_path / "out_preview_LRF_Full_SBS.mov") == [1, 0, 0, 0, 0, 1, 60000, 1000]


@pytest.mark.parametrize(("baseline_um", "strength"), [(2_000_000_000, 1), (900_000_000, 2)])
def test_a_baseline_above_a_kilometre_is_left_out(tmp_path, baseline_um, strength):
    far = spatial_boxes(baseline_um=baseline_um, degrees=60)
    (tmp_path / "in.mp4").write_bytes(with_boxes(SPATIAL.read_bytes(), far))
    words = "--layout", "side_by_side", "--strength", strength, "--preview", "0.1s"
    assert run(tmp_path / "in.mp4", "-o", tmp_path / "out.mov", *words) == 0
    assert stereo_3d(tmp_path / "out_preview_LRF_Full_SBS.mov")[3] == 0


def test_crossed_views_of_unknown_cameras_are_marked_as_such(tmp_path):
    source = write_side_by_side(tmp_path / "in.mp4", example_pairs(2), codec="libx264")
    assert run(source, "-o", tmp_path / "out.mp4", "--layout", "crossed", "--format", "side_by_side") == 0
    made = tmp_path / "out_RLF_cross.mp4"
    assert stereo_3d(made)[:3] == [1, 1, 0]  # side by side, inverted
    video = open_video([made])
    assert (video.frame_packing, video.camera) == ("crossed", None)


def test_one_view_is_not_marked(tmp_path):
    assert run(SPATIAL, "-o", tmp_path / "out.mp4", "--position", "0.5", "--preview", "0.1s") == 0
    content = (tmp_path / "out_preview.mp4").read_bytes()
    assert not any(kind in content for kind in (b"st3d", b"vexu", b"hfov"))


@pytest.mark.testdata
def test_the_camera_of_apples_video_is_kept_in_the_marks(testdata, tmp_path):
    source = testdata / "consumer" / "stereo_spatial.mp4"
    assert run(source, "-o", tmp_path / "out.mp4", "--layout", "side_by_side", "--no-rectify") == 0
    # 19240 um and 63.4 degrees, as Apple's encoder wrote them; its adjustment is not applied to the pictures.
    assert stereo_3d(tmp_path / "out_LRF_Full_SBS.mp4") == [1, 0, 0, 19240, 0, 1, 63400, 1000]
