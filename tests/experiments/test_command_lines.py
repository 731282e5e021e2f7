import csv
import os
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

from experiments.paper.trials import Extent

REPOSITORY = Path(__file__).resolve().parents[2]
RECIPE = REPOSITORY / "recipes" / "weave_small.toml"
PAPER_RECIPE = REPOSITORY / "recipes" / "paper" / "experiment.toml"
EXPERIMENTS = (
    "ablations",
    "average_weights",
    "failures",
    "first_run",
    "handheld",
    "interleaved",
    "paper",
    "paper_sets",
    "paper_transfer",
    "paper_worlds",
    "search_extents",
    "speed",
    "sphere_windows",
    "stage_costs",
    "video_speed",
    "whole_films",
)
README = (REPOSITORY / "experiments" / "README.md").read_text(encoding="utf-8")


def run(line):
    experiment, *arguments = line.split()
    return import_module(f"experiments.{experiment}.__main__").main(arguments)


def read_rows(file):
    with Path(file).open() as stream:
        return list(csv.DictReader(stream))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("words.toml").write_text("these are words")
    Path("low.toml").write_text(PAPER_RECIPE.read_text().replace("exponent = 1.5", "exponent = 0.5"))
    return tmp_path


@pytest.mark.parametrize(
    ("line", "fragments"),
    [
        ("speed none.toml -o rows.csv", ["none.toml", "expected a recipe"]),
        ("speed words.toml -o rows.csv", ["words.toml", "expected a recipe"]),
        ("paper none.toml -o runs --report report", ["none.toml", "expected a recipe"]),
        (
            "paper low.toml -o runs --report report",
            ["low.toml", "exponent: expected a number of at least 1", "found 0.5"],
        ),
        (f"paper {RECIPE} -o runs --report report", ["small", "expected 'fast_depth'"]),
        (f"paper {RECIPE} -o runs", ["--report", "--help"]),
        (f"paper {RECIPE} -o runs --report report --seeds 0", ["--seeds"]),
        (f"paper {RECIPE} -o runs --report report --jobs 0", ["--jobs"]),
        (f"paper {RECIPE} -o runs --report report --slow-steps 0", ["--slow-steps"]),
        (f"paper {PAPER_RECIPE} -o runs --report report --only speed", ["only: expected", "'speed'"]),
        ("ablations none.toml -o runs --report rows.csv", ["none.toml", "expected a recipe"]),
        ("stage_costs none.pt -o rows.csv", ["none.pt", "no such checkpoint"]),
        ("average_weights none.pt -o mean.pt", ["none.pt", "no such checkpoint"]),
        ("paper_worlds none.toml -o rows.csv", ["none.toml", "expected a recipe"]),
        (f"paper_worlds {PAPER_RECIPE} -o rows.csv", ["experiment", "dataset = 'paper_worlds'"]),
        ("paper_sets", ["--report", "--help"]),
        ("paper_sets --report rows --size big", ["--size: expected width x height"]),
        (
            f"paper_transfer {PAPER_RECIPE} none.pt -o runs --report report",
            ["none.pt", "expected a checkpoint of stereoweave train"],
        ),
        ("whole_films none.mp4 -o rows.csv", ["none.mp4", "no such"]),
        (
            "whole_films none.mp4 -o rows.csv --output hologram",
            ["side_by_side, anaglyph", "found 'hologram'"],
        ),
    ],
)
def test_a_mistake_with_an_experiment_is_reported_in_one_line(folder, capfd, line, fragments):
    before = sorted(folder.rglob("*"))
    assert run(line) == 2
    printed, reported = capfd.readouterr()
    assert printed == ""
    (message,) = reported.splitlines()
    assert message.startswith(f"python -m experiments.{line.split()[0]}: ")
    assert [fragment for fragment in fragments if fragment not in message] == []
    assert sorted(folder.rglob("*")) == before


def test_every_experiment_is_a_program_of_its_own():
    packages = {file.parent.name for file in (REPOSITORY / "experiments").glob("*/__main__.py")}
    assert packages == set(EXPERIMENTS)
    for name in EXPERIMENTS:
        command = [sys.executable, "-m", f"experiments.{name}", "--help"]
        environment = os.environ | {"COLUMNS": "200"}
        done = subprocess.run(
            command, cwd=REPOSITORY, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        assert f"Usage: python -m experiments.{name} [OPTIONS]" in done.stdout


def test_the_readme_has_a_command_for_every_experiment():
    commands = re.findall(r"`experiments\.(\w+) (\S+)", README)
    assert {name for name, _ in commands} == set(EXPERIMENTS)
    own = [file for _, file in commands if not file.startswith(("../shared", "-"))]
    assert [file for file in own if not (REPOSITORY / file).is_file()] == []


def test_each_file_that_the_readme_links_to_exists():
    links = re.findall(r"\]\(([^)\s#]+)", README)
    assert {"paper", "../results/costs.csv", "../docs/paper.md"} <= set(links)
    assert [link for link in links if not (REPOSITORY / "experiments" / link).exists()] == []


def test_run_times_are_written_one_row_per_network(folder, monkeypatch, capfd):
    from experiments.speed import timing

    given = []
    row = timing.SpeedRow(
        network="densemapnet",
        parameters=290290,
        multiply_adds=8_410_000_000,
        eager_ms=400.0,
        eager_relative=1.0,
        onnx_ms=80.0,
        onnx_relative=1.0,
    )
    monkeypatch.setattr(timing, "measure_run_times", lambda recipe: given.append(recipe.name) or [row])
    assert run(f"speed {PAPER_RECIPE}") == 0
    assert given == ["experiment"]
    (written,) = read_rows("speed.csv")
    assert (written["network"], written["parameters"], written["eager_ms"]) == (
        "densemapnet",
        "290290",
        "400",
    )
    assert capfd.readouterr().out.endswith("rows: speed.csv\n")


def test_scores_by_world_are_written_and_printed_by_split(folder, monkeypatch, capfd):
    from experiments.paper_worlds import scoring

    given = []
    numbers = dict.fromkeys(scoring.WorldsRow.__annotations__, 2.5) | {"method": "tiny", "steps": 7}
    rows = [
        scoring.WorldsRow(**numbers | {"split": split, "pairs": pairs})
        for split, pairs in (("random", 3), ("disjoint", 5))
    ]
    monkeypatch.setattr(
        scoring, "score_worlds", lambda recipe, runs, most: given.append((recipe.name, runs)) or rows
    )
    assert run(f"paper_worlds {PAPER_RECIPE} tiny.pt") == 0
    assert given == [("experiment", [Path("tiny.pt")])]
    assert [(row["split"], row["epe_cm"]) for row in read_rows("worlds.csv")] == [
        ("random", "2.5"),
        ("disjoint", "2.5"),
    ]
    printed = capfd.readouterr().out
    assert "split random, 3 pairs" in printed and "split disjoint, 5 pairs" in printed
    assert printed.endswith("rows: worlds.csv\n")


@pytest.mark.parametrize(
    ("options", "extent", "trained"),
    [
        ("", Extent(seeds=2), [["unfinished"]]),
        (
            "--slow-steps 7 --only loss --only decoder",
            Extent(seeds=2, slow_steps=7, claims=["loss", "decoder"]),
            [["unfinished"]],
        ),
        ("--finished", Extent(seeds=2), []),
    ],
    ids=["all claims", "two claims", "what is finished"],
)
def test_the_papers_experiment_is_planned_trained_and_reported(
    folder, monkeypatch, capfd, options, extent, trained
):
    from experiments.paper import experiment, report

    done = []

    def plan(base, runs, asked, console):
        done.append(("plan", base.name, runs, asked))
        return ["finished", "unfinished"]

    monkeypatch.setattr(experiment, "plan", plan)
    monkeypatch.setattr(
        experiment, "run_trials", lambda *given, scored: done.append(("train", *given[:3], scored))
    )
    monkeypatch.setattr(report, "list_unfinished", lambda planned, runs, out: planned[1:])
    monkeypatch.setattr(
        report, "write_report", lambda base, *given: done.append(("report", base.name, *given))
    )
    assert run(f"paper {PAPER_RECIPE} -o runs --report results --seeds 2 --jobs 4 {options}") == 0
    runs, results = Path("runs"), Path("results")
    assert done == [
        ("plan", "experiment", runs, extent),
        *(("train", trials, runs, 4, True) for trials in trained),
        ("report", "experiment", ["finished", "unfinished"], runs, results),
    ]
    assert capfd.readouterr().out == "tables: results/paper.md\n"
