"""Whose folder this is: a JSON file in it says what was made there and how, and refuses another's run.

What the file says is handed in and out as values and text, so that the folder may be on a disk or in a store.
"""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from stereoweave.errors import FormatError, StereoweaveError


def description(facts: Mapping[str, Any]) -> str:
    """The text of a description: facts as JSON, which `described` reads."""
    return json.dumps(facts, indent=1, default=str) + "\n"


def described(place: str | Path, text: str, expected: str) -> dict[str, Any]:
    """The facts of a description.

    Args:
        place: Path or URL of the description, for the error.
        text: What is written there.
        expected: What it was taken for, such as "the description of a batch".

    Raises:
        FormatError: It is no description.
    """
    try:
        facts = json.loads(text)
    except ValueError as error:
        raise FormatError(f"{place}: expected {expected}, found one that cannot be read ({error})") from error
    if not isinstance(facts, dict):
        raise FormatError(f"{place}: expected {expected}, found {text.strip()[:40]}")
    return facts


def check_claim(place: str | Path, facts: Mapping[str, Any], found: Mapping[str, Any]) -> None:
    """Refuses a folder whose description has other facts than this run's.

    Args:
        place: Path or URL of the description.
        facts: This run's, as `description` takes them.
        found: Those that are described there.

    Raises:
        StereoweaveError: They differ; the first that does is named.
    """
    expected = json.loads(description(facts))  # where tuples have become lists
    for name in expected | dict(found):
        if found.get(name) != expected.get(name):
            raise StereoweaveError(
                f"{place}: expected {name} = {json.dumps(expected.get(name))}, as this run would make, "
                f"found {json.dumps(found.get(name))}; ask for the same, or take another folder"
            )


def check_unclaimed(folder: str | Path, file: str, others: Iterable[str]) -> None:
    """Refuses a folder that has files in it, and not the one that says whose it is.

    Args:
        folder: Path or URL.
        file: The name of the description.
        others: The names of what is in the folder.

    Raises:
        StereoweaveError: Something is in the folder.
    """
    if other := min(others, default=None):
        raise StereoweaveError(f"{folder}: expected a new folder, or one with a {file}, found {other} in it")
