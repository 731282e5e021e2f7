import shutil

import pytest
from benchmark_examples import KITTI, write_eth3d, write_kitti, write_middlebury, write_scene
from dataset_examples import cut, error_of, write_picture

from stereoweave.data.benchmarks import (
    BENCHMARKS,
    TEST,
    TRAINING,
    Choice,
    describe_missing_pairs,
    find_benchmark,
    list_benchmark,
)

WRITERS = {
    "kitti2012": lambda root: write_kitti(root, "kitti2012"),
    "kitti2015": lambda root: write_kitti(root, "kitti2015"),
    "middlebury_v3": write_middlebury,
    "eth3d": write_eth3d,
}
NAMES = {
    "kitti2012": ["000000_10", "000001_10"],
    "kitti2015": ["000000_10", "000001_10"],
    "middlebury_v3": ["trainingQ/Adirondack", "testQ/Plants"],
    "eth3d": ["forest_1s", "lakeside_1l"],
}


@pytest.fixture(params=WRITERS)
def dataset(request, tmp_path):
    WRITERS[request.param](tmp_path)
    return request.param


def test_a_benchmark_is_recognised_by_its_folders_and_listed_by_name(dataset, tmp_path):
    assert set(WRITERS) == set(BENCHMARKS)
    assert find_benchmark(tmp_path) == dataset
    assert [pair.name for pair in list_benchmark(tmp_path, dataset)] == NAMES[dataset]


@pytest.mark.parametrize("dataset", KITTI)
def test_kitti_has_test_pairs_of_the_first_moment_without_a_range(tmp_path, dataset):
    left, right = KITTI[dataset]
    write_kitti(tmp_path, dataset)
    (_, pair) = list_benchmark(tmp_path, dataset)
    assert pair.left == tmp_path / "testing" / left / "000001_10.png"
    assert pair.right == tmp_path / "testing" / right / "000001_10.png"
    assert (pair.part, pair.size_px, pair.range_px) == (TEST, (40, 32), None)


def test_the_range_of_a_scene_is_one_less_than_its_published_number_of_disparities(tmp_path):
    write_eth3d(tmp_path)
    training, test = list_benchmark(tmp_path, "eth3d")
    assert training.range_px == test.range_px == (0, 19)
    assert (training.part, training.size_px) == (TRAINING, (40, 32))
    assert (test.part, test.size_px) == (TEST, (44, 36))
    assert test.right == tmp_path / "two_view_test" / "lakeside_1l" / "im1.png"


@pytest.mark.parametrize(
    ("dataset", "expected"), [("middlebury_v3", "trainingQ/Adirondack"), ("eth3d", "forest_1s")]
)
def test_training_pairs_alone_need_no_test_pairs(tmp_path, dataset, expected):
    WRITERS[dataset](tmp_path)
    for folder in (*tmp_path.glob("*test*"), *tmp_path.glob("MiddEval3/test*")):
        shutil.rmtree(folder)
    (pair,) = list_benchmark(tmp_path, dataset, Choice(training_only=True))
    assert pair.name == expected
    assert "no such folder" in error_of(list_benchmark, tmp_path, dataset)


def test_one_of_several_resolutions_must_be_chosen(tmp_path):
    write_middlebury(tmp_path, "F", "Q")
    message = error_of(list_benchmark, tmp_path, "middlebury_v3")
    assert message.endswith("expected pictures of one resolution, found F and Q; choose one (resolution)")
    chosen = list_benchmark(tmp_path, "middlebury_v3", Choice(resolution="F"))
    assert [pair.name for pair in chosen] == ["trainingF/Adirondack", "testF/Plants"]
    message = error_of(list_benchmark, tmp_path, "middlebury_v3", Choice(resolution="H"))
    assert "trainingH: expected a dataset folder, found no such folder" in message
    message = error_of(list_benchmark, tmp_path, "middlebury_v3", Choice(resolution="q"))
    assert message == "resolution: expected one of F, H, Q, found 'q'"


def test_the_folder_inside_the_archive_is_as_good_as_the_one_around_it(tmp_path):
    write_middlebury(tmp_path, "H")
    assert find_benchmark(tmp_path / "MiddEval3") == "middlebury_v3"
    (training, _) = list_benchmark(tmp_path / "MiddEval3", "middlebury_v3")
    assert training.name == "trainingH/Adirondack"


def test_a_choice_that_a_benchmark_does_not_have_is_an_error(tmp_path):
    write_kitti(tmp_path, "kitti2015")
    with pytest.raises(ValueError, match=r"^training_only: cannot be combined with kitti2015, whose subm"):
        list_benchmark(tmp_path, "kitti2015", Choice(training_only=True))
    with pytest.raises(ValueError, match=r"^resolution: cannot be combined with eth3d, whose pictures"):
        list_benchmark(tmp_path, "eth3d", Choice(resolution="H"))


def test_an_unknown_folder_an_unknown_name_and_two_benchmarks_in_one_folder_are_errors(tmp_path):
    assert "with the folder testing/image_0 or testing/image_2 or" in error_of(find_benchmark, tmp_path)
    assert "found no such folder" in error_of(find_benchmark, tmp_path / "nowhere")
    message = error_of(find_benchmark, tmp_path, "kitti")
    assert message == (
        "dataset: expected one of kitti2012, kitti2015, middlebury_v3, eth3d, found 'kitti'; "
        "did you mean kitti2012 or kitti2015?"
    )
    write_kitti(tmp_path, "kitti2012")
    write_kitti(tmp_path, "kitti2015")
    message = error_of(find_benchmark, tmp_path)
    assert message.endswith("one benchmark, found those of kitti2012 and kitti2015; choose one (dataset)")
    assert find_benchmark(tmp_path, "kitti2015") == "kitti2015"


def test_a_missing_damaged_or_differently_sized_picture_is_named_before_any_is_matched(dataset, tmp_path):
    pair = list_benchmark(tmp_path, dataset)[-1]
    write_picture(pair.right, 90, (33, 40))
    expected = f"{pair.right}: expected {pair.size_px[0]}x{pair.size_px[1]} pixels, the size of the left "
    assert error_of(list_benchmark, tmp_path, dataset) == f"{expected}picture, found 40x33"
    pair.right.write_bytes(b"words")
    assert error_of(list_benchmark, tmp_path, dataset).startswith(f"{pair.right}: expected a picture")
    pair.right.unlink()
    assert error_of(list_benchmark, tmp_path, dataset).startswith(f"{pair.right}: expected a")


@pytest.mark.parametrize(
    ("ndisp", "found"), [("many", "many"), ("1", "1"), ("-3", "-3"), ("3.5", "3.5"), ("9" * 50, "9" * 40)]
)
def test_a_number_of_disparities_that_is_none_is_an_error(tmp_path, ndisp, found):
    write_scene(tmp_path / "two_view_training" / "forest_1s", ndisp=ndisp)
    message = error_of(list_benchmark, tmp_path, "eth3d", Choice(training_only=True))
    assert message.endswith(f"calib.txt: expected ndisp, a whole number of at least 2, found {found}")


def test_a_calibration_that_is_missing_or_says_nothing_is_an_error(tmp_path):
    write_eth3d(tmp_path)
    calibration = tmp_path / "two_view_test" / "lakeside_1l" / "calib.txt"
    cut(calibration)
    message = error_of(list_benchmark, tmp_path, "eth3d")
    assert message == f"{calibration}: expected ndisp, a whole number of at least 2, found no such entry"
    calibration.unlink()
    message = error_of(list_benchmark, tmp_path, "eth3d")
    assert message == f"{calibration}: expected a calibration with ndisp, found no such file"


@pytest.mark.parametrize(("name", "shown"), [("two words", "two words"), ("gr\udcfcn", "gr\\udcfcn")])
def test_a_name_that_an_archive_could_not_hold_everywhere_is_an_error(tmp_path, name, shown):
    write_scene(tmp_path / "two_view_training" / "scene")
    (tmp_path / "two_view_training" / "scene").rename(tmp_path / "two_view_training" / name)
    message = error_of(list_benchmark, tmp_path, "eth3d", Choice(training_only=True))
    assert message.endswith(f"expected a name of letters, digits, '.', '-' and '_', found '{shown}'")


def test_an_empty_download_has_no_pairs(tmp_path):
    for folder in KITTI["kitti2015"]:
        (tmp_path / "testing" / folder).mkdir(parents=True)
    message = error_of(list_benchmark, tmp_path, "kitti2015")
    assert message == f"{tmp_path}: expected the unpacked archives of KITTI 2015, found no pairs"


def test_pairs_that_the_site_would_miss_are_told(tmp_path):
    write_eth3d(tmp_path)
    pairs = list_benchmark(tmp_path, "eth3d")
    assert [str(note) for note in describe_missing_pairs("eth3d", pairs)] == [
        "ETH3D two-view has 27 training pairs, found 1; the site will not accept the submission",
        "ETH3D two-view has 20 test pairs, found 1; the site will not accept the submission",
    ]
    training, test = pairs
    assert describe_missing_pairs("eth3d", 27 * [training] + 20 * [test]) == []
    assert describe_missing_pairs("eth3d", 27 * [training]) == []
