import json
import zipfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from benchmark_examples import (
    parse_pfm,
    write_constant_matcher,
    write_eth3d,
    write_kitti,
    write_middlebury,
)
from dataset_examples import cut, error_of
from rich.console import Console

from stereoweave.bench import submissions
from stereoweave.bench.submission_check import find_problems, read_method
from stereoweave.bench.submission_formats import FORMATS, Submission
from stereoweave.bench.submissions import parts_folder, write_submission
from stereoweave.data.benchmarks import BENCHMARKS, list_benchmark
from stereoweave.errors import StereoweaveError
from stereoweave.io.output_lock import lock_output
from stereoweave.matching.backend import Backend

WRITERS = {
    "kitti2012": lambda root: write_kitti(root, "kitti2012"),
    "kitti2015": lambda root: write_kitti(root, "kitti2015"),
    "middlebury_v3": write_middlebury,
    "eth3d": write_eth3d,
}
FILES = {
    "kitti2012": ["000000_10.png", "000001_10.png"],
    "kitti2015": ["disp_0/000000_10.png", "disp_0/000001_10.png"],
    "middlebury_v3": [
        "trainingQ/Adirondack/disp0Stereoweave.pfm",
        "trainingQ/Adirondack/timeStereoweave.txt",
        "testQ/Plants/disp0Stereoweave.pfm",
        "testQ/Plants/timeStereoweave.txt",
    ],
    "eth3d": [
        "low_res_two_view/forest_1s.pfm",
        "low_res_two_view/forest_1s.txt",
        "low_res_two_view/lakeside_1l.pfm",
        "low_res_two_view/lakeside_1l.txt",
    ],
}
# Width and height of the two pairs.
SIZES = {
    "kitti2012": [(40, 32), (40, 32)],
    "kitti2015": [(40, 32), (40, 32)],
    "middlebury_v3": [(40, 32), (44, 36)],
    "eth3d": [(40, 32), (44, 36)],
}
TIME = {"middlebury_v3": "0.52", "eth3d": "runtime 0.52"}
QUIET = Console(quiet=True)


@pytest.fixture(scope="module")
def backend(tmp_path_factory):
    """Return a network that finds 1.5 px everywhere."""
    path = write_constant_matcher(tmp_path_factory.mktemp("network") / "constant.onnx", 1.5)
    return Backend(model=path, threads=1)


@pytest.fixture(params=WRITERS)
def submission(request, tmp_path):
    root = WRITERS[request.param](tmp_path / "download")
    return Submission(dataset=request.param, pairs=list_benchmark(root, request.param))


def kitti(tmp_path):
    return Submission(
        dataset="kitti2015",
        pairs=list_benchmark(write_kitti(tmp_path / "download", "kitti2015"), "kitti2015"),
    )


def written_map(dataset, path: Path, values) -> bytes:
    """Return the bytes of a map in the dataset's format."""
    file = path.with_suffix(Path(FORMATS[dataset].map_name).suffix)
    FORMATS[dataset].write_map(file, np.array(values, np.float32))
    return file.read_bytes()


def valid_archive(path: Path, submission: Submission, **changed: bytes | None) -> Path:
    """Write a valid archive by hand, with files added, or changed, or left out (None)."""
    maps = {}
    for name, (width, height) in zip(
        (name for name in FILES[submission.dataset] if not name.endswith("txt")),
        SIZES[submission.dataset],
        strict=True,
    ):
        maps[name] = written_map(submission.dataset, path, np.full((height, width), 1.5))
    files = {
        name: maps.get(name, TIME.get(submission.dataset, "").encode()) for name in FILES[submission.dataset]
    }
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in (files | changed).items():
            if content is not None:
                archive.writestr(name, content)
    return path


def problems(path: Path, submission: Submission, **changed: bytes | None) -> list[str]:
    return list(find_problems(valid_archive(path, submission, **changed), submission))


def test_kitti_s_map_is_256_steps_per_px_where_nothing_is_unknown(tmp_path):
    content = written_map("kitti2015", tmp_path / "map", [[1.5, 0, -2, 300], [255.5, 1 / 256, 0.001, 70.25]])
    read = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    assert read.dtype == np.uint16
    # 1.5 * 256, the least value that is not unknown, and the greatest of 16 bits
    assert read.tolist() == [[384, 1, 1, 65535], [65408, 1, 1, 17984]]


@pytest.mark.parametrize("dataset", ["middlebury_v3", "eth3d"])
def test_a_pfm_is_little_endian_from_the_bottom_row_up(tmp_path, dataset):
    content = written_map(dataset, tmp_path / "map", [[1.5, 2], [3, -0.25], [5, 6]])
    assert content == b"Pf\n2 3\n-1.0\n" + np.array([5, 6, 3, -0.25, 1.5, 2], "<f4").tobytes()
    assert parse_pfm(content).tolist() == [[1.5, 2], [3, -0.25], [5, 6]]


@pytest.mark.parametrize(
    ("dataset", "time_s", "text"),
    [
        ("middlebury_v3", 0.5, "0.5"),
        ("middlebury_v3", 12.3456789, "12.3457"),
        ("eth3d", 0.0625, "runtime 0.0625"),
        ("eth3d", 100, "runtime 100"),
    ],
)
def test_a_time_is_a_number_of_seconds_without_anything_else(dataset, time_s, text):
    assert FORMATS[dataset].format_time(time_s) == text
    assert FORMATS[dataset].parse_time(text) == pytest.approx(time_s, rel=1e-5)


def test_all_pairs_are_matched_and_packed_as_the_site_expects(submission, backend, tmp_path):
    assert set(FORMATS) == set(BENCHMARKS)
    out = tmp_path / "new" / "results.zip"
    written = write_submission(out, submission, backend, console=QUIET)
    assert (written.made, written.resumed) == (2, 0)
    assert [file.name for file in out.parent.iterdir()] == ["results.zip"]
    with zipfile.ZipFile(out) as archive:
        assert archive.namelist() == FILES[submission.dataset]
        files = {name: archive.read(name) for name in archive.namelist()}
    sizes = iter(SIZES[submission.dataset])
    times_s = []
    for name, content in files.items():
        if name.endswith(".png"):
            steps = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
            np.testing.assert_array_equal(steps, np.full(next(sizes)[::-1], 384, np.uint16))
        elif name.endswith(".pfm"):
            np.testing.assert_array_equal(parse_pfm(content), np.full(next(sizes)[::-1], 1.5, np.float32))
        else:
            before = "runtime " if submission.dataset == "eth3d" else ""
            assert content.decode().startswith(before)
            times_s.append(float(content.decode().removeprefix(before)))
    if times_s:
        assert min(times_s) > 0
        assert np.mean(times_s) == pytest.approx(written.mean_time_s, rel=1e-4)
    assert list(find_problems(out, submission)) == []


def test_a_published_range_limits_the_disparities(tmp_path):
    root = write_eth3d(tmp_path / "download")
    eth3d = Submission(dataset="eth3d", pairs=list_benchmark(root, "eth3d"))
    network = write_constant_matcher(tmp_path / "far.onnx", 30.0)
    write_submission(tmp_path / "out.zip", eth3d, Backend(model=network, threads=1), console=QUIET)
    with zipfile.ZipFile(tmp_path / "out.zip") as archive:
        # 20 disparities, from 0 to 19
        assert parse_pfm(archive.read("low_res_two_view/forest_1s.pfm")).max() == 19


def test_the_method_names_middlebury_s_files_and_no_other_s(tmp_path):
    root = write_middlebury(tmp_path / "download")
    pairs = list_benchmark(root, "middlebury_v3")
    ours = Submission(dataset="middlebury_v3", pairs=pairs, method="Weave-2_b")
    assert list(ours.files())[:2] == [
        "trainingQ/Adirondack/disp0Weave-2_b.pfm",
        "trainingQ/Adirondack/timeWeave-2_b.txt",
    ]
    for wrong in ("", "a/b", "two words", "sparse_s", "x" * 41, "{pair}"):
        with pytest.raises(StereoweaveError, match="^method: expected at most 40 letters"):
            Submission(dataset="middlebury_v3", pairs=pairs, method=wrong)
    with pytest.raises(StereoweaveError, match="^method: cannot be combined with eth3d"):
        Submission(dataset="eth3d", pairs=pairs, method="Weave")


def test_an_interrupted_run_resumes_with_the_missing_pairs_alone(submission, backend, tmp_path, monkeypatch):
    out = tmp_path / "results.zip"
    match, seen = submissions.match, []

    def stop_at_the_last(matcher, pair, options):
        seen.append(pair)
        if len(seen) == 3:  # the first pair is matched twice, once to warm up
            raise KeyboardInterrupt
        return match(matcher, pair, options)

    monkeypatch.setattr(submissions, "match", stop_at_the_last)
    with pytest.raises(KeyboardInterrupt):
        write_submission(out, submission, backend, console=QUIET)
    assert not out.exists()
    monkeypatch.setattr(submissions, "match", lambda *given: seen.append(given) or match(*given))
    del seen[:]
    written = write_submission(out, submission, backend, console=QUIET)
    assert (written.made, written.resumed, len(seen)) == (1, 1, 2)
    assert list(find_problems(out, submission)) == []
    assert not parts_folder(out).exists()


def test_an_error_says_where_finished_pairs_are_and_other_settings_do_not_resume_them(
    backend, tmp_path, monkeypatch
):
    submission, out = kitti(tmp_path), tmp_path / "results.zip"
    damaged = submission.pairs[1].right
    whole = damaged.read_bytes()
    cut(damaged)
    message = error_of(lambda: write_submission(out, submission, backend, console=QUIET))
    assert message.startswith(f"{damaged}: expected")
    assert f"; finished pairs are in {out}.parts; rerun the same command to resume" in message
    damaged.write_bytes(whole)
    message = error_of(lambda: write_submission(out, submission, backend, refined=True, console=QUIET))
    assert "expected refined = true for this run, found false" in message
    assert message.endswith(f"; or remove {out}.parts to start anew")
    network = write_constant_matcher(tmp_path / "constant.onnx", 2.0)
    other = Backend(model=network, threads=1)
    assert "expected model = " in error_of(lambda: write_submission(out, submission, other, console=QUIET))
    assert write_submission(out, submission, backend, console=QUIET).resumed == 1


def test_an_error_with_the_first_pair_leaves_nothing_behind(backend, tmp_path):
    submission, out = kitti(tmp_path), tmp_path / "results.zip"
    picture = submission.pairs[0].left
    cut(picture)
    message = error_of(lambda: write_submission(out, submission, backend, console=QUIET))
    assert message.startswith(f"{picture}: expected")
    assert "resume" not in message
    assert [path.name for path in tmp_path.iterdir()] == ["download"]


def test_a_damaged_part_is_found_before_the_archive_has_its_name(backend, tmp_path, monkeypatch):
    submission, out = kitti(tmp_path), tmp_path / "results.zip"
    ours = FORMATS["kitti2015"]
    smaller = replace(ours, write_map=lambda path, disparity_px: ours.write_map(path, disparity_px[1:]))
    monkeypatch.setitem(FORMATS, "kitti2015", smaller)
    message = error_of(lambda: write_submission(out, submission, backend, console=QUIET))
    assert message == (
        f"{out}: not written; disp_0/000000_10.png: expected 40x32 pixels, the size of the pictures, "
        f"found 40x31; remove {out}.parts, and run the command again"
    )
    assert not out.exists()


@pytest.mark.parametrize("content", ["words", "[]", "{}"])
def test_a_folder_of_parts_that_is_not_ours_is_left_alone(backend, tmp_path, content):
    submission, out = kitti(tmp_path), tmp_path / "results.zip"
    parts_folder(out).mkdir()
    settings = parts_folder(out) / "submission.json"
    settings.write_text(content)
    assert str(settings) in error_of(lambda: write_submission(out, submission, backend, console=QUIET))
    settings.rename(parts_folder(out) / "mine.txt")
    message = error_of(lambda: write_submission(out, submission, backend, console=QUIET))
    assert message.endswith("expected an empty folder or one with a submission.json, found one with mine.txt")
    assert (parts_folder(out) / "mine.txt").read_text() == content


def test_an_existing_archive_another_ending_and_a_second_command_are_errors(backend, tmp_path):
    submission = kitti(tmp_path)
    out = tmp_path / "results.zip"
    out.write_text("mine")
    message = error_of(lambda: write_submission(out, submission, backend, console=QUIET))
    assert message == f"{out}: expected a new file, found one; remove it, or choose another name"
    assert out.read_text() == "mine"
    message = error_of(lambda: write_submission(tmp_path / "x.7z", submission, backend, console=QUIET))
    assert message == f"{tmp_path / 'x.7z'}: expected a file extension of .zip, found .7z"
    free = tmp_path / "free.zip"
    with lock_output(free):
        message = error_of(lambda: write_submission(free, submission, backend, console=QUIET))
    assert "found one that is in use" in message
    assert not parts_folder(free).exists()


def test_an_archive_written_by_hand_has_no_problems(submission, tmp_path):
    assert problems(tmp_path / "a.zip", submission) == []


def test_a_missing_file_another_file_and_a_folder_around_all_are_problems(submission, tmp_path):
    for name in FILES[submission.dataset]:
        assert problems(tmp_path / "a.zip", submission, **{name: None}) == [
            f"{name}: expected a file, found none"
        ]
    extra = f"{submission.dataset}.txt"
    (problem,) = problems(tmp_path / "a.zip", submission, **{extra: b"x"})
    assert problem == f"{extra}: expected only the maps and times of the pairs, found another file"
    with zipfile.ZipFile(tmp_path / "b.zip", "w") as archive:
        for name in FILES[submission.dataset]:
            archive.writestr(f"results/{name}", b"")
    (problem,) = find_problems(tmp_path / "b.zip", submission)
    first = FILES[submission.dataset][0]
    assert problem == f"results: expected {first} in the root of the archive, found this folder around it"


def test_a_map_of_another_size_or_kind_or_without_disparities_is_a_problem(submission, tmp_path):
    name, (width, height) = FILES[submission.dataset][0], SIZES[submission.dataset][0]
    smaller = written_map(submission.dataset, tmp_path / "map", np.ones((height - 1, width)))
    (problem,) = problems(tmp_path / "a.zip", submission, **{name: smaller})
    assert problem == f"{name}: expected 40x32 pixels, the size of the pictures, found 40x31"
    unknown = written_map(submission.dataset, tmp_path / "map", np.full((height, width), np.inf))
    if name.endswith(".png"):
        unknown = cv2.imencode(".png", np.zeros((height, width), np.uint16))[1].tobytes()
    (problem,) = problems(tmp_path / "a.zip", submission, **{name: unknown})
    assert problem.startswith(f"{name}: expected ")
    assert "found" in problem
    (problem,) = problems(tmp_path / "a.zip", submission, **{name: b"words"})
    assert problem.startswith(f"{name}: expected a")
    assert str(tmp_path) not in problem
    (problem,) = problems(tmp_path / "a.zip", submission, **{name: bytes(10_000 + 4096)})
    assert (
        problem
        == f"{name}: expected at most {(3 if name.endswith('png') else 4) * 1280 + 4096} bytes, found more"
    )


def test_kitti_s_map_has_16_bits(tmp_path):
    eight = cv2.imencode(".png", np.ones((32, 40), np.uint8))[1].tobytes()
    (problem,) = problems(tmp_path / "a.zip", kitti(tmp_path), **{"disp_0/000001_10.png": eight})
    assert problem == "disp_0/000001_10.png: expected a picture of mode I;16, found mode L (PNG)"


@pytest.mark.parametrize("value", [np.inf, np.nan, -np.inf])
def test_a_pixel_without_a_number_is_missing_in_eth3d_and_a_problem_in_middlebury(tmp_path, value):
    holes = np.full((32, 40), 1.5)
    holes[3, 4:6] = value
    root = write_middlebury(tmp_path / "middlebury")
    dense = Submission(dataset="middlebury_v3", pairs=list_benchmark(root, "middlebury_v3"))
    name = "trainingQ/Adirondack/disp0Stereoweave.pfm"
    content = written_map("middlebury_v3", tmp_path / "map", holes)
    (problem,) = problems(tmp_path / "a.zip", dense, **{name: content})
    assert problem == f"{name}: expected a number at every pixel, found 2 without"
    root = write_eth3d(tmp_path / "eth3d")
    sparse = Submission(dataset="eth3d", pairs=list_benchmark(root, "eth3d"))
    assert problems(tmp_path / "a.zip", sparse, **{"low_res_two_view/forest_1s.pfm": content}) == []


@pytest.mark.parametrize(
    "text", ["", "fast", "0", "-1", "nan", "inf", "runtime", "1 s", "1.5\x00", "1" * 300]
)
def test_a_time_that_is_no_positive_number_is_a_problem(tmp_path, text):
    root = write_eth3d(tmp_path / "eth3d")
    eth3d = Submission(dataset="eth3d", pairs=list_benchmark(root, "eth3d"))
    name = "low_res_two_view/forest_1s.txt"
    (problem,) = problems(tmp_path / "a.zip", eth3d, **{name: f"runtime {text}".encode()})
    assert problem.startswith(f"{name}: expected a")
    root = write_middlebury(tmp_path / "middlebury")
    dense = Submission(dataset="middlebury_v3", pairs=list_benchmark(root, "middlebury_v3"))
    name = "testQ/Plants/timeStereoweave.txt"
    (problem,) = problems(tmp_path / "b.zip", dense, **{name: text.encode()})
    assert problem.startswith(f"{name}: expected a")


def test_a_time_without_its_word_is_a_problem_in_eth3d_alone(tmp_path):
    root = write_eth3d(tmp_path / "eth3d")
    eth3d = Submission(dataset="eth3d", pairs=list_benchmark(root, "eth3d"))
    name = "low_res_two_view/forest_1s.txt"
    (problem,) = problems(tmp_path / "a.zip", eth3d, **{name: b"0.52"})
    assert problem == f"{name}: expected a time in seconds, such as 'runtime 1.5', found '0.52'"
    assert problems(tmp_path / "a.zip", eth3d, **{name: b"runtime 0.52\n"}) == []


def test_the_method_of_another_program_s_archive_is_read_from_its_names(tmp_path):
    root = write_middlebury(tmp_path / "download")
    theirs = Submission(
        dataset="middlebury_v3", pairs=list_benchmark(root, "middlebury_v3"), method="SGM_RVC"
    )
    archive = tmp_path / "a.zip"
    with zipfile.ZipFile(archive, "w") as opened:
        for name in theirs.files():
            opened.writestr(name, b"")
        opened.writestr("testQ/Plants/disp0SGM_RVC_s.pfm", b"")
    assert read_method(archive, "middlebury_v3") == "SGM_RVC"
    assert read_method(archive, "eth3d") == "Stereoweave"


@pytest.mark.parametrize("content", [b"", b"words", b"PK\x03\x04" + bytes(100)])
def test_a_file_that_is_no_archive_is_an_error(submission, tmp_path, content):
    (tmp_path / "a.zip").write_bytes(content)
    message = error_of(lambda: list(find_problems(tmp_path / "a.zip", submission)))
    assert message.startswith(f"{tmp_path / 'a.zip'}: expected a zip archive, found")
    message = error_of(lambda: list(find_problems(tmp_path / "none.zip", submission)))
    assert message == f"{tmp_path / 'none.zip'}: expected a zip archive, found no such file"


def test_damage_anywhere_in_an_archive_is_a_problem_or_an_error(submission, tmp_path):
    path = valid_archive(tmp_path / "a.zip", submission)
    whole = path.read_bytes()
    found, places = 0, range(0, len(whole), len(whole) // 40)
    for place in places:
        damaged = bytearray(whole)
        damaged[place] ^= 0x41
        path.write_bytes(damaged)
        try:
            found += bool(list(find_problems(path, submission)))
        except StereoweaveError as error:
            assert "\n" not in str(error)
            found += 1
    # Dates and the like are not looked at.
    assert found > 0.6 * len(places)


def test_a_file_that_unpacks_to_more_than_a_map_is_not_unpacked(tmp_path):
    submission = kitti(tmp_path)
    path, name = tmp_path / "a.zip", "disp_0/000000_10.png"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, bytes(50_000_000))
        archive.writestr(
            "disp_0/000001_10.png", written_map("kitti2015", tmp_path / "map", np.ones((32, 40)))
        )
    (problem,) = find_problems(path, submission)
    assert problem == f"{name}: expected at most 7936 bytes, found more"


def test_the_settings_of_an_unfinished_submission_are_json(backend, tmp_path, monkeypatch):
    submission, out = kitti(tmp_path), tmp_path / "results.zip"
    monkeypatch.setattr(submissions, "_pack", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        write_submission(out, submission, backend, console=QUIET)
    facts = json.loads((parts_folder(out) / "submission.json").read_text())
    assert facts["dataset"] == "kitti2015"
    assert facts["first_picture"] == str(submission.pairs[0].left)
