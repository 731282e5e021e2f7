"""Matcher files that `stereoweave export` makes from a trained network or another matcher file."""

import shutil
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from stereoweave.errors import Remedy, StereoweaveError
from stereoweave.io.files import make_parent_folder, replacing
from stereoweave.learn import checkpoint
from stereoweave.learn.export.confidence import draw_reliability
from stereoweave.learn.export.fixed_size import check_size, fix_size
from stereoweave.learn.export.float16 import convert_to_float16
from stereoweave.learn.export.from_checkpoint import export_matcher
from stereoweave.learn.export.graph import write_card
from stereoweave.learn.export.int8 import quantise
from stereoweave.matching.matcher import Matcher, model_file, shipped_models
from stereoweave.stereo import StereoPair


@dataclass(frozen=True, kw_only=True)
class MatcherFiles:
    """Output files of an export; None for each variant that is not wanted.

    Attributes:
        out: The .onnx file in float32.
        half: The .onnx file in float16.
        eight_bits: The .onnx file with 8-bit convolutions.
        size: The only width and height that the files accept, or None if they accept any size.
    """

    out: Path | None = None
    half: Path | None = None
    eight_bits: Path | None = None
    size: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        if not self.paths:
            raise StereoweaveError(
                "export: expected an output file, found none",
                remedy=Remedy("give at least one", ("out", "half", "eight_bits")),
            )
        for file in self.paths:
            if file.suffix != ".onnx":
                raise StereoweaveError(
                    f"{file}: expected the file extension .onnx, found {file.suffix or 'none'}"
                )
        if len(set(self.paths)) < len(self.paths):
            raise StereoweaveError(
                f"{self.paths[0]}: expected a different file for each variant, found the same file twice"
            )

    @property
    def paths(self) -> list[Path]:
        return [file for file in (self.out, self.half, self.eight_bits) if file]


def write_matcher_files(
    source: str, files: MatcherFiles, pairs: Iterable[StereoPair] = (), reliability: Path | None = None
) -> Iterator[str]:
    """Write the matcher files and yield a note about each.

    Args:
        source: Run folder, checkpoint, shipped model, or float32 matcher file for pairs of any size.
        files: The files to write.
        pairs: Pairs on which ONNX Runtime and PyTorch must agree; used only for a trained network.
        reliability: File for a reliability diagram of the confidence; used only for a trained network.
    """
    for file in files.paths:
        make_parent_folder(file)
    with tempfile.TemporaryDirectory() as folder:
        if is_matcher(source):
            made = model_file(source)
            _check_apart(made, files)
        elif not Path(source).exists():
            raise StereoweaveError(
                f"{source}: expected a run's folder, a checkpoint, an .onnx matcher file or a shipped "
                f"network ({', '.join(shipped_models())}), found none of them"
            )
        else:
            made = Path(folder, "any_size.onnx")
            yield _export_run(Path(source), made, pairs, reliability)
        if files.size:
            check_size(*files.size, Matcher(made).multiple_of)
        yield from _write_variants(made, files)


def write_weights(run: Path, out: Path) -> str:
    """Write a run's averaged weights in half precision, for recipes to start from. Returns a note.

    Args:
        run: Folder of a run, or a checkpoint.
        out: The .pt file to write.

    Raises:
        StereoweaveError: `run` has no checkpoint, or `out` does not end in .pt.
    """
    if out.suffix != ".pt":
        raise StereoweaveError(f"{out}: expected the file extension .pt, found {out.suffix or 'none'}")
    kept = checkpoint.load(run / "last.pt" if run.is_dir() else run)
    make_parent_folder(out)
    checkpoint.save(checkpoint.strip_to_average(kept), out)
    return f"{out}: averaged weights after {kept.step} steps, in 16 bits"


def is_matcher(source: str) -> bool:
    """Return whether an export's source is a matcher file or shipped model rather than a trained network."""
    return source.endswith(".onnx") or source in shipped_models()


def _export_run(run: Path, made: Path, pairs: Iterable[StereoPair], reliability: Path | None) -> str:
    card = export_matcher(run, made, pairs)
    if reliability and "confidence" in card:
        draw_reliability(card["confidence"], reliability)
    return (
        f"{run}: ONNX Runtime and PyTorch differ by at most {card['onnx_differs_px']:.4f} px "
        f"over {card['compared_pairs']} pairs"
    )


def _write_variants(made: Path, files: MatcherFiles) -> Iterator[str]:
    if files.out:
        _copy(made, files.out)
        yield f"{files.out}: float32"
    if files.half:
        change_px = convert_to_float16(made, files.half)["differs_px_from_32_bits"]
        yield f"{files.half}: 16 bits change disparity by {change_px:.4f} px on average"
    if files.eight_bits:
        card = quantise(made, files.eight_bits)
        lost_px = card["epe_px"] - card["epe_px_of_32_bits"]
        yield f"{files.eight_bits}: 8 bits change the mean error by {lost_px:+.3f} px"
    if files.size:
        for file in files.paths:
            fix_size(file, file, *files.size)
            yield f"{file}: only for pairs of {files.size[0]}x{files.size[1]}"


def _check_apart(source: Path, files: MatcherFiles) -> None:
    for file in files.paths:
        if file.resolve() == source.resolve():
            raise StereoweaveError(
                f"{file}: expected an output file other than the source, found the source itself"
            )


def _copy(source: Path, out: Path) -> None:
    with replacing(out) as temporary:
        shutil.copyfile(source, temporary)
    write_card(source, out, {})
