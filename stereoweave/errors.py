"""The errors that a caller may want to catch; each is a ValueError, and says what to do."""

import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class StereoweaveError(ValueError):
    """What was handed in cannot be worked with."""


class FormatError(StereoweaveError):
    """A file that is not what it was taken for: its name, what was expected, what was found."""


class MatcherError(StereoweaveError):
    """A matcher that is unknown, an ONNX file that is none, or a provider that is not there."""


class ProviderError(MatcherError):
    """What a network is run on failed meanwhile, as for want of memory; the same call may work later."""


class OutputInUseError(StereoweaveError):
    """Another process writes to the same output."""


@contextmanager
def needing_extra(extra: str, what: str) -> Iterator[None]:
    """Turns a missing library into one line that says what needs it, and which extra has it."""
    try:
        yield
    except ModuleNotFoundError as missing:
        raise StereoweaveError(
            f"{what}, found no module {missing.name}; install the extra '{extra}': "
            f"pip install 'stereoweave[{extra}]', from the wheel or the copy you have"
        ) from missing


def reason(error: Exception) -> str:
    """What was found instead of a file that can be read or written, to end an error's line with."""
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
