"""Errors that callers may want to catch, and notes on results; both carry their remedy.

A remedy names settings by their Python keyword. Each front end shows its own name for them: an option, a
field of a form, a label.
"""

import textwrap
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

# A front end's name for a setting, given its Python keyword; None if the front end does not have it.
NameOf = Callable[[str], str | None]


def keyword(setting: str) -> str:
    """Python's name for a setting."""
    return setting


@dataclass(frozen=True)
class Remedy:
    """What to do about an error or a note.

    Attributes:
        text: Such as "rectify the pair".
        settings: The settings that do it, by their Python keyword.
    """

    text: str
    settings: tuple[str, ...] = ()

    def worded(self, name_of: NameOf) -> str:
        """The text and the front end's names; empty if the front end has none of the settings."""
        names = [name for name in map(name_of, self.settings) if name]
        if not self.settings:
            return self.text
        return f"{self.text} ({', '.join(names)})" if names else ""


@dataclass(frozen=True)
class Note:
    """A line for the user about a pair or its results, with the remedy if there is one."""

    text: str
    remedy: Remedy | None = None

    def __str__(self) -> str:
        return self.worded(keyword)

    def worded(self, name_of: NameOf) -> str:
        """The line with a front end's names for settings."""
        return _with_remedy(self.text, self.remedy, name_of)


class StereoweaveError(ValueError):
    """Invalid input; the base class of all errors of this package.

    Args:
        message: What was expected, and what was found.
        setting: The setting that is wrong, by its Python keyword.
        remedy: What to do about it.
    """

    def __init__(self, message: str, *, setting: str | None = None, remedy: Remedy | None = None) -> None:
        super().__init__(message)
        self.message, self.setting, self.remedy = message, setting, remedy

    def __str__(self) -> str:
        return self.worded(keyword)

    def worded(self, name_of: NameOf) -> str:
        """The error in one line with a front end's names for settings."""
        prefix = f"{name_of(self.setting) or self.setting}: " if self.setting else ""
        return prefix + _with_remedy(self.message, self.remedy, name_of)

    def extended(self, text: str) -> "StereoweaveError":
        """The error with more text before its remedy."""
        return StereoweaveError(f"{self.message}; {text}", setting=self.setting, remedy=self.remedy)


class FormatError(StereoweaveError):
    """Invalid file: its name, what was expected, what was found."""


class MatcherError(StereoweaveError):
    """Unknown matcher, invalid ONNX file or unavailable provider."""


class ProviderError(MatcherError):
    """A provider failed while it ran a network, for example out of memory; the same call may work later."""


class OutputInUseError(StereoweaveError):
    """Another process writes to the same output."""


def worded(error: Exception, name_of: NameOf) -> str:
    """An error's message, with a front end's names for settings if it is one of this package."""
    return error.worded(name_of) if isinstance(error, StereoweaveError) else str(error)


def _with_remedy(text: str, remedy: Remedy | None, name_of: NameOf) -> str:
    advice = remedy.worded(name_of) if remedy else ""
    return f"{text}; {advice}" if advice else text


@contextmanager
def needing_extra(extra: str, what: str) -> Iterator[None]:
    """Raise a StereoweaveError that names the extra to install if a library is missing."""
    try:
        yield
    except ModuleNotFoundError as missing:
        raise StereoweaveError(
            f"{what}, found no module {missing.name}; install the extra '{extra}': "
            f"pip install 'stereoweave[{extra}]', from the wheel or the copy you have"
        ) from missing


def reason(error: Exception) -> str:
    """What was found instead of a usable file, as the end of an error message."""
    match error:
        case FileNotFoundError():
            return "no such file"
        case IsADirectoryError():
            return "a folder"
        case FileExistsError(filename=str(name)) if Path(name).is_symlink() and not Path(name).exists():
            return "a link that leads nowhere"
        case FileExistsError():
            return "a file"
        case OSError(strerror=str(text)):
            return text.lower()
        case EOFError():
            return "one that ends too early"
        case MemoryError():
            return "one that takes more memory than there is"
    # Libraries quote what they found, which may be all of a file, and in many lines.
    words = textwrap.shorten(str(error)[:1000], 200, placeholder=" ...") or type(error).__name__
    return f"one that cannot be read ({words})"
