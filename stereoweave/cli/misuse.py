"""Errors of the command line's own grammar: unknown words, missing words, and values of the wrong kind."""

import re
from pathlib import Path
from typing import Any

import typer

# The texts of the library that parses the words, and ours.
_TEXTS = [
    (re.compile(pattern), text)
    for pattern, text in (
        (", unable to parse string as an? [a-z]+", ""),
        ("^Input should be ", "expected "),
        ("a valid integer", "a whole number"),
        ("a valid number", "a number"),
        ("greater than or equal to", "at least"),
        ("less than or equal to", "at most"),
        ("^Got unexpected extra arguments? ?.*? \\((.*)\\)$", r"expected nothing more, found \1"),
        ("^Option '(.*)' requires an argument$", r"\1: expected a value, found none"),
        ("^Option '(.*)' requires (.*) arguments$", r"\1: expected \2 values"),
        ("^Option '(.*)' does not take a value$", r"\1: expected no value"),
        ("^Missing command$", "expected a command, found none"),
        ("^No such ([a-z]*)", r"no such \1"),
        ("'\\. Did you mean ", "'; did you mean "),
        (" \\(Possible options: (.*)\\)$", r"; did you mean \1?"),
    )
]


def describe_misuse(error: typer.TyperException, program: str, word: str | None) -> str:
    """Return a text for the error: what was expected and found, and which help to read.

    Args:
        error: The error.
        program: Name of the program.
        word: The word in the place of a command, if the program has commands.
    """
    context = getattr(error, "ctx", None)
    # The context's own name of the program is that of the file that runs.
    names = [program]
    while context is not None and context.parent is not None:
        names.insert(1, str(context.info_name))
        context = context.parent
    message = _describe(error)
    if len(names) == 1 and word and Path(word).exists():
        message = f"expected a command, such as depth or view, before the pictures, found {word}"
    joint = " See" if message.endswith("?") else "; see"
    return f"{message}{joint} {' '.join(names)} --help"


def _describe(error: typer.TyperException) -> str:
    """Return what was expected and found."""
    parameter: Any = getattr(error, "param", None)
    # Of Pydantic, which names what it found.
    problems: list[Any] = getattr(error.__cause__, "errors", list)()
    if parameter is not None and problems:
        return f"{_name(parameter)}: {_translate(problems[0]['msg'])}, found {problems[0]['input']!r}"
    if parameter is not None and not error.message:
        help_text = str(parameter.help or "").partition(". ")[0].rstrip(".")
        explained = f" ({_lower(help_text)})" if help_text else ""
        return f"expected {_name(parameter)}{explained}, found none"
    return _translate(error.format_message().rstrip("."))


def _name(parameter: Any) -> str:
    """Return an option, or an argument as the help writes it."""
    if parameter.param_type_name == "option":
        return str(parameter.opts[0])
    return str(parameter.display_name_raw).upper()


def _lower(text: str) -> str:
    """Return a text that begins with a small letter, unless its first word is all capitals."""
    return text[:1].lower() + text[1:] if text[1:2].islower() else text


def _translate(text: str) -> str:
    for pattern, words in _TEXTS:
        text = pattern.sub(words, text)
    return text
