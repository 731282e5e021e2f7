"""The commands and programs in the README and the docs run as users run them, outside the repository."""

import csv
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from other_processes import UNMEASURED
from PIL import Image, ImageSequence
from pyarrow import parquet
from spatial_examples import SPATIAL

from stereoweave.cli.root import main
from stereoweave.io.animation import write_animation
from stereoweave.io.images import read_image
from stereoweave.rendering.layouts import ANIMATIONS

pytestmark = pytest.mark.system

REPOSITORY = Path(__file__).resolve().parent.parent
PAGES = {
    page: (REPOSITORY / page).read_text(encoding="utf-8")
    for page in ("README.md", *sorted(f"docs/{path.name}" for path in (REPOSITORY / "docs").glob("*.md")))
}


def blocks(page: str, language: str = "sh") -> list[str]:
    """Return the code blocks of a page in one language."""
    return re.findall(rf"```{language}\n(.*?)```", PAGES[page], re.DOTALL)


README = PAGES["README.md"]
DEMO, INSTALL, COMMANDS = blocks("README.md")
PROGRAMS = blocks("README.md", "python") + blocks("docs/python.md", "python")
(PICTURES,), (VIEWS,), (VIDEO,), (SYNTHETIC,), (RESEARCH,) = (
    blocks(f"docs/{page}.md") for page in ("pictures", "views", "video", "synthetic", "paper")
)
BATCH = blocks("docs/cluster.md")[0]
# 700e6 with the bytecode of all packages, which the tests do not compile.
LARGEST_ENVIRONMENT_BYTES = 650e6
# Replacements that render the sets of docs/synthetic.md with smaller pairs.
SMALLER = {"--size 320x240": "--size 64x48", "--rig 260 0.5": "--rig 52 0.5"}
# Replacements that run the README's trainings with fewer steps and with fewer and smaller pairs.
SHORTER = {
    "steps = 400": "steps = 2",
    "batch = 4": "batch = 2",
    "validate_every = 100": "validate_every = 2",
    "validation_pairs = 8": "validation_pairs = 1",
    "\npairs = 64": "\npairs = 2",
    "[64, 128]": "[32, 64]",
}


def run(command: list[str | Path], folder: Path, **environment: str) -> str:
    """Run a command and return its output, which is shown in full if the command fails."""
    environment = os.environ | UNMEASURED | environment
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def copied_repository(folder: Path) -> Path:
    """Copy the files that a fresh checkout has for users to a folder."""
    folder.mkdir()
    for name in ("LICENSE", "Makefile", "README.md", "constraints.txt", "pyproject.toml"):
        shutil.copy(REPOSITORY / name, folder)
    for name in ("examples", "stereoweave"):
        shutil.copytree(REPOSITORY / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    return folder


def packages_in(environment: Path) -> set[str]:
    return {path.name for path in environment.glob("lib/python*/site-packages/*") if path.is_dir()}


def write_pair(folder: Path) -> None:
    """Write the files that the README's commands name: a 96x64 pair, 8 px apart, and a folder of a scene."""
    coarse = np.random.default_rng(0).integers(0, 256, (8, 13, 3), dtype=np.uint8)
    photograph = Image.fromarray(coarse).resize((104, 64))
    left, right = photograph.crop((0, 0, 96, 64)), photograph.crop((8, 0, 104, 64))
    (folder / "scenes" / "wall").mkdir(parents=True)
    for place in (folder, folder / "scenes" / "wall"):
        left.save(place / "left.png")
        right.save(place / "right.png")
    Image.fromarray(np.full((64, 96), 8 * 256, np.uint16)).save(folder / "scenes" / "wall" / "disparity.png")
    Image.fromarray(np.hstack([left, right])).save(folder / "side_by_side.png")
    (folder / "calib.txt").write_text(
        "cam0=[100 0 48; 0 100 32; 0 0 1]\ndoffs=0\nbaseline=80\nwidth=96\nheight=64\n"
    )


@pytest.fixture(scope="module")
def caches(tmp_path_factory) -> str:
    """Return a folder for the compiled kernels of these environments, so that the user's cache has none."""
    return str(tmp_path_factory.mktemp("caches"))


@pytest.fixture(scope="module")
def demo(tmp_path_factory, caches) -> tuple[Path, str]:
    """Run `make demo` in a checkout. Returns the checkout and the output."""
    checkout = copied_repository(tmp_path_factory.mktemp("demo") / "checkout")
    assert DEMO == "make demo\n"
    command = ["make", "demo", f"PYTHON={sys.executable}"]
    return checkout, run(command, checkout, NUMBA_CACHE_DIR=caches, PIP_COMPILE="0")


@pytest.fixture(scope="module")
def installed(demo) -> Path:
    """Install the README's wheel in the demo's environment, in place of the checkout. Returns its folder."""
    environment = demo[0] / ".venv-core"
    run([environment / "bin" / "python", "-m", "pip", "uninstall", "--yes", "stereoweave"], demo[0])
    checkout = copied_repository(demo[0].with_name("copy"))
    run(["bash", "-ec", INSTALL], checkout, PATH=f"{environment / 'bin'}:{os.environ['PATH']}")
    shutil.rmtree(checkout)
    return environment


@pytest.fixture
def pictures(tmp_path) -> Path:
    write_pair(tmp_path)
    return tmp_path


def test_make_demo_on_a_fresh_checkout_says_where_the_report_is(demo):
    checkout, printed = demo
    report = checkout / "demo-out" / "report.html"
    assert f"{report}\n" in printed
    assert report.is_file()
    assert read_image(checkout / "demo-out" / "view.png").shape == (480, 640, 3)
    assert (checkout / "demo-out" / "depth.png").is_file()


def test_the_environment_of_the_demo_is_small_and_has_no_pytorch(demo):
    environment = demo[0] / ".venv-core"
    files = (path for path in environment.rglob("*") if path.is_file() and not path.is_symlink())
    assert sum(path.stat().st_size for path in files) < LARGEST_ENVIRONMENT_BYTES
    assert {"numpy", "onnxruntime"} <= packages_in(environment)
    assert "torch" not in packages_in(environment)


def test_make_demo_takes_the_users_own_pair_and_installs_once(demo, pictures, caches):
    checkout, _ = demo
    pair = [f"LEFT={pictures / 'left.png'}", f"RIGHT={pictures / 'right.png'}"]
    assert "make demo LEFT=left.png RIGHT=right.png" in README
    printed = run(["make", "demo", *pair], checkout, NUMBA_CACHE_DIR=caches)
    assert "pip install" not in printed
    assert read_image(checkout / "demo-out" / "view.png").shape == (64, 96, 3)
    assert not (checkout / "demo-out" / "depth.png").exists()


def test_the_commands_run_from_the_wheel_in_a_user_s_environment(installed, pictures, caches):
    assert "torch" not in packages_in(installed)
    path = f"{installed / 'bin'}:{os.environ['PATH']}"
    run(["bash", "-ec", COMMANDS], pictures, PATH=path, NUMBA_CACHE_DIR=caches)
    described = re.findall(r"^\| `([\w.]+)` \|", PAGES["docs/outputs.md"], re.MULTILINE)
    assert sorted(path.name for path in (pictures / "metric").iterdir()) == sorted(described)
    assert read_image(pictures / "view.png").shape == (64, 96, 3)
    assert read_image(pictures / "anaglyph.png").shape == (64, 96, 3)
    assert (pictures / "many" / "wall" / "disparity.pfm").is_file()


def test_the_views_are_rendered_from_the_wheel_in_a_user_s_environment(installed, pictures, caches):
    path = f"{installed / 'bin'}:{os.environ['PATH']}"
    run(["bash", "-ec", VIEWS], pictures, PATH=path, NUMBA_CACHE_DIR=caches)
    assert read_image(pictures / "view.png").shape == (64, 96, 3)
    assert read_image(pictures / "quilt_qs8x6a1.5.png").shape == (6 * 64, 8 * 96, 3)
    with Image.open(pictures / "wiggle.webp") as wiggle:
        # Equal ones among the 12 frames are merged into one frame, which is shown for longer.
        shown_ms = [frame.info["duration"] for frame in ImageSequence.all_frames(wiggle)]
        assert sum(shown_ms) == 12 * ANIMATIONS["wiggle"].frame_ms


def test_a_user_s_own_scenes_are_scored_from_the_wheel(installed, pictures, caches):
    command = "stereoweave bench pairs scenes -o rows.csv"
    assert f"{command}\n" in PAGES["docs/scores.md"]
    path = f"{installed / 'bin'}:{os.environ['PATH']}"
    run(["bash", "-ec", command], pictures, PATH=path, NUMBA_CACHE_DIR=caches)
    assert (pictures / "rows.csv").is_file()


def test_the_programs_run_from_the_wheel_in_a_user_s_environment(installed, pictures, caches):
    for program in PROGRAMS:
        run([installed / "bin" / "python", "-c", program], pictures, NUMBA_CACHE_DIR=caches)
    assert len(PROGRAMS) == 3
    assert read_image(pictures / "view.png").shape == (64, 96, 3)


def test_the_commands_for_a_user_s_own_pictures_run(tmp_path):
    (tmp_path / "photographs").mkdir()
    for name in ("left.png", "right.png", "calib.txt"):
        shutil.copy(REPOSITORY / "examples" / name, tmp_path)
    for eye in ("left", "right"):
        with Image.open(tmp_path / f"{eye}.png") as picture:
            picture.reduce(2).save(tmp_path / "photographs" / f"1_{eye[0].upper()}.png")
    printed = run(
        ["bash", "-ec", PICTURES], tmp_path, PATH=f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    )
    assert "no defects: the pair is rectified" in printed
    assert "(68 %)" in printed
    assert {"cloud.ply", "mesh.glb", "depth.png"} < {path.name for path in (tmp_path / "points").iterdir()}
    names = ["left.png", "rectified.json", "right.png"]
    assert sorted(path.name for path in (tmp_path / "rows").iterdir()) == names
    for folder in ("many", "many_more"):
        assert (tmp_path / folder / "1" / "disparity.pfm").is_file()
        assert (tmp_path / folder / "summary.csv").read_text().count("\n") == 2


def test_the_commands_for_videos_run(pictures):
    frame = read_image(pictures / "side_by_side.png")
    write_animation(pictures / "video_LR.mp4", [frame] * 3, frame_ms=40)
    shutil.copy(SPATIAL, pictures / "spatial.mov")
    run(["bash", "-ec", VIDEO], pictures, PATH=f"{Path(sys.executable).parent}:{os.environ['PATH']}")
    videos = {path.name for path in pictures.glob("*.m[pk][4v]")} - {"video_LR.mp4"}
    made = "anaglyph.mp4", "between.mp4", "depth.mkv", "depth.mp4", "for_headset_LRF_Full_SBS.mp4"
    assert sorted(videos) == sorted(made)


def test_the_command_for_an_archive_runs(pictures):
    (pictures / "scenes").rename(pictures / "pairs")
    printed = run(
        ["bash", "-ec", BATCH], pictures, PATH=f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    )
    assert "1 pair: 1 made" in printed
    assert parquet.read_table(pictures / "depth" / "manifest")["pair"].to_pylist() == ["wall"]
    assert (pictures / "depth" / "wall" / "disparity.pfm").is_file()


@pytest.mark.needs_egl
def test_the_commands_for_synthetic_sets_run(tmp_path):
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    commands = SYNTHETIC
    for words, smaller in SMALLER.items():
        assert words in commands
        commands = commands.replace(words, smaller)
    printed = run(["bash", "-ec", commands], tmp_path, PATH=path)
    assert "4 pairs\n" in printed
    made = {file.relative_to(tmp_path / "sets").as_posix() for file in (tmp_path / "sets").rglob("*.*")}
    assert {"ship/ship-000000-000003.tar", "views/propeller-000000-000001.tar"} < made
    assert len([name for name in made if name.startswith("film/depth/")]) == 3
    assert "ground truth" in (tmp_path / "views.csv").read_text()


def test_the_commands_for_researchers_resume_and_score_two_trainings(tmp_path):
    for name in ("quick", "quick_plain"):
        recipe = (REPOSITORY / "recipes" / "paper" / f"{name}.toml").read_text()
        for words, fewer in SHORTER.items():
            assert words in recipe
            recipe = recipe.replace(words, fewer)
        (tmp_path / "recipes" / "paper").mkdir(parents=True, exist_ok=True)
        (tmp_path / "recipes" / "paper" / f"{name}.toml").write_text(recipe)
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    # With pictures of this size, threads would mostly wait for each other.
    environment = {"PATH": path, "OMP_NUM_THREADS": "1"}
    run(["bash", "-ec", RESEARCH], tmp_path, **environment)
    written = (tmp_path / "runs" / "quick.csv").read_text()
    rows = {row["method"]: row for row in csv.DictReader(written.splitlines())}
    assert list(rows) == ["ground truth", "no warping", "sgbm", "median", "quick", "quick_plain"]
    assert rows["quick"]["epe_px"] != rows["quick_plain"]["epe_px"]
    finished = (tmp_path / "runs" / "quick" / "last.pt").stat().st_mtime_ns
    # Started again with the same command, a finished training has nothing left to do.
    run(["bash", "-ec", RESEARCH.splitlines()[0]], tmp_path, **environment)
    assert (tmp_path / "runs" / "quick" / "last.pt").stat().st_mtime_ns == finished


def test_each_command_that_is_mentioned_exists(capsys):
    mentioned = set(re.findall(r"`stereoweave (\w+)[` ]", "".join(PAGES.values())))
    assert {"app", "bench", "depth", "live", "serve", "synth", "video"} <= mentioned
    for name in mentioned:
        assert main([name, "--help"]) == 0
        assert f"Usage: stereoweave {name}" in capsys.readouterr().out


def test_each_file_that_a_page_links_to_exists():
    missing = [
        (page, link)
        for page, text in PAGES.items()
        for link in re.findall(r"\]\(([^)\s#]+)", text)
        if "://" not in link and not ((REPOSITORY / page).parent / link).exists()
    ]
    assert missing == []


def test_the_index_links_to_each_page():
    index = PAGES["docs/index.md"]
    pages = {Path(page).name for page in PAGES} - {"index.md"}
    assert sorted(page for page in pages if f"]({page})" not in index and f"(../{page})" not in index) == []


def test_the_table_of_results_agrees_with_the_csv():
    measured = REPOSITORY / "results" / "pairs.csv"
    rows = csv.DictReader(measured.read_text().splitlines()) if measured.exists() else []
    decimals = {"epe_px": 2, "bad1_percent": 1, "bad2_percent": 1, "d1_percent": 1, "time_relative": 2}
    expected = [
        [row["matcher"], *(f"{float(row[column]):.{places}f}" for column, places in decimals.items())]
        for row in rows
        if row["scene"] == "mean"
    ]
    table = README.split("<!-- results -->")[1].split("\n\n")[1].splitlines()[2:]
    assert [[cell.strip() for cell in line.strip("|").split("|")] for line in table] == expected
