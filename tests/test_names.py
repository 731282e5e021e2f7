"""Unusual file names: bytes that are not UTF-8, and text that spreadsheets would run as formulas."""

import csv
import json
import os
import subprocess
import sys
import unicodedata
from dataclasses import dataclass
from pathlib import Path

import pytest

from stereoweave.bench.tables import write_csv
from stereoweave.cli.root import main
from stereoweave.io.images import read_image, write_image

TEXTURED = Path(__file__).resolve().parent / "textured_pair"
# Names in Latin-1, as on old disks: "grün", "grûn".
GREEN, GREENISH = os.fsdecode(b"gr\xfcn"), os.fsdecode(b"gr\xfbn")
SHOWN, SHOWN_TOO = r"gr\udcfcn", r"gr\udcfbn"
FORMULAS = ["=1+1", "@SUM(A1)", "+cmd|calc", "-2+3", "\tx", "\rx", "\nx", "'=1+1"]

pytestmark = pytest.mark.skipif(
    sys.platform in ("win32", "darwin"), reason="names of files are Unicode on this system"
)


def write_pair(folder: Path, name: str) -> list[str]:
    """Write a small pair. Returns the paths of its pictures."""
    folder.mkdir(exist_ok=True)
    files = [folder / f"{name}_{side}.png" for side in ("left", "right")]
    for file in files:
        small = read_image(TEXTURED / f"{file.stem.rpartition('_')[2]}.png")[200:264, 200:296]
        write_image(file.with_name("new.png"), small)
        file.with_name("new.png").rename(file)
    return [str(file) for file in files]


def table(file: Path) -> list[dict[str, str]]:
    with file.open(newline="", encoding="utf-8") as opened:
        return list(csv.DictReader(opened))


def test_a_report_shows_bytes_of_a_name_that_are_not_utf8(tmp_path, capsys):
    pair = write_pair(tmp_path / "in", GREEN)
    assert main(["depth", *pair, "-o", str(tmp_path / "out"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["pictures"] == [Path(file).name for file in pair]
    assert f"{SHOWN}_left.png" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


def test_a_batch_of_such_names_has_a_row_for_each_pair(tmp_path):
    for name in (GREEN, GREENISH, "=1+1", "'=1+1"):
        write_pair(tmp_path / "in", name)
    (tmp_path / "in" / f"{GREEN}2_left.png").write_bytes(b"no picture")
    assert main(["depth", str(tmp_path / "in"), "-o", str(tmp_path / "out"), "--jobs", "1"]) == 1
    rows = {row["name"]: row for row in table(tmp_path / "out" / "summary.csv")}
    assert set(rows) == {SHOWN, SHOWN_TOO, "'=1+1", "''=1+1", f"{SHOWN}2"}
    assert rows[SHOWN]["pictures"] == f"{SHOWN}_left.png + {SHOWN}_right.png"
    assert rows["'=1+1"]["pictures"] == "'=1+1_left.png + =1+1_right.png"
    assert f"{SHOWN}2_" in rows[f"{SHOWN}2"]["error"]
    assert (tmp_path / "out" / GREEN / "disparity.pfm").exists()


def test_tables_of_scores_have_no_formulas_and_keep_different_names_apart(tmp_path):
    @dataclass
    class Row:
        scene: str
        bias_px: float

    names = [*FORMULAS, GREEN, GREENISH, "plain"]
    write_csv(tmp_path / "rows.csv", [Row(name, -0.5) for name in names], {})
    rows = table(tmp_path / "rows.csv")
    assert [row["scene"] for row in rows] == [*(f"'{name}" for name in FORMULAS), SHOWN, SHOWN_TOO, "plain"]
    assert {row["bias_px"] for row in rows} == {"-0.5"}


def test_no_cell_is_a_formula_however_a_spreadsheet_splits_a_row(tmp_path):
    @dataclass
    class Row:
        share: float
        scene: str

    # A spreadsheet with German settings splits at semicolons, and does not recognise quotes within a cell.
    names = [
        *("a;=cmd|'/C calc'!A0", "a\t=1+1", "a; \t=1+1", "a\n=1+1", 'a,";=1+1', "a;'=1+1", "a;=1;=2"),
        *(" =1+1", "\u00a0=1+1", "\uff1d1+1", "a;\uff1d1+1", "' =1+1"),
    ]
    write_csv(tmp_path / "rows.csv", [Row(0.5, name) for name in names], {})
    rows = table(tmp_path / "rows.csv")
    assert len({row["scene"] for row in rows}) == len(names)
    for delimiter in ",;\t":
        with (tmp_path / "rows.csv").open(newline="", encoding="utf-8") as file:
            cells = [cell for row in csv.reader(file, delimiter=delimiter) for cell in row]
        assert len(cells) > len(names)
        for cell in cells:
            assert not unicodedata.normalize("NFKC", cell).lstrip().startswith(tuple("=+-@")), cell


@pytest.mark.parametrize("name", ["a;b", "a; b - c", "a\tb", "a=1", "-0.5"])
def test_text_that_is_not_a_formula_is_unchanged_in_a_table(tmp_path, name):
    @dataclass
    class Row:
        scene: str

    write_csv(tmp_path / "rows.csv", [Row(name)], {})
    assert [row["scene"] for row in table(tmp_path / "rows.csv")] == [name]


def test_the_console_shows_such_names(tmp_path):
    pair = write_pair(tmp_path / "in", GREEN)
    program = [sys.executable, "-m", "stereoweave", "rectify", *pair, "-o", str(tmp_path / GREEN)]
    # Strict encoding, as in most environments; that of Python's own tests is lenient.
    strict = {**os.environ, "PYTHONIOENCODING": "utf-8:strict"}
    done = subprocess.run(program, capture_output=True, text=True, env=strict, check=False)
    assert done.returncode == 0, done.stderr
    assert f"{tmp_path}/{SHOWN}: left.png and right.png" in done.stdout


def test_a_video_of_pictures_with_such_names_is_read(tmp_path):
    for frame in range(2):
        write_pair(tmp_path / "in", f"{GREEN}{frame}")
    for side in ("left", "right"):
        (tmp_path / side).mkdir()
        for file in (tmp_path / "in").glob(f"*_{side}.png"):
            file.rename(tmp_path / side / file.name)
    sides = [str(tmp_path / side) for side in ("left", "right")]
    assert main(["video", *sides, "--depth", "-o", str(tmp_path / "depth.mp4")]) == 0
