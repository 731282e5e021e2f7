"""The running command: its words, and the names of its options for settings in error messages and notes."""

import functools
import shlex
from collections.abc import Callable
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any, ParamSpec

import typer
from typer.core import TyperCommand

from stereoweave.cli.stopping import stopping_orderly
from stereoweave.errors import NameOf, StereoweaveError, keyword

Given = ParamSpec("Given")

# Parameters of commands, by setting, where the parameter has another name.
_PARAMETERS = {
    "calibration": "calib",
    "convergence_px": "convergence",
    "cpus_each": "threads",
    "distance_m": "distance",
    "files": "write",
    "fov_deg": "fov",
    "lens_fov_deg": "lens_fov",
    "look_deg": "look",
    "size_px": "size",
    "views": "view",
    "workers": "jobs",
}


# Commands, where a remedy names another command.
_COMMANDS = {"video": "stereoweave video"}


@dataclass(frozen=True)
class OptionNames:
    """The `NameOf` for one command; it can be sent to other processes.

    Attributes:
        options: The command's options, by parameter; "no_" before a parameter stands for its negation.
    """

    options: dict[str, str]

    def __call__(self, setting: str) -> str | None:
        """Return the name of the option for a setting; None if the command has no such option."""
        return self.options.get(setting) or self.options.get(_PARAMETERS.get(setting, ""))


def option_names(command: TyperCommand) -> OptionNames:
    """Return the names of a command's options."""
    options = [parameter for parameter in command.params if parameter.param_type_name == "option"]
    names = {str(option.name): option.opts[0] for option in options}
    negations = {f"no_{option.name}": option.secondary_opts[0] for option in options if option.secondary_opts}
    return OptionNames(_COMMANDS | names | negations)


_WORDS = "stereoweave.words"
_running: ContextVar[NameOf] = ContextVar("names of the running command's options", default=keyword)


_words: ContextVar[str] = ContextVar("the running command as typed", default="")


def running_command() -> str:
    """Return the running command as typed in a shell; "" if no command is running."""
    return _words.get()


def running_options() -> NameOf:
    """Return the names of the running command's options; keywords if no command is running."""
    return _running.get()


def shows_steps(command: Callable[Given, None]) -> Callable[Given, None]:
    """Make a command show its steps on stderr, compile kernels ahead of their use, and stop in order.

    See `progress.show_steps`, `compiling_ahead.compile_ahead` and `stopping.stopping_orderly`.
    """

    @functools.wraps(command)
    def run(*args: Given.args, **kwargs: Given.kwargs) -> None:
        # It imports rich, for which --help need not wait.
        from stereoweave.system.progress import show_steps

        with stopping_orderly(), show_steps():
            from stereoweave.system.compiling_ahead import compiling_ahead

            with compiling_ahead():
                command(*args, **kwargs)

    return run


class Command(TyperCommand):
    """A command whose error messages refer to settings by the names of its options."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the command's arguments, and keep them as they were typed."""
        if "" in args:
            raise StereoweaveError("expected file names and values, found an empty one; is a variable unset?")
        ctx.meta[_WORDS] = shlex.join([*ctx.command_path.split(), *args])
        try:
            return super().parse_args(ctx, args)
        except typer.TyperException as error:
            # An option without its value comes without the context that names the command.
            error.ctx = getattr(error, "ctx", None) or ctx  # type: ignore[attr-defined]
            raise

    def invoke(self, ctx: Any) -> Any:
        """Run the command. Error messages refer to settings by the names of its options."""
        names = option_names(self)
        token, words = _running.set(names), _words.set(ctx.meta[_WORDS])
        try:
            return super().invoke(ctx)
        except StereoweaveError as error:
            raise StereoweaveError(error.format(names)) from error
        finally:
            _running.reset(token)
            _words.reset(words)


class Commands(typer.Typer):
    """A command line, or a group of commands, whose commands are all of class `Command`."""

    def __init__(self, help: str | None = None) -> None:
        super().__init__(
            help=help,
            add_completion=False,
            pretty_exceptions_enable=False,
            rich_markup_mode=None,
            context_settings={"help_option_names": ["--help", "-h"]},
        )

    def command(self, *given: Any, **options: Any) -> Callable[..., Any]:
        """Register a function as a `Command`."""
        return super().command(*given, **options, cls=Command)
