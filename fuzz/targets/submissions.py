"""Archives of submissions to benchmarks, which `stereoweave bench submit --check` reads."""

import io
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np

from fuzz.targets import Target, read_every_way, write_to_bytes
from stereoweave.bench.submission_check import find_problems, read_method
from stereoweave.bench.submission_formats import Submission
from stereoweave.data.benchmarks import TEST, BenchmarkPair

_WIDTH_PX, _HEIGHT_PX = 12, 8
_NAMES = {"kitti2015": "000000_10", "middlebury_v3": "testQ/Plants", "eth3d": "lakeside_1l"}


def _make_submission(dataset: str) -> Submission:
    nowhere, size_px = Path("unused.png"), (_WIDTH_PX, _HEIGHT_PX)
    pair = BenchmarkPair(name=_NAMES[dataset], part=TEST, left=nowhere, right=nowhere, size_px=size_px)
    return Submission(dataset=dataset, pairs=[pair])


def _starts() -> dict[str, bytes]:
    return {f"{dataset}.zip": _pack(_make_submission(dataset)) for dataset in _NAMES}


def _pack(submission: Submission) -> bytes:
    (pair,) = submission.pairs
    written, form = io.BytesIO(), submission.format
    values = np.linspace(0, 30, _WIDTH_PX * _HEIGHT_PX, dtype=np.float32).reshape(_HEIGHT_PX, _WIDTH_PX)
    name = submission.map_file(pair)
    content = write_to_bytes(Path(name).name, lambda path: form.write_map(path, values))
    files: Mapping[str, bytes | str] = {name: content}
    if time_file := submission.time_file(pair):
        files = {**files, time_file: form.format_time(0.5)}
    with ZipFile(written, "w", ZIP_DEFLATED) as archive:
        for name, body in files.items():
            archive.writestr(name, body)
    return written.getvalue()


def _read(path: Path) -> None:
    read_every_way(*(partial(_check, path, dataset) for dataset in _NAMES))


def _check(path: Path, dataset: str) -> None:
    read_method(path, dataset)
    list(find_problems(path, _make_submission(dataset)))


TARGET = Target(
    starts=_starts,
    read=_read,
    tokens=(
        *(b"PK\x01\x02", b"PK\x03\x04", b"PK\x05\x06", b"PK\x06\x06", b"PK\x06\x07"),
        *b"disp_0/000000_10.png ../ IHDR IDAT Pf runtime inf nan".split(),
    ),
)
