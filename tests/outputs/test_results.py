import html
import json
import re
import shlex
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from PIL.ExifTags import Base

from stereoweave.cli.depth import depth
from stereoweave.cli.root import main
from stereoweave.errors import OutputInUseError, StereoweaveError
from stereoweave.io.images import read_image, write_image
from stereoweave.io.maps import read_disparity_png, read_pfm, read_pixels
from stereoweave.io.output_lock import lock_output
from stereoweave.matching.backend import Backend
from stereoweave.matching.matcher import Matcher
from stereoweave.matching.options import MatchOptions
from stereoweave.outputs.report import summarize
from stereoweave.outputs.results import ALWAYS, FILES, DepthJob, job_facts, make_depth, needs_camera
from stereoweave.outputs.run import Result
from stereoweave.pictures.prepare import Request
from stereoweave.stereo import Estimate, StereoCamera, StereoPair

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
TEXTURED = Path(__file__).resolve().parents[1] / "textured_pair"
CALIBRATION = "cam0=[100 0 48; 0 100 32; 0 0 1]\ndoffs=0\nbaseline=80\nwidth=96\nheight=64\n"
CAMERA = StereoCamera(focal_px=100.0, baseline_m=0.08, cx_px=48.0, cy_px=32.0)
METRES = ["--focal-px", "100", "--baseline-m", "0.08"]
PICTURES = [Path("left.png"), Path("right.png")]
PLAIN = DepthJob(backend=Backend(threads=1))
WITH_CAMERA = replace(PLAIN, request=Request(calibration=Path("calib.txt")))


@pytest.fixture(scope="module")
def matcher() -> Matcher:
    return Matcher("small", threads=1)


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """Run the test in a folder with a 96x64 px crop of the example and its calibration."""
    monkeypatch.chdir(tmp_path)
    for name in ("left.png", "right.png"):
        write_image(name, np.ascontiguousarray(read_image(TEXTURED / name)[200:264, 300:396]))
    Path("calib.txt").write_text(CALIBRATION)
    return tmp_path


def names_in(folder: str) -> set[str]:
    return {file.name for file in Path(folder).iterdir()}


def test_the_files_that_are_written_by_default(folder):
    make_depth(PICTURES, Path("plain"), PLAIN)
    assert names_in("plain") == set(ALWAYS)
    make_depth(PICTURES, Path("metric"), WITH_CAMERA)
    assert names_in("metric") == {*ALWAYS, "depth.png"}


def test_all_files_agree(folder):
    _, notes, _ = make_depth(PICTURES, Path("out"), replace(WITH_CAMERA, files=("all",)))
    assert names_in("out") == set(FILES)
    assert notes == []
    out, disparity_px = Path("out"), read_pfm("out/disparity.pfm")
    for found in (np.load(out / "disparity.npy"), np.asarray(Image.open(out / "disparity.tiff"))):
        assert found.dtype == np.float32
        np.testing.assert_array_equal(found, disparity_px)
    depth_m = CAMERA.depth_m(disparity_px)
    tiff_m = np.asarray(Image.open(out / "depth.tiff"))
    for found in (np.load(out / "depth.npy"), tiff_m, read_pfm(out / "depth.pfm")):
        assert found.dtype == np.float32
        np.testing.assert_array_equal(found, depth_m)
    within = depth_m < 65
    np.testing.assert_allclose(
        read_pixels(out / "depth.png", "I;16")[within] / 1000, depth_m[within], atol=6e-4
    )
    points_m = trimesh.load(out / "cloud.ply").vertices
    assert 0 < len(points_m) <= 64 * 96
    (from_glb,) = trimesh.load(out / "cloud.glb").geometry.values()
    np.testing.assert_array_equal(from_glb.vertices, points_m)
    assert set(-points_m[:, 2].astype(np.float32)) <= set(depth_m.ravel())
    mesh = trimesh.load(out / "mesh.ply", process=False)
    (glb_mesh,) = trimesh.load(out / "mesh.glb", process=False).geometry.values()
    np.testing.assert_array_equal(glb_mesh.faces, mesh.faces)


def test_the_left_picture_is_written_where_the_maps_fit_none_of_the_user_s(folder):
    for name in PICTURES:
        with Image.open(EXAMPLES / name) as picture:
            picture.reduce(2).save(name)
    make_depth(PICTURES, Path("sound"), PLAIN)
    assert "matched_left.png" not in names_in("sound")
    make_depth(PICTURES, Path("asked"), replace(PLAIN, files=("matched_left.png",)))
    np.testing.assert_array_equal(read_image("asked/matched_left.png"), read_image("left.png"))
    _, notes, _ = make_depth(PICTURES[::-1], Path("swapped"), PLAIN)
    assert any("swapped back" in str(note) for note in notes)
    np.testing.assert_array_equal(read_image("swapped/matched_left.png"), read_image("left.png"))
    assert "the left picture to which the maps belong" in Path("swapped/report.html").read_text()


def test_the_left_picture_is_written_if_it_was_turned_as_the_right_one(folder):
    upright = read_image("left.png")
    for name, orientation in zip(PICTURES, ({}, {Base.Orientation: 6}), strict=True):
        exif = Image.Exif()
        exif.update(orientation)
        with Image.open(name) as picture:
            picture.transpose(Image.Transpose.ROTATE_90).save(name, exif=exif)
    make_depth(PICTURES, Path("out"), PLAIN)
    np.testing.assert_array_equal(read_image("out/matched_left.png"), upright)


def test_the_left_half_of_a_file_with_both_views_is_written(folder):
    left, right = (read_image(TEXTURED / name)[:240, :320] for name in ("left.png", "right.png"))
    write_image("both.png", np.hstack([left, right]))
    job = replace(PLAIN, request=Request(format="side_by_side"))
    make_depth([Path("both.png")], Path("out"), job)
    np.testing.assert_array_equal(read_image("out/matched_left.png"), left)


def test_a_rectified_pair_s_maps_have_their_left_picture_beside_them(folder):
    left, right = (read_image(TEXTURED / name)[:, :320] for name in ("left.png", "right.png"))
    write_image("left.png", np.ascontiguousarray(left[:-12]))
    write_image("right.png", np.ascontiguousarray(right[12:]))
    _, notes, _ = make_depth(PICTURES, Path("out"), PLAIN)
    assert any(str(note).startswith("rectified: ") for note in notes)
    matched = read_image("out/matched_left.png")
    assert matched.shape == left[:-12].shape
    assert not np.array_equal(matched, left[:-12])


def test_the_occlusion_mask_is_white_where_only_the_left_camera_sees(folder, matcher):
    make_depth(PICTURES, Path("out"), PLAIN)
    estimate = matcher.estimate(read_image("left.png"), read_image("right.png"))
    mask = read_pixels("out/occluded.png", "L")
    np.testing.assert_array_equal(mask == 255, estimate.occluded)
    np.testing.assert_array_equal(mask == 0, ~estimate.occluded)


def test_files_of_an_earlier_result_are_removed(folder):
    make_depth(PICTURES, Path("out"), replace(WITH_CAMERA, files=("all",)))
    Path("out/mine.txt").write_text("kept")
    make_depth(PICTURES, Path("out"), PLAIN)
    assert names_in("out") == {*ALWAYS, "mine.txt"}


def test_files_with_the_same_names_that_are_not_an_earlier_result_stay(folder):
    for name in ("mesh.ply", "depth.npy"):
        Path(name).write_text("of another program")
    make_depth(PICTURES, Path(), PLAIN)
    assert {Path(name).read_text() for name in ("mesh.ply", "depth.npy")} == {"of another program"}


def test_a_file_that_only_some_results_have_is_not_replaced_and_not_listed(folder, capfd):
    left = read_image("left.png")
    write_image("right.png", np.roll(left, 8, axis=1))  # disparities of -8 px, for which there is no PNG
    plain = replace(PLAIN, request=Request(rectify=False))
    Path("out").mkdir()
    Path("out/disparity_scaled.png").write_text("of another program")
    with pytest.raises(StereoweaveError, match="^out/disparity_scaled.png: .* a file of another origin"):
        make_depth(PICTURES, Path("out"), plain)
    Path("out/disparity_scaled.png").rename("out/mesh.ply")
    for _ in range(2):
        main(["depth", *map(str, PICTURES), "--no-rectify", "--model", "small", "-o", "out", "--json"])
        files = json.loads(capfd.readouterr().out)["files"]
        assert "disparity_scaled.png" in files and "mesh.ply" not in files
    assert Path("out/mesh.ply").read_text() == "of another program"


def test_ground_truth_and_inputs_are_not_replaced(folder):
    Path("truth").mkdir()
    for name in ("disparity.pfm", "mesh.ply"):
        Path("truth", name).write_text("of another program")
    with pytest.raises(StereoweaveError, match="^truth/disparity.pfm: .* found a file of another origin"):
        make_depth(PICTURES, Path("truth"), PLAIN)
    assert names_in("truth") == {"disparity.pfm", "mesh.ply"}
    make_depth(PICTURES, Path("out"), replace(PLAIN, files=("matched_left.png",)))
    again = [Path("out/matched_left.png"), PICTURES[1]]
    with pytest.raises(StereoweaveError, match="^out/matched_left.png: .* found one of the inputs"):
        make_depth(again, Path("out"), PLAIN)
    assert Path("out/matched_left.png").exists()


def test_results_do_not_move_into_a_folder_that_another_command_writes_to(folder):
    make_depth(PICTURES, Path("out"), PLAIN)
    before = {file: file.read_bytes() for file in Path("out").iterdir()}
    with lock_output(Path("out")), pytest.raises(OutputInUseError, match="^out: .* found one that is in use"):
        make_depth(PICTURES, Path("out"), WITH_CAMERA)
    assert {file: file.read_bytes() for file in Path("out").iterdir()} == before


def test_an_unknown_file_is_refused_with_a_list_of_the_known_ones():
    with pytest.raises(
        StereoweaveError,
        match=r"^files: .*disparity.npy.*mesh.glb.*found 'cloud.obj'; did you mean cloud.glb\?$",
    ):
        DepthJob(files=("depth.npy", "cloud.obj"))


@pytest.mark.parametrize("file", [file for file in FILES if needs_camera(file)])
def test_metres_without_a_camera_are_refused_before_anything_is_written(folder, file):
    with pytest.raises(StereoweaveError, match=rf"^{file}: .*\(calibration, focal_px, baseline_m\)"):
        make_depth(PICTURES, Path("out"), DepthJob(files=(file,)))
    assert not Path("out").exists()


def test_all_without_a_camera_leaves_out_files_in_metres_with_a_note(folder):
    _, notes, _ = make_depth(PICTURES, Path("out"), DepthJob(files=("all",)))
    assert names_in("out") == {
        *ALWAYS,
        "disparity_scaled.png",
        "disparity.npy",
        "disparity.tiff",
        "matched_left.png",
    }
    assert [note for note in notes if "(calibration, focal_px, baseline_m)" in str(note)] != []


def test_a_point_cloud_without_trimesh_names_the_extra_before_anything_is_written(folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(StereoweaveError, match=r"stereoweave\[mesh\]"):
        make_depth(PICTURES, Path("out"), replace(WITH_CAMERA, files=("cloud.ply",)))
    assert not Path("out").exists()


def test_a_pair_without_points_gets_the_other_files_and_a_note(folder):
    for name in PICTURES:
        Image.new("RGB", (96, 64)).save(name)
    job = replace(WITH_CAMERA, files=("cloud.ply", "mesh.glb"))
    _, notes, _ = make_depth(PICTURES, Path("out"), job)
    assert names_in("out") == {*ALWAYS, "depth.png"}
    assert [note.text[:13] for note in notes if note.text.startswith("no ")] == [
        "no cloud.ply:",
        "no mesh.glb: ",
    ]


def result_half_seen() -> Result:
    """Return a result of 4 px, and 0 px in the right third; the left image's left half has no content."""
    disparity_px = np.full((64, 96), 4, np.float32)
    disparity_px[:, 64:] = 0
    left_seen = np.ones((64, 96), bool)
    left_seen[:, :48] = False
    picture = np.full((64, 96, 3), 100, np.uint8)
    pair = StereoPair(left=picture, right=picture, camera=CAMERA, left_seen=left_seen)
    estimate = Estimate(
        disparity_px=disparity_px,
        right_disparity_px=disparity_px,
        confidence=left_seen.astype(np.float32),
        occluded=np.zeros((64, 96), bool),
    )
    summary = summarize(pair, estimate, pictures=("left.png", "right.png"), model="small", estimate_ms=1.0)
    return Result(pair=pair, estimate=estimate, summary=summary)


def test_pixels_outside_the_left_image_s_content_are_unknown_in_every_file(tmp_path):
    result = result_half_seen()
    for file, write in FILES.items():
        write(tmp_path / file, result)
    rows = {
        "disparity.pfm": (read_pfm, np.inf, 4, 0),
        "disparity.png": (read_disparity_png, np.nan, 4, 1 / 256),
        "disparity_scaled.png": (read_disparity_png, np.nan, 4, 1 / 256),
        "disparity.npy": (np.load, np.nan, 4, 0),
        "disparity.tiff": (lambda path: np.asarray(Image.open(path)), np.nan, 4, 0),
        # 100 px * 0.08 m / 4 px
        "depth.pfm": (read_pfm, np.inf, 2, np.inf),
        "depth.npy": (np.load, np.nan, 2, np.inf),
        "depth.tiff": (lambda path: np.asarray(Image.open(path)), np.nan, 2, np.inf),
        "depth.png": (lambda path: read_pixels(path, "I;16"), 0, 2000, 0),
        "confidence.png": (lambda path: read_pixels(path, "L"), 0, 255, 255),
    }
    for file, (read, *expected) in rows.items():
        found = read(tmp_path / file)
        for columns, value in zip((np.s_[:48], np.s_[48:64], np.s_[64:]), expected, strict=True):
            np.testing.assert_array_equal(found[:, columns], value, err_msg=file)
    assert len(trimesh.load(tmp_path / "cloud.ply").vertices) == 64 * 16
    preview = read_image(tmp_path / "preview.png")
    assert (preview[:, :48] == 0).all() and (preview[:, 48:].max(axis=2) > 0).all()


def test_the_summary_counts_only_the_left_image_s_content():
    summary = result_half_seen().summary
    # 4 px in 16 of the 48 columns, 0 px in 32; no pixel outside them is confident.
    assert (summary.disparity_median_px, summary.disparity_max_px) == (0, 4)
    assert (summary.disparity_p1_px, summary.disparity_p99_px) == (0, 4)
    assert (summary.depth_p1_m, summary.depth_p99_m) == (2, None)
    assert (summary.confident_percent, summary.depth_min_m) == (100, 2)


def test_matching_options_reach_the_matcher(folder, matcher):
    found_px = {}
    for name, job in {
        "plain": PLAIN,
        "moved": replace(PLAIN, options=MatchOptions(range_px=(-40.0, 100.0))),
        "refined": replace(PLAIN, options=MatchOptions(refined=True)),
        "raw": replace(PLAIN, options=MatchOptions(raw=True)),
    }.items():
        make_depth(PICTURES, Path(name), job)
        found_px[name] = read_pfm(f"{name}/disparity.pfm")
    assert (found_px["moved"] != found_px["plain"]).any()
    for how in ("refined", "raw"):
        expected = matcher.estimate(read_image("left.png"), read_image("right.png"), **{how: True})
        np.testing.assert_array_equal(found_px[how], expected.disparity_px)


def test_a_job_cannot_be_both_refined_and_raw():
    with pytest.raises(StereoweaveError, match="raw: cannot be combined with refined"):
        MatchOptions(refined=True, raw=True)


def test_the_command_gives_the_networks_own_disparity_on_request(folder, matcher):
    depth(PICTURES, Path("out"), raw=True, model="small")
    expected = matcher.estimate(read_image("left.png"), read_image("right.png"), raw=True)
    np.testing.assert_array_equal(read_pfm("out/disparity.pfm"), expected.disparity_px)


def test_the_command_writes_the_requested_files(folder, capfd):
    depth(PICTURES, Path("out"), calib=Path("calib.txt"), write=["cloud.ply", "depth.npy"])
    assert names_in("out") == {*ALWAYS, "depth.png", "cloud.ply", "depth.npy"}
    assert "report: out/report.html" in capfd.readouterr().out


def test_the_report_has_the_warnings_the_command_and_the_files_of_its_folder(folder, capfd):
    """The right picture is 6 px lower: a warning, which names the command's option."""
    write_image("low.png", np.roll(read_image(TEXTURED / "right.png"), 6, axis=0))
    words = ["depth", str(TEXTURED / "left.png"), "low.png", "-o", "my out", "--write", "depth.npy", *METRES]
    assert main([*words, "--model", "small"]) == 0
    report = Path("my out/report.html").read_text(encoding="utf-8")
    (warning,) = [line for line in capfd.readouterr().out.splitlines() if "--rectify" in line]
    assert f'class="banner"><h2>Warnings</h2><ul><li>{html.escape(warning)}</li></ul>' in report
    command = shlex.join(["stereoweave", "depth", str(TEXTURED / "left.png"), "low.png", "-o", "my out"])
    assert html.escape(f"{command} --write depth.npy --focal-px 100") in report
    linked = set(re.findall(r'href="([^"]*)" download', report))
    assert linked == names_in("my out") - {"report.html"}
    assert "depth.npy" in linked


def test_the_reports_of_equal_pairs_differ_only_in_date_and_time(folder):
    pages = []
    for out in ("one", "two"):
        make_depth(PICTURES, Path(out), WITH_CAMERA)
        page = Path(out, "report.html").read_text(encoding="utf-8")
        page = re.sub(r"<dt>Date</dt><dd>\d{4}-\d\d-\d\d \d\d:\d\d UTC</dd>", "", page)
        pages.append(re.sub(r"\d+ ms|\d+\.\d s\b", "", page))
    assert pages[0] == pages[1]
    assert "Date" not in pages[0]


def test_a_camera_from_numbers_has_a_centred_principal_point():
    image = np.zeros((480, 640, 3), np.uint8)
    expected = StereoCamera(focal_px=550.0, baseline_m=0.1, cx_px=319.5, cy_px=239.5)
    assert StereoCamera.centred(image, focal_px=550.0, baseline_m=0.1) == expected


def test_a_batch_s_job_facts_keep_their_names_so_that_earlier_batches_can_resume():
    options = MatchOptions(range_px=(-20.0, 96.0), refined=True)
    facts = job_facts(DepthJob(options=options, backend=Backend(threads=2), files=("all",)))
    assert {name: value for name, value in facts.items() if name != "stereoweave"} == {
        "model": "small",
        "range_px": (-20.0, 96.0),
        "refined": True,
        "raw": False,
        "files": ("all",),
        "always": ALWAYS,
        "arrangement": None,
        "calibration": None,
        "focal_px": None,
        "baseline_m": None,
        "rectify": None,
    }
