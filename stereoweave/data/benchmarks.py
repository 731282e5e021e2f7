"""Pairs of public benchmarks whose ground truth is kept by their sites, from the unpacked downloads."""

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from stereoweave.arguments import check_choice
from stereoweave.data.frames import list_scene_folders, match_files, require_folder
from stereoweave.errors import FormatError, Note, Remedy, StereoweaveError
from stereoweave.io.decoding import open_picture
from stereoweave.io.files import read_small, reading

TEST, TRAINING = "test", "training"
RESOLUTIONS = {"F": "full", "H": "half", "Q": "quarter"}
"""Middlebury's letters for the sizes of its pictures, which end the names of its folders."""

_NDISP = re.compile(r"^ndisp\s*=\s*(\S+)\s*$", re.MULTILINE)
# Names become names of files in an archive.
_NAME = re.compile(r"[A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+)?")
_NUMBER = re.compile(r"[1-9][0-9]{0,5}")


@dataclass(frozen=True, kw_only=True)
class BenchmarkPair:
    """A pair of a benchmark, whose pictures are read on request.

    Attributes:
        name: Unique name: 000000_10 in KITTI, trainingH/Adirondack in Middlebury, forest_1s in ETH3D.
        part: `TEST` or `TRAINING`.
        left: Path of the left picture.
        right: Path of the right picture.
        size_px: Width and height of both pictures.
        range_px: Least and greatest disparity that the benchmark publishes; None if it publishes none.
    """

    name: str
    part: str
    left: Path
    right: Path
    size_px: tuple[int, int]
    range_px: tuple[float, float] | None = None


@dataclass(frozen=True, kw_only=True)
class Choice:
    """Which of a benchmark's pairs to list.

    Attributes:
        training_only: Leave out the test pairs.
        resolution: A letter of `RESOLUTIONS`; default: the only one in the folder.
    """

    training_only: bool = False
    resolution: str | None = None

    @property
    def parts(self) -> tuple[str, ...]:
        """The parts of a benchmark that has both, in their order in a submission."""
        return (TRAINING,) if self.training_only else (TRAINING, TEST)


EVERY_PAIR = Choice()


@dataclass(frozen=True, kw_only=True)
class Benchmark:
    """A benchmark and the layout of its unpacked downloads.

    Attributes:
        title: Name for users.
        folders: Folders of the download, at least one of which distinguishes it from other benchmarks.
        published: Number of pairs of each part.
        list_pairs: Function that lists the pairs in a folder.
    """

    title: str
    folders: tuple[str, ...]
    published: Mapping[str, int]
    list_pairs: Callable[[Path, Choice], Iterator[BenchmarkPair]]


def find_benchmark(root: str | Path, dataset: str | None = None) -> str:
    """Return the name in `BENCHMARKS` of the benchmark that a folder contains.

    Args:
        root: Folder of the unpacked archives.
        dataset: The name, if known; then the folder is not examined.

    Raises:
        StereoweaveError: The name is unknown, or the folder contains no benchmark or several.
    """
    if dataset is not None:
        check_choice("dataset", dataset, BENCHMARKS)
        return dataset
    folder = require_folder(Path(root))
    found = [
        name
        for name, benchmark in BENCHMARKS.items()
        if any((folder / part).is_dir() for part in benchmark.folders)
    ]
    if len(found) == 1:
        return found[0]
    if found:
        raise StereoweaveError(
            f"{root}: expected the pictures of one benchmark, found those of {' and '.join(found)}",
            remedy=Remedy("choose one", ("dataset",)),
        )
    expected = " or ".join(benchmark.folders[0] for benchmark in BENCHMARKS.values())
    raise StereoweaveError(
        f"{root}: expected the unpacked archives of a benchmark, with the folder {expected}, "
        "found none of them"
    )


def list_benchmark(root: str | Path, dataset: str, choice: Choice = EVERY_PAIR) -> list[BenchmarkPair]:
    """List the pairs of a benchmark, given the folder of its unpacked archives.

    The headers of all pictures are read, so that a missing file is found before the first pair is matched.

    Raises:
        StereoweaveError: The choice is not possible for this benchmark, a folder is missing, or there are no
            pairs.
        FormatError: A picture or a calibration is missing or damaged, or the sizes of a pair differ.
    """
    benchmark = BENCHMARKS[dataset]
    if choice.training_only and TRAINING not in benchmark.published:
        raise StereoweaveError(
            f"cannot be combined with {dataset}, whose submissions contain test pairs only",
            setting="training_only",
        )
    if choice.resolution is not None and dataset != "middlebury_v3":
        raise StereoweaveError(
            f"cannot be combined with {dataset}, whose pictures have one size", setting="resolution"
        )
    pairs = list(benchmark.list_pairs(Path(root), choice))
    if not pairs:
        raise StereoweaveError(f"{root}: expected the unpacked archives of {benchmark.title}, found no pairs")
    return pairs


def describe_missing_pairs(dataset: str, pairs: list[BenchmarkPair]) -> list[Note]:
    """Return a note for each part of which fewer or more pairs are listed than the benchmark has."""
    counts = {part: sum(pair.part == part for pair in pairs) for part in (TRAINING, TEST)}
    benchmark = BENCHMARKS[dataset]
    return [
        Note(
            f"{benchmark.title} has {benchmark.published[part]} {part} pairs, found {found}; the site will "
            "not accept the submission"
        )
        for part, found in counts.items()
        if found and found != benchmark.published[part]
    ]


def _list_kitti(root: Path, left: str, right: str) -> Iterator[BenchmarkPair]:
    folders = (root / "testing" / name for name in (left, right))
    # The pictures of the next time step, _11, are for optical flow.
    for name, files in match_files(*folders, ending="_10").items():
        yield _open_pair(name, TEST, *files)


def _list_kitti2012(root: Path, _: Choice) -> Iterator[BenchmarkPair]:
    """List the grey pairs: the ground truth is for the grey cameras."""
    return _list_kitti(root, "image_0", "image_1")


def _list_kitti2015(root: Path, _: Choice) -> Iterator[BenchmarkPair]:
    return _list_kitti(root, "image_2", "image_3")


def _list_middlebury(root: Path, choice: Choice) -> Iterator[BenchmarkPair]:
    """List the scenes of MiddEval3/trainingH and testH, or of another size."""
    base = root / "MiddEval3" if (root / "MiddEval3").is_dir() else root
    resolution = _find_resolution(base, choice.resolution)
    for part in choice.parts:
        folder = base / f"{part}{resolution}"
        for scene in list_scene_folders(folder):
            yield _open_scene(f"{folder.name}/{scene.name}", part, scene)


def _find_resolution(base: Path, chosen: str | None) -> str:
    if chosen is not None:
        check_choice("resolution", chosen, RESOLUTIONS)
    found = [
        letter
        for letter in RESOLUTIONS
        if any((base / f"{part}{letter}").is_dir() for part in (TEST, TRAINING))
    ]
    if chosen is not None:
        return chosen
    if not found:
        raise StereoweaveError(
            f"{base}: expected pictures of one resolution, found none; unpack MiddEval3's archives there"
        )
    if len(found) > 1:
        raise StereoweaveError(
            f"{base}: expected pictures of one resolution, found {' and '.join(found)}",
            remedy=Remedy("choose one", ("resolution",)),
        )
    return found[0]


def _list_eth3d(root: Path, choice: Choice) -> Iterator[BenchmarkPair]:
    """List the scenes of two_view_training and two_view_test."""
    for part in choice.parts:
        for scene in list_scene_folders(root / f"two_view_{part}"):
            yield _open_scene(scene.name, part, scene)


def _open_scene(name: str, part: str, scene: Path) -> BenchmarkPair:
    """Open a scene's folder with im0.png, im1.png and calib.txt."""
    return _open_pair(name, part, scene / "im0.png", scene / "im1.png", scene / "calib.txt")


def _open_pair(
    name: str, part: str, left: Path, right: Path, calibration: Path | None = None
) -> BenchmarkPair:
    if not _NAME.fullmatch(name):
        raise FormatError(f"{left}: expected a name of letters, digits, '.', '-' and '_', found {name!a:.60}")
    size_px, right_size_px = (_read_size(path) for path in (left, right))
    if size_px != right_size_px:
        raise FormatError(
            f"{right}: expected {size_px[0]}x{size_px[1]} pixels, the size of the left picture, "
            f"found {right_size_px[0]}x{right_size_px[1]}"
        )
    range_px = None if calibration is None else _read_range(calibration)
    return BenchmarkPair(name=name, part=part, left=left, right=right, size_px=size_px, range_px=range_px)


def _read_size(path: Path) -> tuple[int, int]:
    with open_picture(path) as picture:
        return picture.size


def _read_range(path: Path) -> tuple[float, float]:
    """Return the disparity range that a calibration in Middlebury's format publishes.

    The entry ndisp is a conservative bound on the number of disparity levels; methods may search from 0 to
    ndisp - 1 (the benchmark's description of calib.txt).
    """
    with reading(path, "a calibration with ndisp"):
        entry = _NDISP.search(read_small(path).decode(errors="replace"))
    found = entry[1] if entry else "no such entry"
    if entry is None or not _NUMBER.fullmatch(found) or int(found) < 2:
        raise FormatError(f"{path}: expected ndisp, a whole number of at least 2, found {found:.40}")
    return 0.0, float(int(found) - 1)


BENCHMARKS = {
    "kitti2012": Benchmark(
        title="KITTI 2012",
        folders=("testing/image_0",),
        published={TEST: 195},
        list_pairs=_list_kitti2012,
    ),
    "kitti2015": Benchmark(
        title="KITTI 2015",
        folders=("testing/image_2",),
        published={TEST: 200},
        list_pairs=_list_kitti2015,
    ),
    "middlebury_v3": Benchmark(
        title="Middlebury v3",
        folders=("MiddEval3", *(f"{part}{letter}" for part in (TEST, TRAINING) for letter in RESOLUTIONS)),
        published={TRAINING: 15, TEST: 15},
        list_pairs=_list_middlebury,
    ),
    "eth3d": Benchmark(
        title="ETH3D two-view",
        folders=("two_view_test", "two_view_training"),
        published={TRAINING: 27, TEST: 20},
        list_pairs=_list_eth3d,
    ),
}
"""Benchmarks by the name of their dataset."""
