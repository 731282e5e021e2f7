import re
import subprocess
from dataclasses import asdict, replace

import pytest
import torch
from learn_examples import RECIPE, checkpoint_of, untrained
from torch import nn

from stereoweave.errors import FormatError
from stereoweave.learn import checkpoint
from stereoweave.learn.training.perceptual import PerceptualLoss


@pytest.fixture
def trained():
    """Return a complete checkpoint of a network that is a single layer."""
    torch.manual_seed(0)
    layer = nn.Conv2d(3, 4, 3).to(memory_format=torch.channels_last)
    optimiser = torch.optim.AdamW(layer.parameters(), 1e-3, fused=True)
    layer(torch.rand(1, 3, 5, 5)).sum().backward()
    optimiser.step()
    return replace(checkpoint_of(layer), optimiser=optimiser.state_dict())


def assert_same(one, other):
    assert type(one) is type(other)
    if isinstance(one, torch.Tensor):
        assert torch.equal(one, other)
        assert one.stride() == other.stride()
    elif isinstance(one, dict):
        assert one.keys() == other.keys()
        for key, value in one.items():
            assert_same(value, other[key])
    else:
        assert one == other


def test_a_checkpoint_comes_back_as_it_was(tmp_path, trained):
    path = tmp_path / "last.pt"
    checkpoint.save(trained, path)
    found = checkpoint.load(path)
    assert found.recipe == RECIPE
    assert_same(vars(trained), vars(found))


def test_saving_that_fails_leaves_the_earlier_checkpoint(tmp_path, trained):
    path = tmp_path / "last.pt"
    checkpoint.save(trained, path)
    before = path.read_bytes()
    with pytest.raises(AttributeError, match="lambda|pickle"):
        checkpoint.save(replace(trained, optimiser={"large": torch.zeros(10_000), "no": lambda: 0}), path)
    assert path.read_bytes() == before


def test_a_saved_checkpoint_leaves_no_other_file(tmp_path, trained):
    checkpoint.save(trained, tmp_path / "last.pt")
    checkpoint.save(trained, tmp_path / "last.pt")
    assert [file.name for file in tmp_path.iterdir()] == ["last.pt"]


def test_an_old_checkpoint_without_an_origin_loads_with_an_empty_one(tmp_path, trained):
    path = tmp_path / "old.pt"
    values = {**vars(trained), "recipe": asdict(RECIPE)}
    del values["origin"]
    torch.save(values, path)
    assert checkpoint.load(path).origin == ()


def truncated(path, trained):
    checkpoint.save(trained, path)
    path.write_bytes(path.read_bytes()[:-1000])


def of_another_recipe_version(path, trained):
    values = {**vars(trained), "recipe": {"name": "x", "colour": "red"}}
    torch.save(values, path)


@pytest.mark.parametrize(
    "write",
    [
        lambda path, _: path.write_bytes(bytes(range(256)) * 8),
        lambda path, _: path.write_bytes(b""),
        lambda path, _: path.write_text("hello, I am a text file\nof two lines\n"),
        lambda path, _: path.write_text("question\n"),
        lambda path, _: path.mkdir(),
        lambda path, _: torch.save([1, 2, 3], path),
        lambda path, _: torch.save({"weights": torch.zeros(3)}, path),
        lambda path, trained: torch.save(nn.Linear(2, 2), path),
        truncated,
        of_another_recipe_version,
    ],
    ids=["bytes", "empty", "text", "word", "folder", "list", "weights", "module", "truncated", "recipe"],
)
def test_an_error_names_a_file_that_is_not_a_checkpoint_in_one_line(tmp_path, trained, write):
    path = tmp_path / "no.pt"
    write(path, trained)
    with pytest.raises(FormatError) as caught:
        checkpoint.load(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


class Program:
    """An object that runs a program when it is unpickled."""

    def __init__(self, words):
        self.words = words

    def __reduce__(self):
        return subprocess.check_call, (self.words,)


def test_a_checkpoint_that_holds_a_program_is_refused_in_one_line_and_the_program_is_not_run(
    tmp_path, trained
):
    path, made = tmp_path / "no.pt", tmp_path / "made"
    values = {
        **vars(trained),
        "recipe": asdict(RECIPE),
        "optimiser": {"state": Program(["touch", str(made)])},
    }
    torch.save(values, path)
    with pytest.raises(FormatError) as caught:
        checkpoint.load(path)
    assert str(caught.value).startswith(f"{path}: expected a checkpoint")
    assert "\n" not in str(caught.value)
    assert not made.exists()


def test_an_error_about_a_missing_checkpoint_names_the_command_that_writes_one(tmp_path):
    with pytest.raises(FormatError, match=r"nowhere\.pt: no such checkpoint; `stereoweave train`"):
        checkpoint.load(tmp_path / "nowhere.pt")


def test_the_commit_of_the_code_is_a_short_hash_or_unknown():
    assert re.fullmatch(r"[0-9a-f]{7,40}\+?|unknown", checkpoint.find_commit())


def test_the_commit_of_code_installed_in_another_repository_is_unknown(tmp_path, monkeypatch):
    (tmp_path / "venv/stereoweave/learn").mkdir(parents=True)
    git = ["git", "-C", str(tmp_path), "-c", "user.name=x", "-c", "user.email=x"]
    for command in (["init", "-q"], ["commit", "-q", "--allow-empty", "-m", "x"]):
        subprocess.run([*git, *command], check=True)
    monkeypatch.setattr(checkpoint, "__file__", str(tmp_path / "venv/stereoweave/learn/checkpoint.py"))
    assert checkpoint.find_commit() == "unknown"
    monkeypatch.setattr(checkpoint, "__file__", str(tmp_path / "stereoweave/learn/checkpoint.py"))
    assert re.fullmatch(r"[0-9a-f]{7,40}", checkpoint.find_commit())


def test_a_run_starts_with_the_weights_of_its_seed_and_without_a_history():
    start, again, other = (
        checkpoint.make_initial(replace(RECIPE, seed=seed), "0123abc") for seed in (1, 1, 2)
    )
    assert (start.step, start.hours, start.origin) == (0, 0, ())
    assert_same(start.weights, again.weights)
    assert torch.equal(start.random_state, again.random_state)
    assert any(not torch.equal(value, other.weights[name]) for name, value in start.weights.items())


def gone_on(start, value):
    """Return a run that started from `start`, of a network with one weight."""
    return replace(start, averaged={"weight": torch.tensor([value])}, origin=start.as_origin(), hours=3.0)


def test_the_average_of_runs_is_their_mean_and_names_all_and_their_start_once(trained):
    start = replace(trained, hours=2.0)
    first, second, third = (
        replace(gone_on(start, value), commit=commit, hours=hours)
        for value, commit, hours in ((1.0, "first", 3.0), (4.0, "second", 4.0), (7.0, "third", 3.0))
    )
    found = checkpoint.average([first, second, third])
    assert found.averaged["weight"].item() == 4.0
    assert found.hours == 4.0
    assert [run["commit"] for run in found.origin] == [start.commit, "first", "second", "third"]


@pytest.mark.parametrize("change", [{"commit": "another"}, {"recipe": replace(RECIPE, seed=9)}])
def test_runs_without_an_ancestor_in_common_cannot_be_averaged(trained, change):
    stranger = replace(gone_on(trained, 1.0), origin=(), **change)
    with pytest.raises(FormatError, match="found a run with a different origin"):
        checkpoint.average([replace(gone_on(trained, 1.0), origin=()), stranger])


def test_networks_of_different_shapes_cannot_be_averaged(trained):
    wider = replace(gone_on(trained, 1.0), averaged={"weight": torch.zeros(2)})
    with pytest.raises(FormatError, match="expected a weave_small"):
        checkpoint.average([gone_on(trained, 1.0), wider])


def test_a_file_of_averaged_weights_is_small_and_a_run_can_start_from_it(tmp_path):
    network = untrained()
    kept = replace(checkpoint_of(network), optimiser={"state": torch.zeros(10)})
    checkpoint.save(checkpoint.strip_to_average(kept), tmp_path / "weights.pt")
    count = sum(value.numel() for value in network.state_dict().values())
    assert (tmp_path / "weights.pt").stat().st_size < 2 * count + 120_000
    found = checkpoint.load(tmp_path / "weights.pt")
    assert found.optimiser == {}
    start = checkpoint.make_initial(replace(RECIPE, start_from=str(tmp_path / "weights.pt")), "0123abc")
    assert start.origin[-1]["step"] == RECIPE.steps
    for name, value in network.state_dict().items():
        # A float16 has a precision of 11 bits.
        torch.testing.assert_close(start.weights[name], value, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (b"", "a truncated file"),
        (b"no checkpoint", r"(one that \S.+|another kind of file, or a damaged one)"),
        (b"\x80", r"(one that \S.+|another kind of file, or a damaged one)"),
        (b"PK\x03\x04", r"(one that \S.+|another kind of file, or a damaged one)"),
    ],
)
def test_a_file_that_is_not_a_checkpoint_is_refused_with_a_reason(tmp_path, content, found):
    path = tmp_path / "last.pt"
    path.write_bytes(content)
    for load, expected in (
        (checkpoint.load, "a checkpoint of `stereoweave train`"),
        (PerceptualLoss, "vgg16"),
    ):
        with pytest.raises(FormatError) as raised:
            load(path)
        told = str(raised.value)
        assert re.fullmatch(rf"{re.escape(str(path))}: expected {expected}.*, found {found}", told), told
