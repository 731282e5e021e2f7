"""Scores of a training on all its held-out pairs, kept in its folder for later reports."""

import json
from dataclasses import asdict
from pathlib import Path

from rich.console import Console

from stereoweave.bench.projected_views import ProjectionRow
from stereoweave.io.files import replacing
from stereoweave.learn import checkpoint
from stereoweave.learn.evaluation import make_method, score_methods

_FILE = "held_out.json"


def score_run(run: Path, pairs: Path) -> ProjectionRow:
    """Return the scores of a run's last checkpoint, computed once for each number of steps.

    Args:
        run: Folder of the run, whose name becomes the row's method.
        pairs: Cache folder of collage pairs.
    """
    trained = checkpoint.load(run / "last.pt")
    file = run / _FILE
    if file.exists():
        found = json.loads(file.read_text(encoding="utf-8"))
        if found["step"] == trained.step:
            return ProjectionRow(**found["row"])
    rows = score_methods(trained.recipe, {run.name: make_method(trained)}, pairs, Console(quiet=True))
    row = next(row for row in rows if row.method == run.name)
    with replacing(file) as temporary:
        temporary.write_text(json.dumps({"step": trained.step, "row": asdict(row)}) + "\n", encoding="utf-8")
    return row
