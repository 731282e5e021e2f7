import pickle

import pytest
import typer

from stereoweave.cli.commands import Command, OptionNames, option_names, running_options
from stereoweave.cli.root import app, main
from stereoweave.errors import keyword


def find_commands(group, name=""):
    for part, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from find_commands(command, f"{name}{part} ")
        else:
            yield f"{name}{part}", command


COMMANDS = dict(find_commands(typer.main.get_command(app)))


@pytest.mark.parametrize(
    ("command", "setting", "option"),
    [
        ("depth", "format", "--format"),
        ("video", "format", "--format"),
        ("live", "format", "--format"),
        ("depth", "calibration", "--calib"),
        ("depth", "files", "--write"),
        ("depth", "listed", "--list"),
        ("batch", "listed", None),
        ("batch", "range_px", "--range"),
        ("batch", "threads", None),
        ("batch", "cpus_each", "--cpus-each"),
        ("bench pairs", "cpus_each", "--threads"),
        ("bench pairs", "gpus_each", None),
        ("synth make", "cpus_each", None),
        ("synth make", "workers", "--jobs"),
        ("synth make", "size_px", "--size"),
        ("synth make", "views", "--view"),
        ("check", "rectify", None),
        ("rectify", "rectify", None),
        ("video", "rectify", "--rectify"),
        ("video", "convergence_px", "--convergence"),
        ("view", "out", "--out"),
        ("app", "open_browser", "--open"),
        ("depth", "pictures", None),
    ],
)
def test_a_command_names_a_setting_by_its_own_option(command, setting, option):
    assert option_names(COMMANDS[command])(setting) == option


def test_every_command_names_its_own_options():
    assert len(COMMANDS) == 26
    assert {type(command) for command in COMMANDS.values()} == {Command}


def test_the_names_of_options_reach_other_processes():
    names = OptionNames({"range_px": "--range"})
    assert pickle.loads(pickle.dumps(names)) == names


def test_outside_a_command_settings_are_keywords():
    assert running_options() is keyword
    assert main(["check", "none.png"]) == 2
    assert running_options() is keyword
