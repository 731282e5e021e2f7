import zipfile
from dataclasses import replace

import pytest
from benchmark_examples import write_constant_matcher, write_eth3d, write_kitti, write_middlebury

from stereoweave.bench import submissions
from stereoweave.cli.root import main
from stereoweave.data.benchmarks import BENCHMARKS, TEST, TRAINING


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Work in a folder with one download of each kind, and a network that finds 1.5 px."""
    monkeypatch.chdir(tmp_path)
    write_kitti(tmp_path / "kitti", "kitti2015")
    write_middlebury(tmp_path / "middlebury", "Q")
    write_eth3d(tmp_path / "eth3d")
    write_constant_matcher(tmp_path / "constant.onnx", 1.5)
    return tmp_path


def publish(monkeypatch, dataset, counts):
    """Let a benchmark have as many pairs as its small download here."""
    monkeypatch.setitem(BENCHMARKS, dataset, replace(BENCHMARKS[dataset], published=counts))


def run(command: str) -> int:
    return main(["bench", "submit", *command.split()])


def test_a_submission_is_written_with_a_warning_about_missing_pairs_which_a_check_counts_as_a_problem(
    folder, capfd
):
    assert run("kitti --model constant.onnx --threads 1") == 0
    printed, told = capfd.readouterr()
    assert printed.startswith("submission.zip: KITTI 2015, 2 pairs matched, ")
    assert printed.endswith(" s per pair\n")
    missing = "KITTI 2015 has 200 test pairs, found 2; the site will not accept the submission"
    assert told.splitlines()[0] == f"stereoweave: warning: {missing}"
    assert run("kitti --check submission.zip") == 1
    assert capfd.readouterr() == (f"{missing}\n", "")


def test_a_complete_submission_is_as_its_site_expects_it(folder, capfd, monkeypatch):
    publish(monkeypatch, "kitti2015", {TEST: 2})
    assert run("kitti --model constant.onnx --threads 1") == 0
    assert "warning" not in capfd.readouterr().err
    assert run("kitti --check submission.zip") == 0
    assert capfd.readouterr() == ("submission.zip: 2 pairs, as KITTI 2015 expects them\n", "")


def test_the_training_pairs_of_one_size_are_a_submission_with_the_method_s_name(folder, capfd, monkeypatch):
    publish(monkeypatch, "middlebury_v3", {TRAINING: 1, TEST: 15})
    choice = "--training-only --method Weave --resolution Q --dataset middlebury_v3"
    assert run(f"middlebury --model constant.onnx --threads 1 {choice} -o out/weave.zip") == 0
    assert "out/weave.zip: Middlebury v3, 1 pair matched, " in capfd.readouterr().out
    with zipfile.ZipFile("out/weave.zip") as archive:
        scene = "trainingQ/Adirondack"
        assert archive.namelist() == [f"{scene}/disp0Weave.pfm", f"{scene}/timeWeave.txt"]
    # The method is read from the archive.
    assert run("middlebury --training-only --check out/weave.zip") == 0
    assert capfd.readouterr().out == "out/weave.zip: 1 pair, as Middlebury v3 expects them\n"


def test_problems_have_a_line_each_and_exit_status_1(folder, capfd, monkeypatch):
    publish(monkeypatch, "eth3d", {TRAINING: 1, TEST: 1})
    assert run("eth3d --model constant.onnx --threads 1 --training-only -o half.zip") == 0
    capfd.readouterr()
    assert run("eth3d --check half.zip") == 1
    assert capfd.readouterr().out.splitlines() == [
        "low_res_two_view/lakeside_1l.pfm: expected a file, found none",
        "low_res_two_view/lakeside_1l.txt: expected a file, found none",
    ]
    with zipfile.ZipFile("half.zip", "a") as archive:
        for number in range(25):
            archive.writestr(f"{number}.txt", b"")
    assert run("eth3d --check half.zip") == 1
    lines = capfd.readouterr().out.splitlines()
    assert len(lines) == 21
    assert lines[-1] == "and 7 more"  # 2 + 25 - 20


def test_a_stopped_run_says_how_to_resume_and_resumes(folder, capfd, monkeypatch):
    match, seen = submissions.match, []

    def stop_at_the_last(*given):
        seen.append(given)
        if len(seen) == 3:
            raise KeyboardInterrupt
        return match(*given)

    monkeypatch.setattr(submissions, "match", stop_at_the_last)
    assert run("kitti --model constant.onnx --threads 1 -o k.zip") == 130
    last = "stereoweave: k.zip: stopped; finished pairs are kept; rerun the same command to resume"
    assert capfd.readouterr().err.splitlines()[-1] == last
    monkeypatch.setattr(submissions, "match", match)
    assert run("kitti --model constant.onnx --threads 1 -o k.zip") == 0
    assert "k.zip: KITTI 2015, 1 pair matched, 1 already there, " in capfd.readouterr().out


@pytest.mark.parametrize(
    ("options", "line"),
    [
        (
            "kitti --dataset middlebury_v3",
            "kitti: expected pictures of one resolution, found none; unpack MiddEval3's archives there",
        ),
        ("nowhere", "nowhere: expected a dataset folder, found no such folder"),
        (".", ".: expected the unpacked archives of a benchmark, with the folder testing/image_0 or "),
        (
            "kitti --dataset kitti",
            "--dataset: expected one of kitti2012, kitti2015, middlebury_v3, eth3d, found ",
        ),
        (
            "kitti --dataset kitti2012",
            "kitti/testing/image_0: expected a dataset folder, found no such folder",
        ),
        ("kitti --training-only", "--training-only: cannot be combined with kitti2015, whose submissions "),
        ("eth3d --resolution H", "--resolution: cannot be combined with eth3d, whose pictures have one size"),
        ("middlebury --resolution x", "--resolution: expected one of F, H, Q, found 'x'"),
        (
            "middlebury --method a/b",
            "--method: expected at most 40 letters, digits, '-' and '_', and no '_s'",
        ),
        ("eth3d --method Weave", "--method: cannot be combined with eth3d, whose files are not named after "),
        ("kitti -o kitti", "kitti: expected a file extension of .zip, found none"),
        ("kitti -o constant.onnx", "constant.onnx: expected a file extension of .zip, found .onnx"),
        (
            "kitti -o taken.zip",
            "taken.zip: expected a new file, found one; remove it, or choose another name",
        ),
        ("kitti --check constant.onnx", "constant.onnx: expected a zip archive, found "),
        ("kitti --check none.zip", "none.zip: expected a zip archive, found no such file"),
        ("kitti --model larg", "unknown model 'larg'; expected base, small, best or the path of an .onnx"),
        ("kitti --provider gpu", "--provider: expected one of cpu"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_nothing_behind(folder, capfd, options, line):
    (folder / "taken.zip").write_text("mine")
    before = sorted(folder.rglob("*"))
    assert run(options) == 2
    printed, told = capfd.readouterr()
    lines = [text for text in told.splitlines() if "warning: KITTI 2015 has 200" not in text]
    assert (printed, len(lines)) == ("", 1)
    assert lines[0].startswith(f"stereoweave: {line}")
    assert sorted(folder.rglob("*")) == before


def test_pictures_of_two_resolutions_need_a_choice(folder, capfd):
    write_middlebury(folder / "middlebury", "H")
    assert run("middlebury") == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert line.endswith("expected pictures of one resolution, found H and Q; choose one (--resolution)")
