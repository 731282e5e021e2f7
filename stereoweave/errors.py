"""The errors that a caller may want to catch; each is a ValueError, and says what to do."""


class StereoweaveError(ValueError):
    """What was handed in cannot be worked with."""


class FormatError(StereoweaveError):
    """A file that is not what it was taken for: its name, what was expected, what was found."""


class MatcherError(StereoweaveError):
    """A matcher that is unknown, or an ONNX file that is none."""
