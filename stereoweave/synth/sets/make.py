"""Sets of rendered pairs on disk, made by several processes; one that was stopped goes on where it was."""

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

from stereoweave.data.packing import packed
from stereoweave.data.paper_layout import remove_unfinished, whole_frames, write_frame
from stereoweave.data.shards import list_shards, write_shard
from stereoweave.errors import FormatError, StereoweaveError
from stereoweave.io.files import SMALLEST_SIDE_PX, make_folder, reading, remove_leftovers, replacing
from stereoweave.io.output_lock import lock_output
from stereoweave.io.run_folder import check_claim, check_unclaimed, description
from stereoweave.rendering.renderer import FIRST_POSITION, LAST_POSITION
from stereoweave.synth.sets.pair_rendering import RenderedPair, RenderSpec, render_pair
from stereoweave.synth.sets.renderers import shared_renderer
from stereoweave.synth.sets.workers import count_step, run_in_engine, run_in_workers
from stereoweave.system.ray_engine import Engine

SET_FILE = "set.json"
FORMAT = 1
# 50 MB of 640x480: enough to read at the disk's full speed, and half a minute's work to lose.
PAIRS_A_SHARD = 50
# Frames have files of their own, so that a worker's run may be short, and no worker be without one.
_FRAMES_A_RUN = 4
# Colour and depth of the samples of such a picture take half a gigabyte.
_LARGEST_SIDE_PX = 4096
_NOT_OF_THE_PAIRS = {"make.py", "workers.py", "check.py", "contact_sheet.py", "effect_costs.py"}
_OF_THE_PAIRS_TOO = ("stereo.py", "data/samples.py", "data/packing.py", "data/paper_layout.py")
# What casts the rays, or draws the triangles, is in the renderer's name.
_PACKAGES = ("moderngl", "numpy", "opencv-python-headless", "pillow", "scikit-image")


@runtime_checkable
class PairMaker(Protocol):
    """What makes pairs, in whichever process it is sent to."""

    def renderer(self) -> str:
        """What decides the bytes of a pair besides the order and the generator's version."""
        ...

    def __call__(self, spec: RenderSpec, index: int) -> RenderedPair: ...


@dataclass(frozen=True)
class PairRenderer:
    """Makes pairs with the best renderer that this machine has; `plain` leaves every effect out."""

    plain: bool = False

    def renderer(self) -> str:
        # In a process that ends at once: a renderer takes more memory than all else here.
        (name,) = run_in_workers(
            _renderer_name, [self.plain], 1, Console(quiet=True), "starting the renderer", 1
        )
        return f"{name}{', plain' if self.plain else ''}"

    def __call__(self, spec: RenderSpec, index: int) -> RenderedPair:
        return render_pair(shared_renderer(self.plain), spec, index)


class Layout(NamedTuple):
    """A way to lay pairs out in a folder.

    Attributes:
        whole_pairs: the numbers of a scene's pairs that are whole.
        write: writes pairs of these numbers as they come.
        remove_unfinished: removes what was not written to the end.
        pairs_a_run: how many pairs one worker makes at a time; no run reaches past a multiple of it.
    """

    whole_pairs: Callable[[Path, str], set[int]]
    write: Callable[[Path, str, Sequence[int], Iterator[RenderedPair]], None]
    remove_unfinished: Callable[[Path], None]
    pairs_a_run: int


def make(  # noqa: PLR0913 - each is a word of the command line
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
    """How many pairs were made to have the first `pairs` of an order in a folder; the others were there.

    Args:
        spec: Scene, seed, size and so on.
        pairs: How many there shall be.
        out: The folder, new or with the same set.
        layout: A name in LAYOUTS.
        jobs: Processes at a time; the bytes do not depend on it.
        engine: Where the pairs are made instead; all its machines have to see `out`, and the bytes do not
            depend on it either. What a killed worker was making is made again.
        pair_maker: What makes the pairs.
        console: Where the progress is shown.

    Raises:
        StereoweaveError: Nonsense was asked for, `out` has another set in it, is in use or cannot be written,
            the disk is full, a worker was killed, or a machine does not see `out` or would make other pairs.
            All that is there then is whole, and the same call goes on.
    """
    _check(spec, pairs, layout)
    make_folder(out)
    with lock_output(out):
        _claim(out, _set_facts(spec, layout, pair_maker), pairs)
        runs = _split_into_runs(_missing_pairs(spec, pairs, out, layout), LAYOUTS[layout].pairs_a_run)
        missing = sum(map(len, runs))
        told = console or Console(), f"making {spec.scene}", missing
        try:
            if engine is None:
                for _ in run_in_workers(partial(_make_run, spec, out, layout, pair_maker), runs, jobs, *told):
                    pass
            else:
                # Absolute, because its workers have another current folder.
                run_in_engine(
                    partial(_prepare_node, spec, out.absolute(), layout, pair_maker), runs, engine, *told
                )
                _check_shared(out, _missing_pairs(spec, pairs, out, layout))
        except StereoweaveError as error:
            raise StereoweaveError(
                f"{error}; what is there is whole, and the same command goes on"
            ) from error
        finally:
            LAYOUTS[layout].remove_unfinished(out)
    return missing


def read_set(folder: Path) -> dict[str, Any]:
    """What is written about a set: its order, its layout, what made it, and how many pairs were asked for.

    Raises:
        FormatError: There is no set in the folder, one in another version's format, or a damaged description.
    """
    path = folder / SET_FILE
    with reading(path, "the description of a set that stereoweave synth make made"):
        facts = json.loads(path.read_text(encoding="utf-8"))
    if not (isinstance(facts, dict) and facts.get("format") == FORMAT):
        raise FormatError(
            f"{path}: expected a set of format {FORMAT}, found one that another version of stereoweave made; "
            "read it with that one, or make it anew"
        )
    _check_facts(path, facts)
    return facts


def generator_version() -> str:
    """8 hexadecimal digits that change with the code that makes pairs, and with the packages it uses."""
    folder = Path(__file__).parents[1]
    sources = sorted(path for path in folder.rglob("*.*") if path.suffix != ".pyc" and path.is_file())
    sources = [path for path in sources if path.name not in _NOT_OF_THE_PAIRS]
    sources += [folder.parent / name for name in _OF_THE_PAIRS_TOO]
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
            f"{path}: expected layout ({' or '.join(LAYOUTS)}), scene and number of pairs as written, "
            f"found {wrong[0]} = {json.dumps(facts.get(wrong[0]))}; put back the file, or make the set anew"
        )


def _check(spec: RenderSpec, pairs: int, layout: str) -> None:
    if layout not in LAYOUTS:
        raise StereoweaveError(f"layout: expected one of {', '.join(LAYOUTS)}, found {layout!r}")
    least = {"pairs": (pairs, 1), "seed": (spec.seed, 0), "frames": (spec.frames, 1)}
    for name, (value, smallest) in least.items():
        if value < smallest:
            raise StereoweaveError(f"{name}: expected at least {smallest}, found {value}")
    width_px, height_px = spec.size_px
    if min(spec.size_px) < SMALLEST_SIDE_PX or max(spec.size_px) > _LARGEST_SIDE_PX:
        raise StereoweaveError(
            f"--size: expected {SMALLEST_SIDE_PX} to {_LARGEST_SIDE_PX} px a side, "
            f"found {width_px}x{height_px}"
        )
    for position in spec.views:
        if not FIRST_POSITION <= position <= LAST_POSITION:
            raise StereoweaveError(
                f"view: expected positions of {FIRST_POSITION} (0 is the left camera, 1 the right one) "
                f"to {LAST_POSITION}, found {position}"
            )
    names = {f"{position:.2f}" for position in spec.views}
    if len(names) < len(spec.views):
        raise StereoweaveError(
            f"view: expected positions that differ in their first two decimals, found {spec.views}"
        )
    if layout == "paper" and spec.views:
        raise StereoweaveError(f"view: expected none in the paper's layout, found {spec.views}; take shards")


def _set_facts(spec: RenderSpec, layout: str, pair_maker: PairMaker) -> dict[str, Any]:
    facts = {"format": FORMAT, "layout": layout, **asdict(spec)}
    return facts | {"generator": generator_version(), "renderer": pair_maker.renderer()}


def _claim(out: Path, facts: dict[str, Any], pairs: int) -> None:
    """Writes down whose folder this is, or refuses one that is another's."""
    if (out / SET_FILE).exists():
        found = read_set(out)
        pairs = max(pairs, found.pop("pairs"))
        check_claim(out / SET_FILE, facts, found)
    else:
        check_unclaimed(out, SET_FILE, (path.name for path in out.iterdir() if path.name[0] != "."))
    LAYOUTS[facts["layout"]].remove_unfinished(out)
    with replacing(out / SET_FILE) as temporary:
        temporary.write_text(description(facts | {"pairs": pairs}), encoding="utf-8")


def _missing_pairs(spec: RenderSpec, pairs: int, out: Path, layout: str) -> list[int]:
    return sorted(set(range(pairs)) - LAYOUTS[layout].whole_pairs(out, spec.scene))


def _prepare_node(
    spec: RenderSpec, out: Path, layout: str, pair_maker: PairMaker
) -> Callable[[Sequence[int]], int]:
    """What makes runs of the set here; StereoweaveError where it is not seen, or would become another."""
    try:
        found = read_set(out)
        del found["pairs"]
        check_claim(out / SET_FILE, _set_facts(spec, layout, pair_maker), found)
    except StereoweaveError as error:
        raise StereoweaveError(
            f"{platform.node()}: {error}; all nodes of a cluster need the folder on a disk that they share, "
            "and the same versions of all"
        ) from error
    return partial(_make_run, spec, out, layout, pair_maker)


def _check_shared(out: Path, lacking: Sequence[int]) -> None:
    if lacking:
        raise StereoweaveError(
            f"{out}: expected all pairs that the cluster made, found {len(lacking)} of them missing; "
            "do all its nodes share the disk?"
        )


def _split_into_runs(numbers: Sequence[int], most: int) -> list[list[int]]:
    """Sorted numbers in runs without a gap, none of which reaches past a multiple of `most`."""
    places = enumerate(numbers)
    groups = groupby(places, key=lambda item: (item[1] - item[0], item[1] // most))
    return [[number for _, number in group] for _, group in groups]


def _make_run(spec: RenderSpec, out: Path, layout: str, pair_maker: PairMaker, run: Sequence[int]) -> int:
    def pairs() -> Iterator[RenderedPair]:
        for number in run:
            yield pair_maker(spec, number)
            count_step()

    LAYOUTS[layout].write(out, spec.scene, run, pairs())
    return len(run)


def _write_shard(out: Path, scene: str, run: Sequence[int], pairs: Iterator[RenderedPair]) -> None:
    packs = [packed(pair.sample, {place: shot.image for place, shot in pair.views}) for pair in pairs]
    write_shard(out, scene, run[0], packs)


def _write_frames(out: Path, scene: str, run: Sequence[int], pairs: Iterator[RenderedPair]) -> None:
    for number, pair in zip(run, pairs, strict=True):
        write_frame(out, f"{scene}/{number:06d}", pair.sample)


def _pairs_in_shards(out: Path, scene: str) -> set[int]:
    return {number for shard in list_shards(out, scene) for number in range(shard.first, shard.last + 1)}


def _pairs_in_frames(out: Path, scene: str) -> set[int]:
    names = (name.rpartition("/") for name in whole_frames(out))
    return {int(number) for folder, _, number in names if folder == scene}


def _tidy_frames(out: Path) -> None:
    remove_leftovers(out)
    remove_unfinished(out)


def _renderer_name(plain: bool) -> str:
    return shared_renderer(plain).name


LAYOUTS = {
    "shards": Layout(_pairs_in_shards, _write_shard, remove_leftovers, PAIRS_A_SHARD),
    "paper": Layout(_pairs_in_frames, _write_frames, _tidy_frames, _FRAMES_A_RUN),
}
