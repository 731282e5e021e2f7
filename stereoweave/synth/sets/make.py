"""Resumable rendering of sets of pairs in several processes."""

import hashlib
import json
import platform
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from importlib.metadata import version
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

from rich.console import Console

from stereoweave.arguments import check_choice
from stereoweave.data.packing import pack
from stereoweave.data.paper_layout import list_complete_frames, remove_unfinished, write_frame
from stereoweave.data.poses import POSES_FOLDER, write_poses
from stereoweave.data.shards import list_shards, write_shard
from stereoweave.errors import FormatError, StereoweaveError
from stereoweave.io.files import make_folder, reading, remove_leftovers, replacing
from stereoweave.io.images import SMALLEST_SIDE_PX
from stereoweave.io.output_lock import lock_output
from stereoweave.io.run_folder import check_claim, check_unclaimed, describe_run
from stereoweave.rendering.renderer import FIRST_POSITION, LAST_POSITION
from stereoweave.synth.sets.pair_rendering import RenderedPair, RenderSpec, draw_world_poses, render_pair
from stereoweave.synth.sets.renderers import shared_renderer
from stereoweave.synth.sets.workers import count_step, run_in_engine, run_in_workers
from stereoweave.system.ray_engine import Engine

SET_FILE = "set.json"
FORMAT = 1
# At 640x480, such a shard has 50 MB, enough to be read at full disk speed, and takes half a minute to make.
PAIRS_A_SHARD = 50
# Each frame has its own files, so runs can be short, which keeps every worker busy.
_FRAMES_A_RUN = 4
# The sample buffers of an image of this size take half a gigabyte.
_LARGEST_SIDE_PX = 4096
_EXCLUDED_SOURCES = {"make.py", "workers.py", "check.py", "contact_sheet.py", "effect_costs.py"}
_ADDED_SOURCES = ("stereo.py", "data/samples.py", "data/packing.py", "data/paper_layout.py", "data/poses.py")
# Embree's and OpenGL's versions are part of the renderer's name.
_PACKAGES = ("moderngl", "numpy", "opencv-python-headless", "pillow", "scikit-image")


@runtime_checkable
class PairMaker(Protocol):
    """Protocol for pair makers, which are pickled and sent to worker processes."""

    def renderer(self) -> str:
        """Return the renderer's name.

        The name, the spec and the generator version determine the bytes of a pair.
        """
        ...

    def __call__(self, spec: RenderSpec, index: int) -> RenderedPair: ...


@dataclass(frozen=True)
class PairRenderer:
    """A pair maker that uses this machine's best renderer; `plain` turns all effects off."""

    plain: bool = False

    def renderer(self) -> str:
        # Ask in a short-lived process, because a renderer needs a lot of memory.
        (name,) = run_in_workers(
            _renderer_name, [self.plain], 1, Console(quiet=True), "starting the renderer", 1
        )
        return f"{name}{', plain' if self.plain else ''}"

    def __call__(self, spec: RenderSpec, index: int) -> RenderedPair:
        return render_pair(shared_renderer(self.plain), spec, index)


class StorageFormat(NamedTuple):
    """A layout for storing pairs in a folder.

    Attributes:
        whole_pairs: Function that returns the indices of the complete pairs.
        write: Function that writes a run of pairs as they arrive.
        remove_unfinished: Function that deletes partly written files.
        pairs_a_run: Maximum number of pairs that a worker makes in one task; no run crosses a multiple of
            this number.
    """

    whole_pairs: Callable[[Path, RenderSpec], set[int]]
    write: Callable[[Path, RenderSpec, Sequence[int], Iterator[RenderedPair]], None]
    remove_unfinished: Callable[[Path], None]
    pairs_a_run: int


def make(  # noqa: PLR0913 - mirrors the command's options
    spec: RenderSpec,
    pairs: int,
    out: Path,
    *,
    layout: str = "shards",
    jobs: int = 1,
    engine: Engine | None = None,
    pair_maker: PairMaker = PairRenderer(),
    console: Console | None = None,
) -> int:
    """Make the missing pairs of a set of `pairs` pairs, and return how many were made.

    Args:
        spec: Specification of the pairs.
        pairs: Number of pairs in the finished set.
        out: Folder of a new set, or of a set to resume.
        layout: A name in LAYOUTS.
        jobs: Number of worker processes; it does not affect the bytes written.
        engine: Cluster to use instead of local processes; all its machines must see `out`. Using a cluster
            does not affect the bytes written. The tasks of killed workers are repeated.
        pair_maker: Maker of the pairs.
        console: Console that shows the progress.

    Raises:
        StereoweaveError: An argument is invalid; `out` holds another set, is in use or cannot be written; the
            disk is full; a worker was killed; or a machine does not see `out` or would make different pairs.
            Even then, the pairs already written are intact, and the same call resumes the work.
    """
    _check(spec, pairs, layout)
    make_folder(out)
    with lock_output(out):
        _claim(out, _set_facts(spec, layout, pair_maker), pairs)
        if spec.by_world:
            _write_world_poses(out, spec, pairs)
        runs = _split_into_runs(_missing_pairs(spec, pairs, out, layout), LAYOUTS[layout].pairs_a_run)
        missing = sum(map(len, runs))
        progress = console or Console(), f"making {spec.scene}", missing
        try:
            if engine is None:
                for _ in run_in_workers(
                    partial(_make_run, spec, out, layout, pair_maker), runs, jobs, *progress
                ):
                    pass
            else:
                # An absolute path, because the workers have a different working directory.
                run_in_engine(
                    partial(_prepare_node, spec, out.absolute(), layout, pair_maker), runs, engine, *progress
                )
                _check_shared(out, _missing_pairs(spec, pairs, out, layout))
        except StereoweaveError as error:
            raise error.with_detail(
                "all finished pairs are complete; rerun the same command to resume"
            ) from error
        finally:
            LAYOUTS[layout].remove_unfinished(out)
    return missing


def read_set(folder: Path) -> dict[str, Any]:
    """Read a set's description: spec, layout, generator, renderer and number of pairs.

    Raises:
        FormatError: The folder contains no set, a set of another format version, or a damaged description.
    """
    path = folder / SET_FILE
    with reading(path, "the description of a set made by stereoweave synth make"):
        facts = json.loads(path.read_text(encoding="utf-8"))
    if not (isinstance(facts, dict) and facts.get("format") == FORMAT):
        raise FormatError(
            f"{path}: expected a set of format {FORMAT}, found one made by another version of stereoweave; "
            "read it with that version, or make the set again"
        )
    _check_facts(path, facts)
    return facts


def generator_version() -> str:
    """Return a hash (8 hexadecimal digits) of the source files and package versions that determine a pair."""
    folder = Path(__file__).parents[1]
    sources = sorted(path for path in folder.rglob("*.*") if path.suffix != ".pyc" and path.is_file())
    sources = [path for path in sources if path.name not in _EXCLUDED_SOURCES]
    sources += [folder.parent / name for name in _ADDED_SOURCES]
    contents = [path.read_bytes() for path in sources]
    versions = [f"{package}=={version(package)}".encode() for package in _PACKAGES]
    return hashlib.sha256(b"".join(contents + versions)).hexdigest()[:8]


def _check_facts(path: Path, facts: dict[str, Any]) -> None:
    kinds = {"layout": str, "scene": str, "pairs": int}
    wrong = [name for name, kind in kinds.items() if type(facts.get(name)) is not kind]
    if not wrong and facts["layout"] not in LAYOUTS:
        wrong = ["layout"]
    if wrong:
        raise FormatError(
            f"{path}: expected a layout ({' or '.join(LAYOUTS)}), a scene and a number of pairs, "
            f"found {wrong[0]} = {json.dumps(facts.get(wrong[0]))}; restore the file, or make the set again"
        )


def _check(spec: RenderSpec, pairs: int, layout: str) -> None:
    check_choice("layout", layout, LAYOUTS)
    least = {"pairs": (pairs, 1), "seed": (spec.seed, 0), "frames": (spec.frames, 1)}
    for name, (value, smallest) in least.items():
        if value < smallest:
            raise StereoweaveError(f"expected at least {smallest}, found {value}", setting=name)
    width_px, height_px = spec.size_px
    if min(spec.size_px) < SMALLEST_SIDE_PX or max(spec.size_px) > _LARGEST_SIDE_PX:
        raise StereoweaveError(
            f"expected {SMALLEST_SIDE_PX} to {_LARGEST_SIDE_PX} px per side, found {width_px}x{height_px}",
            setting="size_px",
        )
    for position in spec.views:
        if not FIRST_POSITION <= position <= LAST_POSITION:
            raise StereoweaveError(
                f"expected positions from {FIRST_POSITION} to {LAST_POSITION} (0 is the left camera "
                f"and 1 the right one), found {position}",
                setting="views",
            )
    # Files are named by two decimals.
    rounded = [round(position, 2) for position in spec.views]
    if rounded != list(spec.views) or len({*rounded}) < len(rounded):
        raise StereoweaveError(
            f"expected different positions of at most two decimals, found {spec.views}",
            setting="views",
        )
    if layout == "paper" and spec.views:
        raise StereoweaveError(
            f"expected no additional views in the paper's layout, found {spec.views}; use the shards layout",
            setting="views",
        )


def _set_facts(spec: RenderSpec, layout: str, pair_maker: PairMaker) -> dict[str, Any]:
    facts = {"format": FORMAT, "layout": layout, **asdict(spec)}
    # Sets without worlds keep the description that they had before there were sets by world.
    if not facts["by_world"]:
        del facts["by_world"], facts["distance_m"]
    return facts | {"generator": generator_version(), "renderer": pair_maker.renderer()}


def _claim(out: Path, facts: dict[str, Any], pairs: int) -> None:
    """Write the set's description to claim the folder.

    Raises:
        StereoweaveError: The folder holds another set.
    """
    if (out / SET_FILE).exists():
        found = read_set(out)
        pairs = max(pairs, found.pop("pairs"))
        check_claim(out / SET_FILE, facts, found)
    else:
        check_unclaimed(out, SET_FILE, (path.name for path in out.iterdir() if path.name[0] != "."))
    LAYOUTS[facts["layout"]].remove_unfinished(out)
    with replacing(out / SET_FILE) as temporary:
        temporary.write_text(describe_run(facts | {"pairs": pairs}), encoding="utf-8")


def _write_world_poses(out: Path, spec: RenderSpec, pairs: int) -> None:
    """Write the missing poses of the worlds of `pairs` pairs."""
    for world in range(-(-pairs // spec.frames)):
        if not (out / POSES_FOLDER / f"{_world_name(spec, world)}.txt").exists():
            write_poses(out, _world_name(spec, world), draw_world_poses(spec, world))


def _missing_pairs(spec: RenderSpec, pairs: int, out: Path, layout: str) -> list[int]:
    return sorted(set(range(pairs)) - LAYOUTS[layout].whole_pairs(out, spec))


def _prepare_node(
    spec: RenderSpec, out: Path, layout: str, pair_maker: PairMaker
) -> Callable[[Sequence[int]], int]:
    """Check that this node sees the set and would make the same pairs; return a function that makes runs."""
    try:
        found = read_set(out)
        del found["pairs"]
        check_claim(out / SET_FILE, _set_facts(spec, layout, pair_maker), found)
    except StereoweaveError as error:
        raise StereoweaveError(
            f"{platform.node()}: {error}; all nodes of the cluster need the folder on a shared disk "
            "and the same versions of all packages"
        ) from error
    return partial(_make_run, spec, out, layout, pair_maker)


def _check_shared(out: Path, lacking: Sequence[int]) -> None:
    if lacking:
        raise StereoweaveError(
            f"{out}: expected all pairs that the cluster made, found {len(lacking)} of them missing; "
            "check that all nodes share the folder"
        )


def _split_into_runs(numbers: Sequence[int], most: int) -> list[list[int]]:
    """Split sorted numbers into runs of consecutive numbers; no run crosses a multiple of `most`."""
    places = enumerate(numbers)
    groups = groupby(places, key=lambda item: (item[1] - item[0], item[1] // most))
    return [[number for _, number in group] for _, group in groups]


def _make_run(spec: RenderSpec, out: Path, layout: str, pair_maker: PairMaker, run: Sequence[int]) -> int:
    def pairs() -> Iterator[RenderedPair]:
        for number in run:
            yield pair_maker(spec, number)
            count_step()

    LAYOUTS[layout].write(out, spec, run, pairs())
    return len(run)


def _write_shard(out: Path, spec: RenderSpec, run: Sequence[int], pairs: Iterator[RenderedPair]) -> None:
    packs = [pack(pair.sample, {place: shot.image for place, shot in pair.views}) for pair in pairs]
    write_shard(out, spec.scene, run[0], packs)


def _write_frames(out: Path, spec: RenderSpec, run: Sequence[int], pairs: Iterator[RenderedPair]) -> None:
    for number, pair in zip(run, pairs, strict=True):
        write_frame(out, _frame_name(spec, number), pair.sample)


def _pairs_in_shards(out: Path, spec: RenderSpec) -> set[int]:
    shards = list_shards(out, spec.scene)
    return {number for shard in shards for number in range(shard.first, shard.last + 1)}


def _pairs_in_frames(out: Path, spec: RenderSpec) -> set[int]:
    parts = (name.split("/") for name in list_complete_frames(out))
    places = [place for scene, *place in parts if scene == spec.scene and len(place) == 1 + spec.by_world]
    return {int(place[-1]) + (int(place[0]) * spec.frames if spec.by_world else 0) for place in places}


def _frame_name(spec: RenderSpec, number: int) -> str:
    if not spec.by_world:
        return f"{spec.scene}/{number:06d}"
    world, frame = divmod(number, spec.frames)
    return f"{_world_name(spec, world)}/{frame:06d}"


def _world_name(spec: RenderSpec, world: int) -> str:
    return f"{spec.scene}/{world:03d}"


def _tidy_frames(out: Path) -> None:
    remove_leftovers(out)
    remove_unfinished(out)


def _renderer_name(plain: bool) -> str:
    return shared_renderer(plain).name


LAYOUTS = {
    "shards": StorageFormat(_pairs_in_shards, _write_shard, remove_leftovers, PAIRS_A_SHARD),
    "paper": StorageFormat(_pairs_in_frames, _write_frames, _tidy_frames, _FRAMES_A_RUN),
}
