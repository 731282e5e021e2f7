"""Errors and notes, with their remedies.

A remedy names settings by their Python keywords. Each front end translates the keywords into the names of its
own options, form fields or labels.
"""

import copy
import textwrap
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

# Function that maps a setting's Python keyword to its name in a front end, or to None if it has no name.
NameOf = Callable[[str], str | None]


def keyword(setting: str) -> str:
    """Return the setting unchanged; this is the `NameOf` of the Python interface."""
    return setting


@dataclass(frozen=True)
class Remedy:
    """Advice to the user about an error or a note.

    Attributes:
        text: Instruction, such as "rectify the pair".
        settings: Python keywords of the settings to change.
    """

    text: str
    settings: tuple[str, ...] = ()

    def format(self, name_of: NameOf) -> str:
        """Return the advice with the front end's names for settings; "" if the front end has none of them."""
        names = [name for name in map(name_of, self.settings) if name]
        if not self.settings:
            return self.text
        return f"{self.text} ({', '.join(names)})" if names else ""


@dataclass(frozen=True)
class Note:
    """One-line message to the user about a pair or its results."""

    text: str
    remedy: Remedy | None = None

    def __str__(self) -> str:
        return self.format(keyword)

    def format(self, name_of: NameOf) -> str:
        """Return the line with the front end's names for the settings."""
        return _with_remedy(self.text, self.remedy, name_of)


class StereoweaveError(ValueError):
    """Error for invalid input; base class of all errors in this package.

    Args:
        message: Text that says what was expected and what was found.
        setting: Python keyword of the invalid setting, whose name begins the line.
        remedy: Advice at the end of the line.
    """

    def __init__(self, message: str, *, setting: str | None = None, remedy: Remedy | None = None) -> None:
        super().__init__(message)
        self.message, self.setting, self.remedy = message, setting, remedy

    def __str__(self) -> str:
        return self.format(keyword)

    def format(self, name_of: NameOf) -> str:
        """Return the error as one line, with the front end's names for the settings."""
        prefix = f"{name_of(self.setting) or self.setting}: " if self.setting else ""
        return prefix + _with_remedy(self.message, self.remedy, name_of)

    @classmethod
    def from_error(cls, error: Exception) -> "StereoweaveError":
        """Return an error of this class with the message, setting and remedy of another error."""
        if isinstance(error, StereoweaveError):
            return cls(error.message, setting=error.setting, remedy=error.remedy)
        return cls(" ".join(str(error).split()))

    def with_prefix(self, text: str) -> "StereoweaveError":
        """Return a copy of the same class whose message is prefixed with `text`."""
        return self._with_message(text + self.message)

    def with_detail(self, text: str) -> "StereoweaveError":
        """Return a copy of the same class with `text` inserted before the remedy."""
        return self._with_message(f"{self.message}; {text}")

    def _with_message(self, message: str) -> "StereoweaveError":
        changed = copy.copy(self)
        changed.message, changed.args = message, (message,)
        return changed


class FormatError(StereoweaveError):
    """Error for an invalid or missing file."""


class MatcherError(StereoweaveError):
    """Error for an unknown matcher, an invalid ONNX file or an unavailable provider."""


class ProviderError(MatcherError):
    """Error for a provider's failure during inference, such as lack of memory; a retry may succeed."""


class OutputInUseError(StereoweaveError):
    """Error for an output to which another process is writing."""


def format_error(error: Exception, name_of: NameOf) -> str:
    """Return an error's text; a StereoweaveError's text uses the front end's names for settings."""
    return error.format(name_of) if isinstance(error, StereoweaveError) else str(error)


def _with_remedy(text: str, remedy: Remedy | None, name_of: NameOf) -> str:
    advice = remedy.format(name_of) if remedy else ""
    return f"{text}; {advice}" if advice else text


@contextmanager
def require_extra(extra: str, what: str) -> Iterator[None]:
    """Turn a missing library's import error into a StereoweaveError that names the extra to install.

    `what` is the beginning of the message, such as "a plot needs matplotlib".
    """
    try:
        yield
    except ModuleNotFoundError as missing:
        raise StereoweaveError(
            f"{what}, but the module {missing.name} is not installed; install the extra '{extra}' from your "
            f'wheel or your copy of the source: pip install "stereoweave[{extra}]"'
        ) from missing


def reason(error: Exception) -> str:
    """Describe what was found instead of a usable file, to complete "expected ..., found ..."."""
    match error:
        case FileNotFoundError():
            return "no such file"
        case IsADirectoryError():
            return "a folder"
        case FileExistsError(filename=str(name)) if Path(name).is_symlink() and not Path(name).exists():
            return "a broken link"
        case FileExistsError():
            return "a file"
        case UnicodeDecodeError():
            return "one that is not UTF-8 text"
        case OSError(strerror=str(text)):
            return text.lower()
        case EOFError():
            return "a truncated file"
        case MemoryError():
            return "a file too large for the available memory"
    # A library's message may quote an entire file, over many lines.
    words = textwrap.shorten(str(error)[:1000], 200, placeholder=" ...") or type(error).__name__
    return f"one that cannot be read ({words})"
