"""Tables of scores, printed to the console."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import typer

# Columns of the tables of stereoweave bench pairs, by title and heading.
PAIRS_TABLES = {
    "Errors, mean over the scenes": {
        "EPE px": "epe_px",
        "bad-1 %": "bad1_percent",
        "bad-2 %": "bad2_percent",
        "D1 %": "d1_percent",
        "edge EPE": "edge_epe_px",
        "edge bad-1": "edge_bad1_percent",
        "flying %": "flying_percent",
    },
    "Cost and confidence, mean over the scenes": {
        "ms": "time_ms",
        "x SGBM": "time_relative",
        "RAM MB": "memory_mb",
        "AUSE px": "ause_px",
        "AUSE %": "ause_bad1_percent",
        "calibr. error": "calibration_error",
    },
}

# Fields of the tables of stereoweave bench pairs --classes, by title; each table has a column per class.
CLASS_TABLES = {
    "Pixels by class, % of known pixels": "share_percent",
    "bad-1 by class, points that add up to bad-1": "bad1_percent",
    "bad-2 by class, points": "bad2_percent",
    "EPE within each class, px": "epe_px",
}

# Short enough for eight columns in 80 characters.
CLASS_HEADINGS = {"thin_or_edge": "edges", "weak_texture": "weak", "textured": "texture"}

# Columns of the tables of stereoweave bench flicker and views.
FLICKER_TABLES = {
    "Disparity and the middle view, mean over the scenes": {
        "flicker px": "flicker_px",
        "jumps": "jumps_share",
        "of the view": "view_flicker_levels",
        "bad-2 %": "bad2_percent",
        "ms": "time_ms",
    },
    "End-point error of the disparity in px, mean over the scenes": {
        "all": "epe_px",
        "moving": "moving_epe_px",
        "outline": "outline_epe_px",
        "uncovered": "uncovered_epe_px",
        "edges": "edge_epe_px",
        "thin": "thin_epe_px",
    },
}
VIEWS_TABLES = {
    "New views, PSNR in dB, mean over the scenes": {
        "all": "psnr_db",
        "smooth": "smooth_psnr_db",
        "edges": "edge_psnr_db",
        "one sees": "one_psnr_db",
        "neither": "neither_psnr_db",
        "ms": "time_ms",
    },
    "New views, mean absolute error in levels of 0..255, and SSIM": {
        "all": "mae",
        "smooth": "smooth_mae",
        "edges": "edge_mae",
        "one sees": "one_mae",
        "neither": "neither_mae",
        "SSIM": "ssim",
    },
}


def print_means(tables: Mapping[str, Mapping[str, str]], who: str, rows: Sequence[Any]) -> None:
    """Print rows in several tables, because a single table would be wider than a terminal.

    Args:
        tables: Fields of the rows, by title and column heading.
        who: Field that names a row.
        rows: Instances of the same dataclass.
    """
    from rich.console import Console
    from rich.table import Column, Table

    for title, columns in tables.items():
        numbers = (Column(name, justify="right") for name in columns)
        table = Table(Column(who, no_wrap=True), *numbers, title=title)
        for row in rows:
            cells = [getattr(row, field) for field in columns.values()]
            table.add_row(Path(getattr(row, who)).name, *map(_cell, cells))
        Console().print(table)


def print_classes(means: Sequence[Any]) -> None:
    """Print mean errors by class, with a row per matcher and a column per class."""
    from rich.console import Console
    from rich.table import Column, Table

    matchers = list(dict.fromkeys(row.matcher for row in means))
    names = list(dict.fromkeys(row.pixel_class for row in means))
    found = {(row.matcher, row.pixel_class): row for row in means}
    for title, field in CLASS_TABLES.items():
        headings = (Column(CLASS_HEADINGS.get(name, name), justify="right") for name in names)
        table = Table(Column("matcher", no_wrap=True), *headings, title=title)
        # The shares are the same for all matchers.
        rows = {"any": matchers[0]} if field == "share_percent" else {Path(m).name: m for m in matchers}
        for label, matcher in rows.items():
            table.add_row(label, *(_cell(getattr(found[matcher, name], field)) for name in names))
        Console().print(table)


def _cell(number: float) -> str:
    return "–" if math.isnan(number) else f"{number:.2f}"


def write_and_print(out: Path, title: str, rows: Sequence[Any]) -> None:
    """Write dataclass rows as CSV, and print them as a table, followed by the file's name."""
    from stereoweave.bench.tables import write_csv

    write_csv(out, rows)
    _print_rows(title, rows)
    typer.echo(f"rows: {out}")


def _print_rows(title: str, rows: Sequence[Any]) -> None:
    """Print dataclass rows as a table with the fields' names as headings. Long cells wrap."""
    from rich.console import Console
    from rich.table import Column, Table

    table = Table(*(Column(name, overflow="fold") for name in asdict(rows[0])), title=title)
    for row in rows:
        cells = asdict(row).values()
        table.add_row(*(f"{cell:.2f}" if isinstance(cell, float) else str(cell) for cell in cells))
    Console().print(table)
