"""Diagnosis of a matched pair: notes on defects that the user should know about."""

from dataclasses import replace

import numpy as np

from stereoweave.cameras.alignment import RECTIFY, Alignment, check_pair
from stereoweave.cameras.unit_check import note_units
from stereoweave.errors import Note, Remedy
from stereoweave.stereo import Estimate, StereoPair

_CONFIDENT = 0.5
# Sound pairs have at least 64 % confident pixels; noise and plain pictures have at most 12 %.
_LEAST_CONFIDENT_PERCENT = 30.0
CALIBRATE = Remedy("give a calibration", ("calibration",))
CALIBRATE_AGAIN = Remedy("give a calibration of these cameras", ("calibration",))
GIVE_DOFFS = Remedy("give a calibration with doffs", ("calibration",))


def find_problems(
    pair: StereoPair,
    estimate: Estimate,
    alignment: Alignment | None = None,
    remedy: Remedy = RECTIFY,
) -> list[Note]:
    """Return notes on the problems of a pair and its camera; a sound pair has none.

    The alignment is measured at feature matches (`stereoweave check` reports it in full). If there are too
    few matches, only the estimate's confidence decides, because a plain wall may be matched well.

    Args:
        pair: The pair.
        estimate: The pair's estimate.
        alignment: The pair's alignment, if it has been measured already.
        remedy: What to do if rows are apart; another one than the default if rectification was tried.
    """
    alignment = alignment or check_pair(pair.left, pair.right)
    return [*_find_defects(pair, estimate, alignment, remedy), *_check_camera(pair, alignment)]


def _check_camera(pair: StereoPair, alignment: Alignment) -> list[Note]:
    """Return notes on a camera in a wrong unit, or one that puts much of the scene beyond infinity."""
    if pair.camera is None:
        return []
    units = note_units(pair.camera, pair.left.shape[1])
    if pair.camera.doffs_px or not alignment.needs_doffs:
        return units
    text = (
        f"depths in metres are wrong: {alignment.negative_percent:.0f} % of the matches have negative "
        "disparities, which doffs of 0 px put beyond infinity"
    )
    return [*units, Note(text, GIVE_DOFFS)]


def _find_defects(pair: StereoPair, estimate: Estimate, alignment: Alignment, remedy: Remedy) -> list[Note]:
    if alignment.is_known:
        warnings = alignment.warnings()
        if warnings:
            return [replace(note, remedy=remedy) if note.remedy == RECTIFY else note for note in warnings]
    elif "stacked" in alignment.defects:
        return alignment.warnings()
    seen = np.ones(estimate.confidence.shape, bool) if pair.left_seen is None else pair.left_seen
    confident_percent = 100 * float((estimate.confidence >= _CONFIDENT)[seen].mean()) if seen.any() else 0.0
    if confident_percent < _LEAST_CONFIDENT_PERCENT:
        if "unrelated" in alignment.defects:
            return alignment.warnings()
        return [
            Note(
                f"only {confident_percent:.0f} % of the disparities are confident: the pictures may be too "
                "plain, show different scenes, be swapped or not be rectified",
                remedy,
            )
        ]
    return []
