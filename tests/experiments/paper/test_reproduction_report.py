"""The numbers of the reproduction report are those of the files that it names."""

import csv
import re
from pathlib import Path
from statistics import fmean

import pytest

ROOT = Path(__file__).resolve().parents[3]
REPORT = (ROOT / "experiments" / "paper" / "README.md").read_text()
LINES = [
    [cell.strip() for cell in line.strip("|").split("|")] for line in REPORT.splitlines() if line[:1] == "|"
]
CLAIMS = [cells for cells in LINES if re.fullmatch(r"C\d+", cells[0])]
ROWS = [cells for cells in LINES if re.fullmatch(r"R\d+", cells[0])]


@pytest.mark.parametrize(("name", "claim", "file", "reduction"), CLAIMS, ids=[cells[0] for cells in CLAIMS])
def test_a_claim_is_a_line_of_its_report(name, claim, file, reduction):
    found = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in (ROOT / file).read_text().splitlines()
        if line.startswith(f"| {claim} |")
    ]
    assert [cells[2] for cells in found] == [reduction]


@pytest.mark.parametrize(
    ("name", "where", "file", "column", "mean", "count"), ROWS, ids=[cells[0] for cells in ROWS]
)
def test_a_row_is_the_mean_of_the_rows_of_its_file(name, where, file, column, mean, count):
    conditions = [condition.split(" = ", 1) for condition in where.split("; ")]
    with (ROOT / file).open(newline="") as opened:
        values = [
            float(row[column])
            for row in csv.DictReader(opened)
            if all(row[key] == value for key, value in conditions)
        ]
    decimals = len(mean.partition(".")[2])
    assert (len(values), f"{fmean(values):.{decimals}f}") == (int(count), mean)


def test_every_row_is_used_and_every_one_used_exists():
    text = REPORT.split("## Claims: lines of the reports")[0]
    used = {f"{letter}{number}" for letter, number in re.findall(r"\b([CR])(\d+)\b", text)}
    for letter, first, last in re.findall(r"\b([CR])(\d+) to [CR](\d+)\b", text):
        used |= {f"{letter}{number}" for number in range(int(first), int(last) + 1)}
    defined = [cells[0] for cells in CLAIMS + ROWS]
    assert len(defined) == len(set(defined)) > 40
    assert used == set(defined)
