"""Release check: missing and untracked files, and the choice of Python interpreters."""

import ast
import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

from release import check, compare_tests, words

ROOT = Path(__file__).resolve().parent.parent
THIS_VERSION = "{}.{}".format(*sys.version_info)


def write_release(folder: Path, package: list[str], others: list[str]) -> tuple[Path, Path]:
    """Write a wheel and a source distribution of these files, with the files that setuptools adds."""
    wheel, sdist = folder / "stereoweave-1.0-py3-none-any.whl", folder / "stereoweave-1.0.tar.gz"
    with zipfile.ZipFile(wheel, "w") as archive:
        for name in (*package, "stereoweave-1.0.dist-info/METADATA"):
            archive.writestr(name, "")
    with tarfile.open(sdist, "w:gz") as archive:
        for name in (*package, *others, "PKG-INFO", "setup.cfg", "stereoweave.egg-info/SOURCES.txt"):
            archive.addfile(tarfile.TarInfo(f"stereoweave-1.0/{name}"))
    return wheel, sdist


@pytest.fixture
def repository(tmp_path, monkeypatch) -> Path:
    """Return a folder of four files, of which git tracks three, and make it the root of the check."""
    root = tmp_path / "repository"
    for name in ("stereoweave/a.py", "stereoweave/b.py", "README.md", "stereoweave/left.py"):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()
    for arguments in (["init", "-q"], ["add", "stereoweave/a.py", "stereoweave/b.py", "README.md"]):
        subprocess.run(["git", *arguments], cwd=root, check=True)
    monkeypatch.setattr(check, "ROOT", root)
    return root


def test_a_release_of_what_git_tracks_has_no_differences(repository, tmp_path):
    files = write_release(tmp_path, ["stereoweave/a.py", "stereoweave/b.py"], ["README.md"])
    assert check.content_differences(*files) == []


def test_missing_and_untracked_files_are_named(repository, tmp_path):
    files = write_release(tmp_path, ["stereoweave/a.py", "stereoweave/left.py"], [])
    assert check.content_differences(*files) == [
        "stereoweave-1.0-py3-none-any.whl: stereoweave/b.py is missing",
        "stereoweave-1.0-py3-none-any.whl: stereoweave/left.py is not tracked by git",
        "stereoweave-1.0.tar.gz: README.md is missing",
        "stereoweave-1.0.tar.gz: stereoweave/b.py is missing",
        "stereoweave-1.0.tar.gz: stereoweave/left.py is not tracked by git",
    ]


def test_a_python_is_found_on_the_path(tmp_path, monkeypatch):
    monkeypatch.setenv("PYENV_ROOT", str(tmp_path))
    (tmp_path / f"python{THIS_VERSION}").symlink_to(sys.executable)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert check.python_here(THIS_VERSION) == tmp_path / f"python{THIS_VERSION}"
    assert check.python_here("3.99") is None


def test_a_python_of_pyenv_is_found_if_its_shim_fails(tmp_path, monkeypatch):
    shim, python = tmp_path / f"python{THIS_VERSION}", tmp_path / f"versions/{THIS_VERSION}.0/bin/python"
    shim.write_text("#!/bin/sh\nexit 127\n")
    shim.chmod(0o755)
    python.parent.mkdir(parents=True)
    python.symlink_to(sys.executable)
    monkeypatch.setenv("PYENV_ROOT", str(tmp_path))
    monkeypatch.setenv("PATH", f"{tmp_path}:/bin")
    assert check.python_here(THIS_VERSION) == python


def test_a_command_that_fails_ends_the_check_with_its_output(tmp_path):
    with pytest.raises(SystemExit, match=r"failed:\nno module of that name"):
        check.run([sys.executable, "-c", "import sys; sys.exit('no module of that name')"], tmp_path)


def test_commands_do_not_see_the_repository(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    program = "import os; print('PYTHONPATH' in os.environ)"
    assert check.run([sys.executable, "-c", program], tmp_path) == "False"


def test_missing_pythons_are_named(tmp_path, monkeypatch, capsys):
    tried = []
    monkeypatch.setattr(check, "content_differences", lambda *_: [])
    monkeypatch.setattr(check, "try_out", lambda file, python, _: tried.append((file.name, str(python))))
    found = {"3.11": Path("a"), "3.12": None, "3.13": Path("b"), "3.14": None}
    monkeypatch.setattr(check, "python_here", found.get)
    check.main(tmp_path / "x.whl", tmp_path / "x.tar.gz")
    assert tried == [("x.whl", "a"), ("x.tar.gz", "a"), ("x.whl", "b"), ("x.tar.gz", "b")]
    lines = capsys.readouterr().out.splitlines()
    assert [line for line in lines if "not on" in line] == [
        "Python 3.12: not on this machine",
        "Python 3.14: not on this machine",
    ]


def test_the_oldest_python_is_required(tmp_path, monkeypatch):
    monkeypatch.setattr(check, "content_differences", lambda *_: [])
    monkeypatch.setattr(check, "python_here", lambda _: None)
    with pytest.raises(SystemExit, match=r"Python 3\.11, .*: not on this machine"):
        check.main(tmp_path / "x.whl", tmp_path / "x.tar.gz")


@pytest.mark.needs_git
def test_the_manifest_names_each_folder_of_the_repository():
    folders = {name.partition("/")[0] for name in check.tracked_files(ROOT) if "/" in name}
    grafted = re.findall(r"^graft (\S+)$", (ROOT / "MANIFEST.in").read_text(), re.MULTILINE)
    assert grafted == sorted(folders)


def test_a_sample_of_texts_depends_only_on_its_seed():
    drawn = words.draw(seed=1, count=50, kind="errors")
    assert drawn == words.draw(seed=1, count=50, kind="errors")
    assert len(set(drawn)) == 50
    assert drawn != words.draw(seed=2, count=50, kind="errors")
    tree = ast.parse(
        '"""A module."""\ndef f():\n    """A function."""\n    raise ValueError(f"too {long}")\n'
    )
    assert list(words.docstrings(tree)) == [(1, "A module."), (3, "A function.")]
    assert list(words.error_messages(tree)) == [(4, "ValueError(f'too {long}')")]


def test_tests_and_asserts_are_counted_in_functions_and_methods():
    source = (
        "def test_a():\n    assert 1\nclass TestB:\n    def test_a(self):\n        assert 1\n        assert 2"
    )
    names, asserts = compare_tests.count_tests([source, "async def test_c(): ..."])
    assert (dict(names), asserts) == ({"test_a": 2, "test_c": 1}, 3)
