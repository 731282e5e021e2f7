"""Train a network for a fixed time on a GPU; recipes/gpu/README.md has the commands.

Only the standard library is imported until the machine is checked. Painting processes import nothing again.
"""

import argparse
import importlib
import os
import sys
import time
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

BEGAN_S = time.monotonic()
# Flushed, so that a killed command leaves its output.
say = partial(print, flush=True)
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

# Module, the names it is installed under, and the oldest supported version.
NEEDS = (
    ("numpy", ("numpy",), (2, 0)),
    ("cv2", ("opencv-python-headless", "opencv-python", "opencv-contrib-python-headless"), (4, 11)),
    ("numba", ("numba",), (0, 61)),
    ("jaxtyping", ("jaxtyping",), (0, 2)),
    ("PIL", ("pillow",), (9, 0)),
    ("yaml", ("pyyaml",), (5, 0)),
    ("pydantic", ("pydantic",), (2, 10)),
    ("rich", ("rich",), (13, 0)),
    ("skimage", ("scikit-image",), (0, 22)),
    ("torch", ("torch",), (2, 4)),
)


def main() -> int:
    """Check the machine, train, and return the exit status."""
    options = _options()
    say(f"Python {sys.version.split()[0]}, {os.cpu_count()} processors, code {Path(__file__).parents[2]}")
    if problems := [problem for problem in map(_problem, NEEDS) if problem]:
        say("\n".join(problems), file=sys.stderr)
        return 2
    from stereoweave.errors import StereoweaveError

    try:
        _train(options)
    except StereoweaveError as error:
        say(f"error: {error}", file=sys.stderr)
        return 1
    return 0


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, allow_abbrev=False)
    parser.add_argument("recipe", type=Path)
    parser.add_argument("--out", type=Path, required=True, help="output folder, to copy back")
    parser.add_argument("--earlier", type=Path, help="folder with an earlier command's files")
    parser.add_argument("--minutes", type=float, default=8.7, help="time limit of this command")
    parser.add_argument("--total-minutes", type=float, default=26.0, help="time limit of all commands")
    parser.add_argument(
        "--processes", type=int, help="painting processes; default: 14, fewer on small machines"
    )
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--batch", type=int, help="pairs per step; default: the recipe's")
    parser.add_argument(
        "--cool-down-crop",
        type=int,
        nargs=2,
        metavar=("HEIGHT", "WIDTH"),
        help="crop size during the cool-down",
    )
    parser.add_argument("--commit", default="", help="commit of the code, for a machine without git")
    return parser.parse_args()


def _problem(need: tuple[str, tuple[str, ...], tuple[int, int]]) -> str:
    """Import a library. Returns what is wrong with it in one line, or ''."""
    module, names, least = need
    wanted = f"{names[0]} {least[0]}.{least[1]} or later"
    try:
        importlib.import_module(module)
    except Exception as error:  # a broken installation may raise any type of error
        return f"{module}: expected {wanted}, found {type(error).__name__}: {error}; install its wheel"
    found = next((have for name in names if (have := _version(name))), "")
    say(f"{module} {found or 'of unknown version'}")
    if found and tuple(int(part) for part in found.split(".")[:2]) < least:
        return f"{module}: expected {wanted}, found {found}; install its wheel"
    return ""


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return ""


def _train(options: argparse.Namespace) -> None:
    from dataclasses import replace

    import torch

    from stereoweave.errors import StereoweaveError
    from stereoweave.learn.recipe import read_recipe
    from stereoweave.learn.training.timed import TimedCommand, train_by_clock
    from stereoweave.system.threads import usable_cores

    recipe = read_recipe(options.recipe)
    if options.batch:
        recipe = replace(recipe, batch=options.batch)
    if options.device == "cuda":
        if not torch.cuda.is_available():
            raise StereoweaveError(
                "--device cuda: expected a GPU, found none; use --device cpu for a rehearsal on the CPU"
            )
        torch.backends.cudnn.benchmark = True
        properties = torch.cuda.get_device_properties(0)
        say(f"{properties.name}, {properties.total_memory / 2**30:.0f} GiB, CUDA {torch.version.cuda}")
    command = TimedCommand(
        out=options.out,
        earlier=options.earlier,
        began_s=BEGAN_S,
        minutes=options.minutes,
        total_minutes=options.total_minutes,
        device=options.device,
        processes=options.processes or max(1, min(14, usable_cores() - 2)),
        cool_down_crop=options.cool_down_crop and tuple(options.cool_down_crop),
        commit=options.commit,
    )
    say(f"{command.processes} painting processes; {time.monotonic() - BEGAN_S:.0f} s used so far")
    try:
        train_by_clock(recipe, command, say)
    except torch.cuda.OutOfMemoryError as error:
        raise StereoweaveError(f"--batch {recipe.batch}: {error}; use a smaller batch") from error
    if options.device == "cuda":
        say(f"at most {torch.cuda.max_memory_allocated() / 2**30:.1f} GiB of GPU memory used")


if __name__ == "__main__":
    sys.exit(main())
