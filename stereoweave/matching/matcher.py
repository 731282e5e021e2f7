"""Matching with a shipped network or any matcher file, using ONNX Runtime.

A matcher file (docs/architecture.md) has the inputs `left` and `right`, float32 [B, 3, H, W] in 0..1, the
output `disparity_px`, and the optional outputs `right_disparity_px` and `confidence_logit`.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from stereoweave.arguments import check_kind, suggest
from stereoweave.errors import MatcherError, StereoweaveError
from stereoweave.io.images import SMALLEST_SIDE_PX
from stereoweave.matching.contrast import measure_contrast
from stereoweave.matching.edge_vote.vote import sharpen_edges, vote_at_edges
from stereoweave.matching.left_right_check import (
    at_match,
    find_contradicted,
    is_occluded,
    measure_disagreement,
)
from stereoweave.matching.network import Network
from stereoweave.matching.occlusion_fill import fill_occluded
from stereoweave.matching.options import MatchOptions
from stereoweave.matching.providers import CPU, PROVIDERS
from stereoweave.matching.refine import NARROW, WIDE, refine
from stereoweave.matching.streaks import smooth_streaks
from stereoweave.matching.subpixel import to_subpixel
from stereoweave.stereo import LONGEST_SIDE_PX, Estimate, StereoPair
from stereoweave.system.threads import thread_count

_FLOAT32 = "tensor(float)"
PIXEL_PAIRS_AT_ONCE = 1920 * 1920 * 1088
"""Greatest number of pairs of pixels in the same row that one run compares; this takes about 1 GB."""
# Memory is released after larger runs, because the upsampling that follows needs the same amount.
_KEPT_PIXEL_PAIRS = 1280 * 1280 * 960
# Overlap of strips on each side. About 1 % of the pixels then differ by more than 1 px from a run on the
# whole image.
_STRIP_OVERLAP_PX = 64
# Greatest `multiple_of` that a matcher file may state: the sides of images are padded to a multiple of it.
_MOST_MULTIPLE_OF = 1024
# A square window is plain if its means over 9x9 px vary by no more than this, as they do with noise of 3 grey
# levels alone. In collages, 1 pixel in 5,000 is plain, and a third of these have the right disparity.
_PLAIN_WINDOW_PX = 65
_PLAIN_MEAN_PX = 9
_PLAIN_GREY_LEVELS = 2


class Mode(NamedTuple):
    """A way to run a network, which a name selects.

    Attributes:
        network: Name of the shipped network.
        magnification: Greatest factor by which pairs are magnified for the network.
        voted: Whether edges, speckles and unsure disparities are corrected by vote.
    """

    network: str
    magnification: float = 1.0
    voted: bool = False


MODES = {"base": Mode(network="base"), "best": Mode(network="base", magnification=1.5, voted=True)}
"""Modes by name; both refine every estimate. `best` is for stills: it improves edges but is much slower."""


class Maps(NamedTuple):
    """Network outputs for a pair, each float32 [H, W]; None for an output that the network lacks."""

    disparity_px: np.ndarray
    right_disparity_px: np.ndarray | None = None
    confidence_logit: np.ndarray | None = None


class Matcher:
    """A loaded matcher file.

    Args:
        model: Name of a shipped network (`shipped_models`) or of a mode in `MODES`, or the path of an .onnx
            file, whose estimates are neither searched nor refined unless this is requested.
        threads: Maximum number of threads per call; default: all cores available to the process.
        provider: Execution provider, a name in `providers.PROVIDERS`.

    Attributes:
        model: Name or path of the network, as given.
        fixed_size: Height and width of a network with a fixed input size; None if it accepts any size.
        magnification: Greatest factor by which `match` magnifies pairs for the network; `estimate` ignores
            it.
        searches: Whether every estimate is searched where the network is unsure.
        refines: Whether every estimate is refined as on request.
        votes: Whether edges, speckles and unsure disparities are corrected by vote.

    Raises:
        MatcherError: The model is unknown, the matcher file is invalid or the provider is unavailable.
    """

    def __init__(
        self, model: str | Path = "small", *, threads: int | None = None, provider: str = CPU
    ) -> None:
        self._path, self.model = model_file(model), str(model)
        self.threads, self.provider = threads, provider
        mode = MODES.get(str(model))
        self.magnification = mode.magnification if mode else 1.0
        self.searches = not str(model).endswith(".onnx")
        self.refines = mode is not None
        self.votes = mode is not None and mode.voted
        try:
            self._network = Network(self._path, provider, thread_count(threads))
            self._outputs = self._read_outputs()
            self.name, self.multiple_of, self.max_disparity_px = self._read_properties()
            # Free dimensions have names instead of numbers, and a file may omit the shape altogether.
            shape: list[Any] = [*self._network.session.get_inputs()[0].shape, *["any"] * 4]
        except UnicodeDecodeError as error:
            raise MatcherError(
                f"{self._path}: expected metadata in UTF-8, found bytes in another encoding"
            ) from error
        batch, _, height, width = shape[:4]
        self._takes_batches = not isinstance(batch, int) and PROVIDERS[provider].batches
        is_fixed = isinstance(height, int) and isinstance(width, int)
        self.fixed_size: tuple[int, int] | None = (height, width) if is_fixed else None

    def __repr__(self) -> str:
        return f"Matcher({self.model}, disparity 0 to {self.max_disparity_px:g} px, {self.provider})"

    def estimate(
        self,
        left: UInt8[np.ndarray, "h w 3"],
        right: UInt8[np.ndarray, "h w 3"],
        *,
        refined: bool = False,
        raw: bool = False,
    ) -> Estimate:
        """Estimate both views' disparities, the confidence and the occlusion mask of a rectified pair.

        Where a named network is unsure, the pair is matched once more (`refine.refine`). The left
        view's disparity is refined to a fraction of a pixel (`subpixel.to_subpixel`). Occluded pixels are
        filled with the disparity of the background (`occlusion_fill.fill_occluded`).

        Args:
            left: Left image, uint8 RGB [H, W, 3].
            right: Right image of the same size.
            refined: Match once more wherever the network is not certain (`refine.refine`), which is slower
                but recovers more thin structures and sharper edges. The modes always do.
            raw: Return the network's own disparities without any post-processing.

        Raises:
            StereoweaveError: The images are invalid, shorter than 32 px on a side or larger than
                `fixed_size`; or both `refined` and `raw` are set.
        """
        (found,) = self.estimate_many([StereoPair(left=left, right=right)], refined=refined, raw=raw)
        return found

    def estimate_many(
        self, pairs: Sequence[StereoPair], *, refined: bool = False, raw: bool = False
    ) -> list[Estimate]:
        """Match pairs of equal size as `estimate` does, in batches if the matcher and provider support them.

        Raises:
            StereoweaveError: An image or option is invalid, as for `estimate`, or the pairs differ in size.
        """
        MatchOptions(refined=refined, raw=raw)  # raises if both are set
        check_kind("pairs", pairs, Sequence)
        for pair in pairs:
            check_kind("pairs", pair, StereoPair)
        self._check_sizes(pairs)
        every_maps = self._maps(pairs)
        if any(maps.right_disparity_px is None for maps in every_maps):
            mirrored = self._maps([pair.mirror() for pair in pairs])
            every_maps = [
                maps._replace(right_disparity_px=np.ascontiguousarray(other.disparity_px[:, ::-1]))
                for maps, other in zip(every_maps, mirrored, strict=True)
            ]
        found = [_estimate(pair.left, maps) for pair, maps in zip(pairs, every_maps, strict=True)]
        if raw:
            return found
        return [self.finish(pair, own, refined=refined) for pair, own in zip(pairs, found, strict=True)]

    def finish(self, pair: StereoPair, found: Estimate, *, refined: bool = False) -> Estimate:
        """Post-process the network's estimate.

        The pair is matched once more where a named network is unsure; if `refined` or the matcher's mode
        requests it, wherever the network is not certain. Visible disparities are then refined to a fraction
        of a pixel, occluded pixels filled and streaks beyond the other picture smoothed. Refined estimates
        finally get edges that follow the image.
        """
        refined = refined or self.refines
        if refined or self.searches:
            extent = WIDE if refined else NARROW
            found = apply_masks(refine(pair.left, pair.right, found, self.threads, extent), pair)
        found = to_subpixel(pair.left, pair.right, found, self.threads)
        found = smooth_streaks(fill_occluded(found, pair.left_seen))
        if self.votes:
            return vote_at_edges(pair.left, found, self.threads)
        return sharpen_edges(pair.left, found, self.threads) if refined else found

    def _check_sizes(self, pairs: Sequence[StereoPair]) -> None:
        sizes = sorted({pair.left.shape[:2] for pair in pairs})
        if len(sizes) > 1:
            found = ", ".join(f"{width}x{height}" for height, width in sizes)
            raise StereoweaveError(
                f"pairs: expected pairs of equal size, got {found}; "
                "matching.match_many accepts pairs of different sizes"
            )
        for height, width in sizes:
            got = f"got {width}x{height}"
            if min(height, width) < SMALLEST_SIDE_PX:
                least = f"{SMALLEST_SIDE_PX}x{SMALLEST_SIDE_PX}"
                raise StereoweaveError(f"images: expected at least {least} px, {got}")
            if self.fixed_size is not None and not self.sees_whole(width, height):
                most = f"{self.fixed_size[1]}x{self.fixed_size[0]}"
                raise StereoweaveError(
                    f"images: expected at most {most} px, the input size of {self._path.name}, {got}; "
                    "matching.match scales larger images down"
                )

    def sees_whole(self, width: int, height: int) -> bool:
        """Return whether an image of this size is matched in one run, without strips of rows."""
        if self.fixed_size is not None:
            return height <= self.fixed_size[0] and width <= self.fixed_size[1]
        if max(height, width) > LONGEST_SIDE_PX:
            return False
        return height <= self._strip_rows(width) and width * width * height <= PIXEL_PAIRS_AT_ONCE

    def _maps(self, pairs: Sequence[StereoPair]) -> list[Maps]:
        """Run the network on pairs of equal size, in batches as large as memory allows."""
        if not pairs:
            return []
        height, width = pairs[0].left.shape[:2]
        if self.fixed_size is None and height > self._strip_rows(width):
            return [self._run_in_strips(pair) for pair in pairs]
        rows, columns = self._run_size(height, width)
        at_once = max(PIXEL_PAIRS_AT_ONCE // (rows * columns**2), 1) if self._takes_batches else 1
        return [
            maps
            for first in range(0, len(pairs), at_once)
            for maps in self._run_batch([(x.left, x.right) for x in pairs[first : first + at_once]])
        ]

    def _run_in_strips(self, pair: StereoPair) -> Maps:
        """Run the network on a large pair in strips of rows, blended where they overlap."""
        height, width = pair.left.shape[:2]
        totals: dict[str, np.ndarray] = {}
        weights = np.zeros((height, 1), np.float32)
        for rows in _strips(height, self._strip_rows(width)):
            weight = _strip_weights(rows, height)
            weights[rows] += weight
            for name, values in self._run(pair.left[rows], pair.right[rows])._asdict().items():
                if values is not None:
                    totals.setdefault(name, np.zeros((height, width), np.float32))[rows] += weight * values
        return Maps(**{name: total / weights for name, total in totals.items()})

    def _strip_rows(self, width: int) -> int:
        rows = PIXEL_PAIRS_AT_ONCE // (width * width)
        return max(rows // self.multiple_of * self.multiple_of, 4 * _STRIP_OVERLAP_PX)

    def _run(self, left: UInt8[np.ndarray, "h w 3"], right: UInt8[np.ndarray, "h w 3"]) -> Maps:
        (maps,) = self._run_batch([(left, right)])
        return maps

    def _run_batch(self, pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> list[Maps]:
        """Run the network once on a batch of left and right images of equal size."""
        height, width = pairs[0][0].shape[:2]
        (above, _), (before, _) = self._borders_px(height, width)
        inputs = {"left": self._tensor([x for x, _ in pairs]), "right": self._tensor([x for _, x in pairs])}
        release = len(pairs) * height * width * width > _KEPT_PIXEL_PAIRS
        values = self._network.run(self._outputs, inputs, release)
        outputs = dict(zip(self._outputs, values, strict=True))
        self._check_outputs(outputs, [len(pairs), 1, *inputs["left"].shape[2:]])
        return [
            Maps(
                **{
                    name: np.ascontiguousarray(value[i, 0, above : above + height, before : before + width])
                    for name, value in outputs.items()
                }
            )
            for i in range(len(pairs))
        ]

    def _check_outputs(self, outputs: dict[str, np.ndarray], expected: list[int]) -> None:
        for name, value in outputs.items():
            if list(value.shape) != expected:
                raise MatcherError(
                    f"{self._path}: expected {name} of shape {expected}, found {list(value.shape)}"
                )
            if not np.isfinite(value).all():
                raise MatcherError(f"{self._path}: expected finite values in {name}, found NaN or infinity")

    def _run_size(self, height: int, width: int) -> tuple[int, int]:
        """Return the height and width of the network's input for an image of this size."""
        if self.fixed_size is not None:
            return self.fixed_size
        return height + -height % self.multiple_of, width + -width % self.multiple_of

    def _borders_px(self, height: int, width: int) -> list[tuple[int, int]]:
        """Return the padding (above, below) and (left, right) up to the network's input size.

        The padding is split evenly, because padding one side only would harm one view more than the other.
        """
        rows, columns = self._run_size(height, width)
        return [(px // 2, px - px // 2) for px in (rows - height, columns - width)]

    def _tensor(self, images: Sequence[UInt8[np.ndarray, "h w 3"]]) -> Float[np.ndarray, "b 3 h2 w2"]:
        """Convert images to the network's input, padded by repeating their border pixels."""
        (above, below), (before, behind) = self._borders_px(*images[0].shape[:2])
        padded = [
            cv2.copyMakeBorder(image, above, below, before, behind, cv2.BORDER_REPLICATE) for image in images
        ]
        # Gives the same result as cv2.dnn.blobFromImage in half the time.
        planes = np.stack([plane for image in padded for plane in cv2.split(image)])
        return planes.reshape(len(images), 3, *padded[0].shape[:2]) * np.float32(1 / 255)

    def _read_outputs(self) -> list[str]:
        """Validate the graph's inputs and outputs; return the names of the outputs listed in `Maps`."""
        inputs = {value.name: value.type for value in self._network.session.get_inputs()}
        outputs = {value.name: value.type for value in self._network.session.get_outputs()}
        used = [name for name in Maps._fields if name in outputs]
        all_float32 = all(outputs[name] == _FLOAT32 for name in used)
        if inputs != {"left": _FLOAT32, "right": _FLOAT32} or "disparity_px" not in used or not all_float32:
            raise MatcherError(
                f"{self._path}: expected a matcher with inputs left and right and output disparity_px, "
                f"all {_FLOAT32}, found inputs {_format_types(inputs)} and outputs {_format_types(outputs)}"
            )
        return used

    def _read_properties(self) -> tuple[str, int, float]:
        """Read name, multiple_of and max_disparity_px from the file's metadata."""
        metadata = self._network.session.get_modelmeta().custom_metadata_map
        keys = [f"stereoweave.{key}" for key in ("name", "multiple_of", "max_disparity_px")]
        try:
            name, multiple_of, max_disparity_px = (metadata[key] for key in keys)
            if not 1 <= int(multiple_of) <= _MOST_MULTIPLE_OF or not 0 < float(max_disparity_px) < math.inf:
                raise ValueError
            return name, int(multiple_of), float(max_disparity_px)
        except KeyError as missing:
            found = f"no {missing.args[0]}"
        except ValueError:
            found = f"multiple_of {multiple_of!r}, max_disparity_px {max_disparity_px!r}"
        raise MatcherError(
            f"{self._path}: expected a matcher's metadata, found {found}; "
            "create the file with `stereoweave export`"
        )


def apply_masks(found: Estimate, pair: StereoPair) -> Estimate:
    """Apply the content masks to the confidence and the occlusion mask, as described in `estimate.match`."""
    confidence, occluded = found.confidence, found.occluded
    if pair.left_seen is not None:
        confidence = np.where(pair.left_seen, confidence, np.float32(0))
    if pair.right_seen is not None:
        seen, _ = at_match(pair.right_seen.astype(np.uint8), found.disparity_px, -1)
        occluded = occluded | (seen == 0)
    return replace(found, confidence=confidence, occluded=occluded)


def rehearse_finishing() -> None:
    """Finish a small estimate, to compile what follows `refine` (`compiling_ahead.compile_ahead`)."""
    image, px = np.zeros((32, 32, 3), np.uint8), np.zeros((32, 32), np.float32)
    found = Estimate(disparity_px=px, right_disparity_px=px, confidence=px, occluded=px > 0)
    smooth_streaks(fill_occluded(to_subpixel(image, image, found, 1)))


def shipped_models() -> list[str]:
    """Return the names of the shipped networks in alphabetical order."""
    return sorted(Path(file.name).stem for file in _weights_folder().iterdir() if file.name.endswith(".onnx"))


def _format_types(types: dict[str, str]) -> str:
    return ", ".join(f"{name} {kind}" for name, kind in types.items())


def _weights_folder() -> Path:
    return Path(str(files("stereoweave") / "weights"))


def model_file(model: str | Path) -> Path:
    """Return the path of the .onnx file for the name of a network or mode, or for a path.

    Raises:
        MatcherError: The model is unknown or its file does not exist.
    """
    check_kind("model", model, str, Path)
    if str(model).endswith(".onnx"):
        path = Path(model)
        if not path.is_file():
            found = "a folder" if path.is_dir() else "no such file"
            raise MatcherError(f"{path}: expected an ONNX matcher file, found {found}")
        return path
    name = MODES[str(model)].network if str(model) in MODES else str(model)
    if name not in shipped_models():
        names = list(dict.fromkeys([*shipped_models(), *MODES]))
        raise MatcherError(
            f"unknown model {name!r}; expected {', '.join(names)} or the path of an .onnx file"
            + ("" if Path(name).suffix else suggest(name, names))
        )
    return _weights_folder() / f"{name}.onnx"


def _strips(height: int, rows: int) -> Iterator[slice]:
    """Yield overlapping ranges of at most `rows` rows that cover `height`, with nearly equal lengths."""
    if height <= rows:
        yield slice(0, height)
        return
    count = math.ceil((height - 2 * _STRIP_OVERLAP_PX) / (rows - 2 * _STRIP_OVERLAP_PX))
    ends = np.linspace(_STRIP_OVERLAP_PX, height - _STRIP_OVERLAP_PX, count + 1).round().astype(int).tolist()
    for top, bottom in pairwise(ends):
        yield slice(top - _STRIP_OVERLAP_PX, bottom + _STRIP_OVERLAP_PX)


def _strip_weights(rows: slice, height: int) -> Float[np.ndarray, "h 1"]:
    """Return the blending weight of each row in a strip; it falls towards ends that overlap other strips."""
    places = np.arange(rows.start, rows.stop, dtype=np.float32)[:, None] + 0.5
    from_top = places - rows.start if rows.start > 0 else np.full_like(places, np.inf)
    from_bottom = rows.stop - places if rows.stop < height else np.full_like(places, np.inf)
    # The outermost quarter of the overlap has almost no weight, because it suffers from the strip's border.
    inset = np.minimum(from_top, from_bottom) - _STRIP_OVERLAP_PX / 2
    return np.clip(inset / _STRIP_OVERLAP_PX, 1e-6, 1).astype(np.float32)


def _estimate(left: UInt8[np.ndarray, "h w 3"], maps: Maps) -> Estimate:
    """Build the estimate from the network's maps for both views."""
    right_px = maps.right_disparity_px
    assert right_px is not None
    disagreement_px, inside = measure_disagreement(maps.disparity_px, right_px)
    contradicted = find_contradicted(maps.disparity_px, right_px)
    plain = measure_contrast(left, _PLAIN_MEAN_PX, _PLAIN_WINDOW_PX) <= _PLAIN_GREY_LEVELS
    return Estimate(
        disparity_px=maps.disparity_px,
        right_disparity_px=right_px,
        confidence=_confidence(maps.confidence_logit, disagreement_px, contradicted, plain),
        occluded=is_occluded(disagreement_px, inside),
    )


def _confidence(
    logit: Float[np.ndarray, "h w"] | None,
    disagreement_px: Float[np.ndarray, "h w"],
    contradicted: Bool[np.ndarray, "h w"],
    plain: Bool[np.ndarray, "h w"],
) -> Float[np.ndarray, "h w"]:
    """Return the confidence, from the network's log odds if given, else from the views' disagreement.

    A pixel's match cannot be farther than the pixel itself, because both cameras see the nearest surface.
    Where the right view's disparities contradict this, one of the two views is wrong, and the network's
    probability is halved. On collages and real pairs, about a quarter of such pixels are correct, while the
    network claims a probability of 0.4 to 0.5. The confidence is 0 where the left image is plain.

    Args:
        logit: The network's log odds; None if the network has no such output.
        disagreement_px: The right view's disparity at the match minus the left view's disparity.
        contradicted: Result of `find_contradicted`.
        plain: Mask of left pixels without texture to match.
    """
    if logit is None:
        probability = np.exp(-np.abs(disagreement_px))
    else:
        # The logistic function, in a form that does not overflow.
        probability = 0.5 * (1 + np.tanh(logit / 2))
        np.multiply(probability, 0.5, out=probability, where=contradicted)
    probability[plain] = 0
    return probability
