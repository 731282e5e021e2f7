"""Benchmark of matchers on pairs with known disparity: accuracy, edges, confidence, time and memory."""

import platform
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float

from stereoweave.bench.edge_metrics import edge_bad_percent, edge_epe_px, flying_percent
from stereoweave.bench.error_classes import class_errors, classify
from stereoweave.bench.metrics import (
    bad_percent,
    calibration_error,
    d1_percent,
    epe_px,
    sparsification,
)
from stereoweave.bench.opencv_matchers import OPENCV_MATCHERS, SGBM, fill_rows, left_right_confidence
from stereoweave.bench.tables import (
    MEAN,
    ClassRow,
    Curves,
    MatcherRow,
    average_class_rows,
    average_curves,
    average_rows,
    describe_machine,
)
from stereoweave.data.readers import Scene
from stereoweave.errors import StereoweaveError
from stereoweave.matching.backend import Backend
from stereoweave.matching.estimate import match
from stereoweave.matching.options import MatchOptions
from stereoweave.matching.providers import CPU
from stereoweave.stereo import Estimate, StereoPair
from stereoweave.system.memory import peak_memory_mb
from stereoweave.system.ray_engine import Engine, stream

MatchFunction = Callable[[StereoPair], Estimate | Float[np.ndarray, "h w"]]
"""The timed function, which returns an Estimate or only the left disparity in px [H, W], <= 0 in holes.

If it returns only the disparity, holes are then filled along rows, and the mirrored pair is matched too, to
derive confidence from the left-right check. Neither step is timed, because users may choose methods with
other costs.
"""

MatcherFactory = Callable[[], MatchFunction]

AnyScene = TypeVar("AnyScene")
AnyResult = TypeVar("AnyResult")
SceneLister = Callable[[], Sequence[Callable[[], AnyScene]]]
"""Returns a reader for each scene; called by the process that starts a benchmark and by every worker."""

TURNS = 5


class PairScores(NamedTuple):
    """Result of `score_pairs`.

    Attributes:
        rows: A row per scene and matcher, then a mean row per matcher.
        class_rows: A row per scene, matcher and class of pixels, then a mean row per matcher and class.
        curves: Mean curves over the scenes, by matcher.
        largest: The pair with the most pixels, for `add_memory`.
        machine: Description of the machine, for `write_csv`.
    """

    rows: list[MatcherRow]
    class_rows: list[ClassRow]
    curves: dict[str, Curves]
    largest: StereoPair
    machine: dict[str, str]


@dataclass(frozen=True)
class SceneResult(Generic[AnyResult]):
    """The result of one scene, with the scene's number and the machine that measured it."""

    number: int
    result: AnyResult
    machine: dict[str, str]


class _SceneScores(NamedTuple):
    """Scores of one scene, which become part of `PairScores`."""

    scored: list[tuple[MatcherRow, Curves]]
    class_rows: list[ClassRow]
    pixels: int


class _MatcherOutput(NamedTuple):
    disparity_px: Float[np.ndarray, "h w"]
    confidence: Float[np.ndarray, "h w"]
    is_probability: bool


def make_matcher(
    model: str | Path, threads: int | None = None, refined: bool = False, provider: str = CPU
) -> MatchFunction:
    """Return a function that matches like `stereoweave.estimate`. For errors see `Matcher`."""
    matcher = Backend(model=model, threads=threads, provider=provider).matcher()
    options = MatchOptions(refined=refined)
    return lambda pair: match(matcher, pair, options)


def merge_makers(*groups: Mapping[str, MatcherFactory]) -> dict[str, MatcherFactory]:
    """Return the factories of all groups. Raises StereoweaveError if two groups share a name."""
    merged: dict[str, MatcherFactory] = {}
    for group in groups:
        if shared := [name for name in group if name in merged]:
            raise _refuse_duplicate(shared[0])
        merged |= group
    return merged


def score_pairs(
    makers: Mapping[str, MatcherFactory], scenes: SceneLister[Scene], engine: Engine | None = None
) -> PairScores:
    """Score the given matchers and OpenCV's matchers on scenes: errors, times and sparsification curves.

    Args:
        makers: Factories of the matchers, by name.
        scenes: Function that lists at least one scene.
        engine: Engine that scores each scene on one worker, so that times are compared on the same machine;
            `makers` and `scenes` must be picklable. Default: this process.

    Raises:
        StereoweaveError: If a matcher's name, or the stem of its file, is the name of another row of the
            table, or if there are no scenes; see also `engine.stream`.
    """
    everyone = _add_opencv(makers)
    found = score_all(everyone, scenes, _score_scene, engine)
    scored = [row_and_curves for scene in found for row_and_curves in scene.result.scored]
    rows = [row for row, _ in scored]
    class_rows = [row for scene in found for row in scene.result.class_rows]
    largest = max(found, key=lambda scene: scene.result.pixels)
    return PairScores(
        rows=rows + average_rows(rows, everyone),
        class_rows=class_rows + average_class_rows(class_rows),
        curves={name: average_curves([of for row, of in scored if row.matcher == name]) for name in everyone},
        largest=scenes()[largest.number]().pair,
        machine=merge_machines(found),
    )


def score_all(
    makers: Mapping[str, Callable[[], Any]],
    scenes: SceneLister[AnyScene],
    score: Callable[[Mapping[str, Any], AnyScene], AnyResult],
    engine: Engine | None,
) -> list[SceneResult[AnyResult]]:
    """Score the matchers on each scene with `score`, and return the results in the order of the scenes.

    For arguments and errors see `score_pairs`.
    """
    make_scorer = partial(_SceneScorer, makers, scenes, score)
    # Made here even with an engine, so that unknown matchers and scenes cause errors at once.
    scorer = make_scorer()
    count = len(scorer.readers)
    if not count:
        raise StereoweaveError("scenes: expected at least one, found none")
    if engine is None:
        return [scorer(number) for number in range(count)]
    return sorted(stream(partial(make_scorer, count), range(count), engine), key=attrgetter("number"))


def merge_machines(scored: Iterable[SceneResult[Any]]) -> dict[str, str]:
    """Merge the machines' descriptions; values that differ are joined by " + "."""
    machines = [scene.machine for scene in scored]
    return {name: " + ".join(sorted({machine[name] for machine in machines})) for name in machines[0]}


def add_memory(
    rows: Iterable[MatcherRow], makers: Mapping[str, MatcherFactory], pair: StereoPair
) -> list[MatcherRow]:
    """Measure each matcher's peak memory for a pair in a separate process, and add it to the mean rows.

    Args:
        rows: Rows of `score_pairs`.
        makers: The factories given to `score_pairs`; each must be picklable.
        pair: The pair to match; use the largest.
    """
    everyone = _add_opencv(makers)
    return [
        replace(row, memory_mb=peak_memory_mb(everyone[row.matcher], pair)) if row.scene == MEAN else row
        for row in rows
    ]


class _SceneScorer:
    """Callable that scores the scene of a given index, with matchers that are made only once."""

    def __init__(
        self,
        makers: Mapping[str, Callable[[], Any]],
        scenes: SceneLister[Any],
        score: Callable[[Mapping[str, Any], Any], Any],
        expected: int | None = None,
    ) -> None:
        self.matchers = {name: make() for name, make in makers.items()}
        self.readers, self.score = scenes(), score
        if expected not in (None, len(self.readers)):
            raise StereoweaveError(
                f"{platform.node()}: expected the same {expected} scenes as on the machine that started the "
                f"command, found {len(self.readers)}; put them on a disk that every node of the cluster can "
                f"read"
            )

    def __call__(self, number: int) -> SceneResult[Any]:
        return SceneResult(number, self.score(self.matchers, self.readers[number]()), describe_machine())


def _add_opencv(makers: Mapping[str, MatcherFactory]) -> dict[str, MatcherFactory]:
    for name in makers:
        if Path(name).stem in (*OPENCV_MATCHERS, MEAN):
            raise _refuse_duplicate(name)
    return {**OPENCV_MATCHERS, **makers}


def _refuse_duplicate(name: str) -> StereoweaveError:
    return StereoweaveError(
        f"{name}: expected a name that no other row of the table uses, found a duplicate; rename it"
    )


def _score_scene(matchers: Mapping[str, MatchFunction], scene: Scene) -> _SceneScores:
    # These first calls warm up the matchers before timing.
    answers = {name: _run_matcher(match, scene.pair) for name, match in matchers.items()}
    # Take turns, so that a slowdown of the machine affects all alike.
    turns_ms = [
        {name: _measure_time_ms(match, scene.pair) for name, match in matchers.items()} for _ in range(TURNS)
    ]
    times_ms = {name: float(np.median([turn_ms[name] for turn_ms in turns_ms])) for name in matchers}
    scored = []
    for name, answer in answers.items():
        curves = _measure_curves(answer, scene.truth_px)
        row = MatcherRow(
            matcher=name,
            scene=scene.name,
            **_measure_errors(answer, scene.truth_px),
            ause_px=curves.epe_px.ause,
            ause_bad1_percent=curves.bad1_percent.ause,
            time_ms=times_ms[name],
            time_relative=times_ms[name] / times_ms[SGBM],
        )
        scored.append((row, curves))
    return _SceneScores(scored, _score_classes(answers, scene), scene.truth_px.size)


def _score_classes(answers: Mapping[str, _MatcherOutput], scene: Scene) -> list[ClassRow]:
    masks = classify(scene.pair.left, scene.truth_px, scene.occluded)
    return [
        ClassRow(matcher=name, scene=scene.name, pixel_class=pixel_class, **asdict(errors))
        for name, answer in answers.items()
        for pixel_class, errors in class_errors(answer.disparity_px, scene.truth_px, masks).items()
    ]


def _run_matcher(match: MatchFunction, pair: StereoPair) -> _MatcherOutput:
    found = match(pair)
    if isinstance(found, Estimate):
        return _MatcherOutput(found.disparity_px, found.confidence, is_probability=True)
    mirrored_px = match(pair.mirror())
    assert not isinstance(mirrored_px, Estimate)
    return _MatcherOutput(
        fill_rows(found), left_right_confidence(found, mirrored_px[:, ::-1]), is_probability=False
    )


def _measure_errors(answer: _MatcherOutput, truth_px: Float[np.ndarray, "h w"]) -> dict[str, float]:
    """Return the columns that compare the disparity with the truth pixel by pixel."""
    found_px = answer.disparity_px
    known = np.isfinite(truth_px)
    hits = np.abs(found_px - truth_px)[known] <= 1
    return {
        "epe_px": epe_px(found_px, truth_px),
        "bad1_percent": bad_percent(found_px, truth_px, 1),
        "bad2_percent": bad_percent(found_px, truth_px, 2),
        "d1_percent": d1_percent(found_px, truth_px),
        "edge_epe_px": edge_epe_px(found_px, truth_px),
        "edge_bad1_percent": edge_bad_percent(found_px, truth_px, 1),
        "flying_percent": flying_percent(found_px, truth_px),
        "calibration_error": calibration_error(answer.confidence[known], hits)
        if answer.is_probability
        else float("nan"),
    }


def _measure_curves(answer: _MatcherOutput, truth_px: Float[np.ndarray, "h w"]) -> Curves:
    known = np.isfinite(truth_px)
    error_px = np.abs(answer.disparity_px[known] - truth_px[known].astype(np.float64))
    confidence = answer.confidence[known]
    return Curves(sparsification(error_px, confidence), sparsification(100.0 * (error_px > 1), confidence))


def _measure_time_ms(match: MatchFunction, pair: StereoPair) -> float:
    start_s = time.perf_counter()
    match(pair)
    return 1000 * (time.perf_counter() - start_s)
