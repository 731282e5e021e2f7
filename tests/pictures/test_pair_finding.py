from pathlib import Path

import pytest

from stereoweave.errors import StereoweaveError
from stereoweave.outputs import results, sphere_depth
from stereoweave.pictures.pair_finding import (
    FoundPairs,
    ListedPair,
    NamedPair,
    find_pairs,
    find_pairs_among,
    find_pairs_by_globs,
    find_pairs_in,
    read_pair_list,
)
from stereoweave.rendering.layouts import ANIMATIONS, LAYOUTS


def put(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    return folder


def listed(folder: Path, pairs: list[NamedPair]) -> dict[str, tuple[str, ...]]:
    return {pair.name: tuple(path.relative_to(folder).as_posix() for path in pair.pictures) for pair in pairs}


@pytest.mark.parametrize(
    ("name", "left", "right"),
    [
        ("0001", "left/0001.png", "right/0001.png"),
        ("sea", "sea_L.jpg", "sea_R.jpg"),
        ("sea", "sea_left.JPG", "sea_right.JPG"),
        ("0001", "left_0001.png", "right_0001.png"),
        ("01", "left01.jpg", "right01.jpg"),
        ("DSC_0001", "DSC_0001L.jpg", "DSC_0001R.jpg"),
        ("castle", "castle/left.png", "castle/right.png"),
        ("castle", "castle/im0.png", "castle/im1.png"),
        ("mav0_data_14", "mav0/cam0/data/14.png", "mav0/cam1/data/14.png"),
        ("rig_07", "rig_cam0_07.png", "rig_cam1_07.png"),
        ("a_01", "a_L_01.png", "a_R_01.png"),
        ("a_L", "a_L_left.png", "a_L_right.png"),
        ("07", "CAM0/07.png", "CAM1/07.png"),
        ("cam0", "cam0_left.png", "cam0_right.png"),
        ("cam0_1", "L_cam0_1.png", "R_cam0_1.png"),
        ("cam0", "left/cam0.png", "right/cam0.png"),
        ("cam0_a", "cam0/left/a.png", "cam0/right/a.png"),
        ("castle_0001", "castle/Left/0001.png", "castle/Right/0001.png"),
        ("Img8bit_a_1_Img8bit", "leftImg8bit/a_1_leftImg8bit.png", "rightImg8bit/a_1_rightImg8bit.png"),
        ("img_7", "imgLeft/img_7.tif", "imgRight/img_7.tif"),
        ("left_to_right", "left_to_right/left.png", "left_to_right/right.png"),
        ("right_wing", "right_wing_L.jpg", "right_wing_R.jpg"),
        ("left_turn_01", "left_turn_01_L.png", "left_turn_01_R.png"),
        ("right_wing_01", "right_wing_L_01.png", "right_wing_R_01.png"),
        ("left_turn_1", "left_turn/cam0/1.png", "left_turn/cam1/1.png"),
        ("left_cam", "left_cam_l.png", "left_cam_r.png"),
        ("turn", "left_turn_L.png", "right_turn_R.png"),
    ],
)
def test_a_folders_pairs_are_found_by_the_marks_of_their_sides(tmp_path, name, left, right):
    folder = put(tmp_path, left, right)
    if name.startswith("img"):
        name = "img_img_7"
    assert listed(folder, find_pairs_in(folder).pairs) == {name: (left, right)}


def test_a_pair_right_in_the_folder_has_the_folders_name(tmp_path):
    folder = put(tmp_path / "castle", "left.png", "right.png")
    assert listed(folder, find_pairs_in(folder).pairs) == {"castle": ("left.png", "right.png")}


@pytest.mark.parametrize(
    "pairs",
    [
        {"cam0": ("cam0_L.png", "cam0_R.png"), "cam1": ("cam1_L.png", "cam1_R.png")},
        {f"cam{rig}_a": (f"cam{rig}/left/a.png", f"cam{rig}/right/a.png") for rig in range(2)},
    ],
)
def test_cameras_that_have_two_eyes_each_are_two_rigs(tmp_path, pairs):
    folder = put(tmp_path, *(path for pair in pairs.values() for path in pair))
    assert listed(folder, find_pairs_in(folder).pairs) == pairs


def test_pairs_whose_other_marks_are_alike_keep_these_in_their_names(tmp_path):
    pairs = {f"{side}_wing": (f"{side}_wing_L.jpg", f"{side}_wing_R.jpg") for side in ("left", "right")}
    pairs |= {"left_a": ("left/a_L.png", "left/a_R.png"), "right_a": ("right/a_L.png", "right/a_R.png")}
    folder = put(tmp_path, "b_L.jpg", "b_R.jpg", *(path for pair in pairs.values() for path in pair))
    assert listed(folder, find_pairs_in(folder).pairs) == pairs | {"b": ("b_L.jpg", "b_R.jpg")}


@pytest.mark.parametrize(
    ("files", "missing"),
    [
        (("left_wing_L.jpg", "right_wing_L.jpg", "right_wing_R.jpg"), "left_wing_R.jpg"),
        (("left/a_L.png", "right/a_L.png", "right/a_R.png"), "left/a_R.png"),
        (("a_left_L.png", "a_left_R.png", "a_right_R.png"), "a_right_L.png"),
    ],
)
def test_a_picture_of_a_pair_is_not_the_missing_one_of_another_pair(tmp_path, files, missing):
    folder = put(tmp_path, *files)
    pictures = [path for pair in listed(folder, find_pairs_in(folder).pairs).values() for path in pair]
    assert sorted(pictures) == sorted([*files, missing])


def test_globs_whose_names_without_marks_are_alike_are_refused(tmp_path):
    folder = put(tmp_path, *(f"{side}_wing_{eye}.jpg" for side in ("left", "right") for eye in "LR"))
    with pytest.raises(StereoweaveError, match="found wing for both .*left_wing_L.jpg and .*right_wing_L"):
        find_pairs_by_globs(f"{folder}/*_L.jpg", f"{folder}/*_R.jpg")


def test_numbers_of_cameras_mean_nothing_beside_pairs_of_left_and_right(tmp_path):
    folder = put(tmp_path, "cam0/1.png", "cam1/1.png", "left_1.png", "right_1.png")
    found = find_pairs_in(folder)
    assert listed(folder, found.pairs) == {"1": ("left_1.png", "right_1.png")}
    assert "2 pictures skipped" in found.notes[0]


def test_words_that_only_begin_like_a_mark_are_none(tmp_path):
    folder = put(
        tmp_path, "leftover.png", "lake.png", "Room.png", "im0001.png", "ball.png", "cam01.png", "webcam0.png"
    )
    expected = {Path(name).stem: (name,) for name in ("leftover.png", "lake.png", "Room.png", "im0001.png")}
    expected |= {"cam01": ("cam01.png",), "webcam0": ("webcam0.png",)}
    assert listed(folder, find_pairs_in(folder).pairs) == expected | {"ball": ("ball.png",)}


def test_half_a_pair_is_a_pair_whose_other_picture_is_missing(tmp_path):
    folder = put(tmp_path, "left/1.png", "right/1.png", "left/2.png", "right/3.png")
    assert listed(folder, find_pairs_in(folder).pairs) == {
        name: (f"left/{name}.png", f"right/{name}.png") for name in ("1", "2", "3")
    }


def test_the_pictures_of_a_pair_may_have_different_file_extensions():
    files = ["a_L.JPG", "a_R.jpg", "b_L.png", "b_R.jpg", "c_L.jpg", "c_R.jpg"]
    assert find_pairs_among("x", files).pairs == [
        ListedPair("a", ("a_L.JPG", "a_R.jpg")),
        ListedPair("b", ("b_L.png", "b_R.jpg")),
        ListedPair("c", ("c_L.jpg", "c_R.jpg")),
    ]


def test_marks_mean_nothing_where_not_one_pair_is_whole(tmp_path):
    folder = put(tmp_path, "turn_left.jpg", "sea.jpg")
    assert listed(folder, find_pairs_in(folder).pairs) == {
        "sea": ("sea.jpg",),
        "turn_left": ("turn_left.jpg",),
    }


def test_files_of_both_views_are_pairs_and_the_camera_s_copy_beside_them_is_left_out(tmp_path):
    folder = put(tmp_path, "DSCF1.MPO", "DSCF1.JPG", "tree.jps", "notes.txt")
    found = find_pairs_in(folder)
    assert listed(folder, found.pairs) == {"DSCF1": ("DSCF1.MPO",), "tree": ("tree.jps",)}
    assert found.notes == (f"{folder}: 1 picture skipped, no left or right in the name: DSCF1.JPG",)


def test_a_scene_folder_brings_its_calibration_and_not_its_ground_truth(tmp_path):
    names = ["left.png", "right.png", "disparity.png"]
    folder = put(tmp_path, *(f"{scene}/{name}" for scene in ("a", "b") for name in names), "b/calib.txt")
    found = find_pairs_in(folder)
    assert [(pair.name, pair.calibration) for pair in found.pairs] == [
        ("a", None),
        ("b", folder / "b" / "calib.txt"),
    ]
    assert "2 pictures skipped" in found.notes[0]


def test_hidden_files_and_results_of_a_batch_are_no_pictures(tmp_path):
    folder = put(tmp_path, "a_l.png", "a_r.png", "._a_l.png", ".trash/b_l.png")
    put(folder, "out/batch.json", "out/a/preview.png", "out/a/left.png", "out/a/right.png")
    assert listed(folder, find_pairs_in(folder).pairs) == {"a": ("a_l.png", "a_r.png")}


@pytest.mark.parametrize(
    ("marker", "files"),
    [("disparity.pfm", results.FILES), ("distance.pfm", (*sphere_depth.FILES, sphere_depth.LEFT))],
)
def test_the_files_of_a_result_are_no_pictures_but_a_pair_beside_them_is_one(marker, files):
    assert marker in files
    pair = ["left.png", "right.png"]
    for folder in ("", "left_depth/", "scenes/a/"):
        made = [folder + file for file in files]
        found = find_pairs_among("x", [*pair, *made, f"{folder}left.png", f"{folder}right.png"])
        assert {each.files for each in found.pairs} == {
            ("left.png", "right.png"),
            (f"{folder}left.png", f"{folder}right.png"),
        }
        assert found.left_out == []


def test_files_named_like_results_are_pictures_where_no_result_is():
    found = find_pairs_among("x", ["left.png", "right.png", "preview.png", "a/disparity.pfm"])
    assert found.left_out == ["preview.png"]


@pytest.mark.parametrize("layout", ["view", *LAYOUTS, *ANIMATIONS])
@pytest.mark.parametrize("left", ["left", "1_L"])
def test_views_of_a_pair_beside_it_are_no_pictures(layout, left):
    mark = LAYOUTS[layout].mark if layout in LAYOUTS else ""
    pair = (f"{left}.png", {"left": "right.png", "1_L": "1_R.png"}[left])
    found = find_pairs_among("x", [*pair, f"{left}_{layout}{mark}.webp"])
    assert [each.files for each in found.pairs] == [pair]
    assert found.left_out == []


@pytest.mark.parametrize(
    "pictures",
    [
        ("a/1_L.png", "a/1_R.png"),
        ("cam0/a.png", "cam1/a.png"),
        ("L001.png", "R001.png"),
        ("p.mpo",),
        ("p.png",),
    ],
)
def test_rectified_pictures_beside_their_originals_are_no_other_pair(pictures):
    folder = pictures[0].rpartition(".")[0] + "_rectified"
    made = [f"{folder}/{name}" for name in ("left.png", "right.png", "rectified.json", "calib.yml")]
    found = find_pairs_among("x", [*pictures, *made])
    assert [each.files for each in found.pairs] == [pictures]
    assert found.left_out == []


def test_rectified_pictures_are_a_pair_where_their_originals_are_not():
    made = [f"1_L_rectified/{name}" for name in ("left.png", "right.png", "rectified.json")]
    for others in ([], ["2_L.png", "2_R.png"]):
        pairs = [each.files for each in find_pairs_among("x", [*made, *others]).pairs]
        assert (made[0], made[1]) in pairs


def test_pictures_named_like_views_are_the_user_s_where_the_rest_of_a_pair_is_found():
    files = [f"{side}{more}.png" for side in ("left", "right") for more in ("", "_view")]
    pairs = [each.files for each in find_pairs_among("x", [*files, "left_2.png", "tree_view.png"]).pairs]
    assert pairs == [
        ("left.png", "right.png"),
        ("left_2.png", "right_2.png"),
        ("left_view.png", "right_view.png"),
    ]


def test_two_pairs_of_one_name_are_refused_before_the_start_even_if_capitals_alone_differ(tmp_path):
    folder = put(tmp_path, "a_L.png", "a_R.png", "A_L.jpg", "A_R.jpg")
    with pytest.raises(
        StereoweaveError, match="pairs with different names, found a for both .*A_L.jpg and .*a_L.png"
    ):
        find_pairs_in(folder)


def test_a_folder_without_pictures_is_told_in_one_line(tmp_path):
    with pytest.raises(StereoweaveError, match=r"expected a folder with pictures \(.*\), found none"):
        find_pairs_in(put(tmp_path, "film.mp4"))
    with pytest.raises(StereoweaveError, match="expected a folder of pictures, found no such folder"):
        find_pairs_in(tmp_path / "none")


def test_pairs_among_the_files_of_a_store_are_those_of_a_folder_with_the_same_files(tmp_path):
    names = ["a/left.png", "a/right.png", "a/calib.txt", "b_l.png", "b_r.png", "c/1.jps", "d.png", "left.png"]
    names += ["out/batch.json", "out/e/left.png", "out/e/right.png", "right.png", "calib.txt", "c/calib.txt"]
    folder = put(tmp_path / "castle", *names)
    among = find_pairs_among("s3://bucket/castle", iter(names))
    assert among.pairs == [
        ListedPair("c_1", ("c/1.jps",)),
        ListedPair("a", ("a/left.png", "a/right.png"), "a/calib.txt"),
        ListedPair("b", ("b_l.png", "b_r.png")),
        ListedPair("castle", ("left.png", "right.png"), "calib.txt"),
    ]
    assert among.left_out == ["d.png"]
    pairs = find_pairs_in(folder).pairs
    assert listed(folder, pairs) == {pair.name: pair.files for pair in among.pairs}
    assert [pair.calibration for pair in pairs] == [
        folder / pair.calibration if pair.calibration else None for pair in among.pairs
    ]


def test_films_have_their_endings_in_their_names_and_are_no_pictures():
    files = ["a_l.png", "a_r.png", "a.mp4", "trip/a.MKV", "a.webm", "old/batch.json", "old/made.mov", "a.txt"]
    among = find_pairs_among("pairs", files)
    assert [pair.name for pair in among.pairs] == ["a"]
    assert among.films == [
        ListedPair("a.mp4", ("a.mp4",)),
        ListedPair("a.webm", ("a.webm",)),
        ListedPair("trip_a.MKV", ("trip/a.MKV",)),
    ]
    assert among.left_out == []


def test_two_films_of_one_name_are_refused():
    with pytest.raises(StereoweaveError, match="found a_b.mp4 for both a/b.mp4 and a_b.mp4"):
        find_pairs_among("pairs", ["a/b.mp4", "a_b.mp4"])


def test_a_file_named_like_a_kind_of_file_is_nothing():
    assert find_pairs_among("pairs", ["picture", "film", "both views"]) == ([], [], [])


def test_nothing_is_found_in_the_folder_that_a_batch_was_written_to():
    assert find_pairs_among("out", ["batch.json", "a/left.png", "a/right.png"]) == ([], [], [])


def test_a_side_may_be_told_by_folder_and_name_or_by_the_name_alone():
    files = ["left/a_l.png", "right/a_r.png", "left_run/b_l.png", "left_run/b_r.png"]
    assert [pair.files for pair in find_pairs_among("x", files).pairs] == [
        ("left/a_l.png", "right/a_r.png"),
        ("left_run/b_l.png", "left_run/b_r.png"),
    ]


def test_globs_are_paired_in_the_order_of_their_names(tmp_path):
    folder = put(tmp_path, "l/2.png", "l/1.png", "r/c.png", "r/b.png", "l/3.txt")
    pairs = find_pairs_by_globs(f"{folder}/l/*.png", f"{folder}/r/*.png")
    assert listed(folder, pairs) == {"1": ("l/1.png", "r/b.png"), "2": ("l/2.png", "r/c.png")}


def test_globs_are_paired_by_their_names_without_marks_if_any_of_these_agree(tmp_path):
    # In the order of names, scene_L comes after scene_Night_L, but scene_right before scene_Night_right.
    names = [f"{scene}_{side}.png" for scene in ("scene", "scene_Night") for side in ("L", "right")]
    folder = put(tmp_path, *names)
    pairs = find_pairs_by_globs(f"{folder}/*_L.png", f"{folder}/*_right.png")
    assert listed(folder, pairs) == {
        "scene": ("scene_L.png", "scene_right.png"),
        "scene_Night": ("scene_Night_L.png", "scene_Night_right.png"),
    }


def test_a_second_file_of_one_side_is_refused_by_name(tmp_path):
    folder = put(tmp_path, "a_L.png", "a_R.png", "a_R.jpg")
    with pytest.raises(StereoweaveError, match="different names, found a for both a_R.jpg and a_R.png"):
        find_pairs_in(folder)


def test_a_picture_of_a_glob_without_partner_is_refused_with_what_to_give(tmp_path):
    folder = put(tmp_path, *(f"{number}_L.png" for number in "123"), *(f"{number}_R.png" for number in "234"))
    with pytest.raises(
        StereoweaveError,
        match=r"1_L.png: expected a right picture of this name among those that match .*/\*_R.png, "
        r"as 2 of 3 left pictures have, found none; add it, or list the pairs in a file \(listed\)$",
    ):
        find_pairs_by_globs(f"{folder}/*_L.png", f"{folder}/*_R.png")


def test_names_from_globs_tell_folders_apart(tmp_path):
    folder = put(tmp_path, "a/left.png", "a/right.png", "b/c/left.png", "b/c/right.png")
    pairs = find_pairs_by_globs(f"{folder}/**/left.png", f"{folder}/**/right.png")
    assert listed(folder, pairs) == {
        "a": ("a/left.png", "a/right.png"),
        "b_c": ("b/c/left.png", "b/c/right.png"),
    }


def test_a_file_whose_name_has_brackets_is_no_pattern(tmp_path):
    folder = put(tmp_path, "sea [1].png", "sea [2].png")
    pairs = find_pairs_by_globs(f"{folder}/sea [1].png", f"{folder}/sea [2].png")
    assert listed(folder, pairs) == {"sea [1]": ("sea [1].png", "sea [2].png")}


def test_unequal_counts_are_refused_with_both(tmp_path):
    folder = put(tmp_path, "l/1.png", "l/2.png", "r/1.png")
    with pytest.raises(StereoweaveError, match=r"found 2 for .*/l/\* and 1 for .*/r/\*"):
        find_pairs_by_globs(f"{folder}/l/*", f"{folder}/r/*")
    with pytest.raises(StereoweaveError, match=r"^right: expected pictures that match .*/x/\*, found none"):
        find_pairs_by_globs(f"{folder}/l/*", f"{folder}/x/*")


@pytest.mark.parametrize(
    ("line", "name", "pictures"),
    [
        ("l/1.png r/1.png", "1", ("l/1.png", "r/1.png")),
        ("l/1.png   r/1.png", "1", ("l/1.png", "r/1.png")),
        ("l/1.png\tr/1.png\tquay wall", "quay wall", ("l/1.png", "r/1.png")),
        ("l/1.png, r/1.png, quay", "quay", ("l/1.png", "r/1.png")),
        ('"my l.png" "my r.png"', "my", ("my l.png", "my r.png")),
        ('"a, b.png","c, d.png"', "a, b", ("a, b.png", "c, d.png")),
        ('"a, b.png" "c, d.png"', "a, b", ("a, b.png", "c, d.png")),
        ('"a; b.png", "c\td.png"', "a; b", ("a; b.png", "c\td.png")),
        ("l/1.png; r/1.png;quay", "quay", ("l/1.png", "r/1.png")),
        ("l'arbre.png r'arbre.png", "l'arbre", ("l'arbre.png", "r'arbre.png")),
        ("both.jps", "both", ("both.jps",)),
        ("both.jps,,tree", "tree", ("both.jps",)),
        ("a.png b.png ../x:y?", "_x_y_", ("a.png", "b.png")),
        ("a.png b.png CON", "CON_", ("a.png", "b.png")),
        ("a.png b.png nul.png", "nul.png_", ("a.png", "b.png")),
        ("a.png b.png summary.csv", "summary.csv_", ("a.png", "b.png")),
        ("a.png b.png Plan", "Plan_", ("a.png", "b.png")),
    ],
)
def test_a_line_of_a_list_is_a_pair(tmp_path, line, name, pictures):
    (tmp_path / "list.txt").write_text(f"# left right\n\n{line}\n", encoding="utf-8-sig")
    assert listed(tmp_path, read_pair_list(tmp_path / "list.txt")) == {name: pictures}


def test_a_pair_named_like_a_folder_of_a_batch_is_renamed_and_may_not_take_another_s_name(tmp_path):
    folder = put(
        tmp_path, *(f"{name}/{side}.png" for name in ("begun", "manifest") for side in ("left", "right"))
    )
    assert [pair.name for pair in find_pairs_in(folder).pairs] == ["begun_", "manifest_"]
    put(tmp_path, "manifest_/left.png", "manifest_/right.png")
    with pytest.raises(
        StereoweaveError, match="different names, found manifest_ for both manifest.*and manifest_"
    ):
        find_pairs_in(folder)


def test_paths_of_a_list_are_relative_to_its_folder_and_those_elsewhere_keep_their_names_apart(tmp_path):
    (tmp_path / "lists").mkdir()
    path = tmp_path / "lists" / "list.txt"
    path.write_text(f"../a/l.png ../a/r.png\n{tmp_path}/b/l.png {tmp_path}/b/r.png\n")
    first, second = read_pair_list(path)
    assert first.pictures == (path.parent / "../a/l.png", path.parent / "../a/r.png")
    stem = "_".join(tmp_path.parts[1:])
    assert [first.name, second.name] == [f"{stem}_a", f"{stem}_b"]


def test_what_cannot_be_a_picture_is_noticed_only_when_it_is_read(tmp_path):
    long = "a" * 300  # no file system has such names
    (tmp_path / "list.txt").write_text(f"/ right.png\n{long}/left.png {long}/right.png\n")
    assert [pair.pictures for pair in read_pair_list(tmp_path / "list.txt")] == [
        (Path("/"), tmp_path / "right.png"),
        (tmp_path / long / "left.png", tmp_path / long / "right.png"),
    ]


def test_a_bad_line_is_told_by_its_number(tmp_path):
    path = tmp_path / "list.txt"
    path.write_text("a.png b.png\na b c d\n")
    with pytest.raises(StereoweaveError, match=r"list.txt, line 2: .*found 4 columns: a b c d"):
        read_pair_list(path)
    path.write_text(f"a.png {'b' * 140_000}\n")
    with pytest.raises(StereoweaveError, match=r"list.txt, line 1: expected .*field larger than"):
        read_pair_list(path)
    path.write_text("# nothing\n")
    with pytest.raises(StereoweaveError, match="expected a list with one pair per line, found no pairs"):
        read_pair_list(path)
    with pytest.raises(StereoweaveError, match="expected a list of pairs, found no such file"):
        read_pair_list(tmp_path / "none.txt")


def test_one_pattern_alone_and_two_folders_are_refused_with_what_to_give(tmp_path):
    with pytest.raises(
        StereoweaveError, match=r"found none of the right ones; give both, .*\(left, right\)$"
    ):
        find_pairs([], "*_l.png", None, None)
    with pytest.raises(StereoweaveError, match=r"found none of the left ones; give both"):
        find_pairs([], None, "*_r.png", None)
    with pytest.raises(
        StereoweaveError, match=r"found two folders: .* such as 'left/\*.png' \(left, right\)$"
    ):
        find_pairs([tmp_path, tmp_path], None, None, None)


def test_a_folder_whose_names_have_no_side_gets_a_note(tmp_path):
    (note,) = find_pairs_in(put(tmp_path, "1.png", "2.png")).notes
    assert note.endswith("as 1_L.jpg and 1_R.jpg do, so each picture is taken to hold both views")


def test_the_words_of_the_command_line_name_one_source(tmp_path):
    folder = put(tmp_path, "a_l.png", "a_r.png")
    left, right = (str(folder / f"a_{side}.png") for side in "lr")
    (folder / "list.txt").write_text("a_l.png a_r.png a\n")
    pair = NamedPair("a", (Path(left), Path(right)))
    assert find_pairs([folder], None, None, None) == FoundPairs([pair])
    assert find_pairs([], left, right, None) == FoundPairs([pair])
    assert find_pairs([], None, None, folder / "list.txt") == FoundPairs([pair])
    assert find_pairs([Path(left), Path(right)], None, None, None) is None
    for words, found in {
        ((), None, None, None): "none",
        ((folder,), left, right, None): "pictures and patterns",
    }.items():
        with pytest.raises(
            StereoweaveError, match=f"or a list of pairs, found {found}; .*(left, right, listed)"
        ):
            find_pairs(*words)
