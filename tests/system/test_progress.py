"""Steps of commands as a terminal and a log show them."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

pty = pytest.importorskip("pty")  # Windows has none


@pytest.fixture
def pair(rng, tmp_path, monkeypatch):
    """Write a pair of 95x64 with a disparity of 8 px to the current folder."""
    monkeypatch.chdir(tmp_path)
    photograph = Image.fromarray(rng.integers(0, 256, (8, 13, 3), dtype=np.uint8)).resize((104, 64))
    photograph.crop((0, 0, 95, 64)).save("left.png")
    photograph.crop((8, 0, 103, 64)).save("right.png")


def command(line):
    return [sys.executable, "-m", "stereoweave", *line.split()]


def in_terminal(line):
    """Run a command with a terminal as stderr. Returns exit code, stdout and what the terminal got."""
    ours, its = pty.openpty()
    with subprocess.Popen(
        command(line), stdout=subprocess.PIPE, stderr=its, env=os.environ | {"TERM": "xterm"}
    ) as running:
        os.close(its)
        got = b""
        while chunk := read(ours):
            got += chunk
        printed = running.stdout.read()
    os.close(ours)
    return running.returncode, printed.decode(), got.decode()


def read(terminal):
    """Return what the terminal got since the last call; nothing after the last process has closed it."""
    try:
        return os.read(terminal, 4096)
    except OSError:  # on Linux
        return b""


def test_a_terminal_shows_the_steps_and_in_the_end_none_of_them(pair):
    code, printed, got = in_terminal("depth left.png right.png --json -o out")
    assert code == 0
    assert json.loads(printed)["width_px"] == 95
    shown = [got.index(step) for step in ("starting …", "matching …", "writing the files …")]
    assert shown == sorted(shown)
    # The control sequence that erases a line is the last thing that the terminal got.
    assert got.endswith("\x1b[2K")


def test_an_error_replaces_the_step_in_the_terminal(pair):
    code, printed, got = in_terminal("depth left.png missing.png -o out")
    assert (code, printed) == (2, "")
    assert got.startswith("\x1b[?25lstarting …")
    assert got.rpartition("\x1b[2K")[2].startswith("stereoweave: missing.png: ")


def test_the_bar_of_a_batch_takes_the_place_of_the_steps(pair, tmp_path):
    folder = tmp_path / "pairs" / "first"
    folder.mkdir(parents=True)
    for side in ("left.png", "right.png"):
        (tmp_path / side).rename(folder / side)
    code, _, got = in_terminal("depth pairs --jobs 1 -o many")
    assert code == 0
    before, _, after = got.partition("1/1")
    assert "starting …" in before
    assert "starting …" not in after


IN_A_LOG = """
from stereoweave.system.progress import show_steps
from stereoweave.system.steps import step
with show_steps():
    with step("opening the pictures"):
        pass
    with step("matching"):
        answer = input()
print(answer)
"""


def test_a_step_that_lasts_is_a_plain_line_in_a_log():
    pipe = subprocess.PIPE
    with subprocess.Popen(
        [sys.executable, "-c", IN_A_LOG], stdin=pipe, stdout=pipe, stderr=pipe, encoding="utf-8"
    ) as running:
        assert running.stderr.readline() == "matching …\n"  # the step lasts until it has been read
        assert running.communicate("done\n") == ("done\n", "")


def test_an_error_in_the_input_is_the_only_line_of_a_log(pair):
    done = subprocess.run(command("depth left.png missing.png -o out"), capture_output=True, text=True)
    (line,) = done.stderr.splitlines()
    assert line.startswith("stereoweave: missing.png: ")


@pytest.mark.parametrize(
    "line",
    [
        "batch missing out",
        "bench pairs missing",
        "calibrate missing -o rig.yml --board 9x6 --square-mm 20",
        "export missing -o out.onnx",
        "synth check missing",
        "synth make rooms --pairs 1 --size 1x1 -o set",
        "train missing -o run",
    ],
)
def test_each_long_command_says_something_at_once(line, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, printed, got = in_terminal(line)
    assert (code, printed) == (2, "")
    assert got.startswith("\x1b[?25lstarting …")
    assert got.rpartition("\x1b[2K")[2].startswith("stereoweave: ")


def test_a_distributed_run_shows_the_steps_of_its_first_process(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("RANK", "1")
    code, printed, got = in_terminal("train missing -o run")
    assert (code, printed) == (2, "")
    assert "starting" not in got


BAR = """
import time
from rich.console import Console
from stereoweave.system.progress import progress, show_steps
seconds = [100.0]
time.monotonic = lambda: seconds[0]
console = Console(width=80, file=open("shown.txt", "w"))
with show_steps():
    bar = progress(console)
    task = bar.add_task("making pairs", total=4, loss="1 failed", rate="2.0 pairs/s")
    for seconds[0] in (100.9, 101.1):
        console.print(bar.get_renderable())
    seconds[0] = 100.9
    bar.advance(task, 4)
    console.print(bar.get_renderable())
"""


def test_a_bar_follows_its_description_a_second_after_the_start_or_at_the_end(tmp_path):
    subprocess.run([sys.executable, "-c", BAR], cwd=tmp_path, check=True)
    early, late, end = (tmp_path / "shown.txt").read_text("utf-8").splitlines()
    assert early.strip() == "making pairs …"
    assert late.rstrip().endswith("0/4 -:--:-- 1 failed 2.0 pairs/s")
    assert end.startswith("making pairs … ━━━") and "4/4" in end
