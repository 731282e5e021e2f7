"""Claims on output folders: a run leaves a JSON description that later runs check before they write there.

The functions take and return the description's text, so the folder may be on a disk or in a store.
"""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from stereoweave.errors import FormatError, StereoweaveError


def describe_run(facts: Mapping[str, Any]) -> str:
    """Return a run's metadata as a JSON description that `parse_description` can read."""
    return json.dumps(facts, indent=1, default=str) + "\n"


def parse_description(place: str | Path, text: str, expected: str) -> dict[str, Any]:
    """Parse a description. Returns the run's metadata.

    Args:
        place: Path or URL of the description, for error messages.
        text: Content of the description.
        expected: Name of the description in error messages, such as "the description of a batch".

    Raises:
        FormatError: The text is not a JSON object.
    """
    try:
        facts = json.loads(text)
    except ValueError as error:
        raise FormatError(f"{place}: expected {expected}, found one that cannot be read ({error})") from error
    if not isinstance(facts, dict):
        raise FormatError(f"{place}: expected {expected}, found {text.strip()[:40]}")
    return facts


def check_claim(place: str | Path, facts: Mapping[str, Any], found: Mapping[str, Any]) -> None:
    """Check that a folder has not been claimed by a different run.

    Args:
        place: Path or URL of the folder's description, for the error message.
        facts: This run's metadata, as passed to `describe_run`.
        found: The metadata in the folder's description.

    Raises:
        StereoweaveError: The metadata is different; the error names the first entry that differs.
    """
    expected = json.loads(describe_run(facts))  # JSON turns tuples into lists
    for name in expected | dict(found):
        if found.get(name) != expected.get(name):
            raise StereoweaveError(
                f"{place}: expected {name} = {json.dumps(expected.get(name))} for this run, "
                f"found {json.dumps(found.get(name))}; use the same settings or another folder"
            )


def check_unclaimed(folder: str | Path, file: str, others: Iterable[str]) -> None:
    """Check that a folder without a description contains no files.

    Args:
        folder: Path or URL of the folder, for the error message.
        file: Name of the missing description.
        others: Names of the files in the folder.

    Raises:
        StereoweaveError: The folder contains a file.
    """
    if other := min(others, default=None):
        raise StereoweaveError(
            f"{folder}: expected an empty folder or one with a {file}, found one with {other}"
        )
