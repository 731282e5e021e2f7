"""Check a release: python -m release.check WHEEL SDIST.

Compares the contents of both files with the files that git tracks. Then, for every supported Python on this
machine, installs each file in an empty environment and runs it on the example pair.
"""

import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = "stereoweave"
# The first version, the oldest that pyproject.toml allows, is required. Later ones are tried if installed.
VERSIONS = ("3.11", "3.12", "3.13", "3.14")
# Files that setuptools adds to a source distribution.
_GENERATED = ("PKG-INFO", "setup.cfg", f"{PACKAGE}.egg-info/")


def tracked_files(root: Path) -> set[str]:
    """Return the files that git tracks, relative to the root."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=root, capture_output=True, text=True, check=True)
    return set(filter(None, listed.stdout.split("\0")))


def wheel_files(wheel: Path) -> set[str]:
    """Return the files that a wheel installs, without its metadata."""
    with zipfile.ZipFile(wheel) as archive:
        return {name for name in archive.namelist() if ".dist-info/" not in name}


def sdist_files(sdist: Path) -> set[str]:
    """Return the files of a source distribution, without those that setuptools adds."""
    with tarfile.open(sdist) as archive:
        names = {member.name.partition("/")[2] for member in archive if member.isfile()}
    return {name for name in names if not name.startswith(_GENERATED)}


def differences(file: Path, expected: set[str], found: set[str]) -> list[str]:
    """Return a line for each path that the release file lacks or that git does not track."""
    missing = [f"{file.name}: {name} is missing" for name in sorted(expected - found)]
    return missing + [f"{file.name}: {name} is not tracked by git" for name in sorted(found - expected)]


def content_differences(wheel: Path, sdist: Path) -> list[str]:
    """Return a line for each difference between the release files and the repository."""
    tracked = tracked_files(ROOT)
    package = {name for name in tracked if name.startswith(f"{PACKAGE}/")}
    return [
        *differences(wheel, package, wheel_files(wheel)),
        *differences(sdist, tracked, sdist_files(sdist)),
    ]


def python_here(version: str) -> Path | None:
    """Return the interpreter of a version, from the PATH or from pyenv; None if there is none.

    The folders of pyenv are searched because its shims run only activated versions.
    """
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"))
    on_path = shutil.which(f"python{version}")
    candidates = [Path(on_path)] if on_path else []
    candidates += sorted(pyenv.glob(f"versions/{version}.*/bin/python"))
    return next((python for python in candidates if _answers(python, version)), None)


def _answers(python: Path, version: str) -> bool:
    program = "import sys; print('{}.{}'.format(*sys.version_info))"
    done = subprocess.run([python, "-c", program], capture_output=True, text=True, check=False)
    return done.returncode == 0 and done.stdout.strip() == version


def run(command: Iterable[str | Path], folder: Path) -> str:
    """Run a command in a folder, without the repository on Python's path. Return its output.

    Raises:
        SystemExit: The command failed; the message contains its output.
    """
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    environment["NUMBA_CACHE_DIR"] = str(folder / "kernels")
    words = list(map(str, command))
    done = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(words)} failed:\n{done.stdout}{done.stderr}")
    return done.stdout.strip()


def try_out(file: Path, python: Path, folder: Path) -> None:
    """Install a release file in an empty environment, and compute depth and a view of the example pair.

    Raises:
        SystemExit: A step failed, or the imported package is not the installed one.
    """
    environment = folder / "env"
    run([python, "-m", "venv", environment], folder)
    run([environment / "bin/python", "-m", "pip", "install", "--quiet", "--no-compile", file], folder)
    program = f"import {PACKAGE}; print({PACKAGE}.__version__, {PACKAGE}.__file__)"
    version, place = run([environment / "bin/python", "-c", program], folder).split(maxsplit=1)
    if f"-{version}" not in file.name or not Path(place).is_relative_to(environment):
        raise SystemExit(f"{file.name}: expected its version in {environment}, found {version} in {place}")
    command, examples = environment / f"bin/{PACKAGE}", ROOT / "examples"
    pair = [examples / "left.png", examples / "right.png"]
    run([command, "depth", *pair, "--calib", examples / "calib.txt", "--out", "depth"], folder)
    run([command, "view", *pair, "--position", "0.5", "--out", "view.png"], folder)
    for made in ("depth/disparity.pfm", "depth/depth.png", "depth/report.html", "view.png"):
        if not (folder / made).is_file():
            raise SystemExit(f"{file.name}: expected its commands to write {made}, found no such file")


def main(wheel: Path, sdist: Path) -> None:
    """Check a wheel and a source distribution.

    Raises:
        SystemExit: A file differs from the repository, does not install or does not run.
    """
    if different := content_differences(wheel, sdist):
        raise SystemExit("\n".join(different))
    print(f"{wheel.name}, {sdist.name}: all files of the repository and no others")
    pythons = {version: python_here(version) for version in VERSIONS}
    if pythons[VERSIONS[0]] is None:
        raise SystemExit(f"Python {VERSIONS[0]}, the oldest supported version: not on this machine")
    for version, python in pythons.items():
        if python is None:
            print(f"Python {version}: not on this machine")
            continue
        for file in (wheel, sdist):
            with tempfile.TemporaryDirectory() as folder:
                try_out(file.resolve(), python, Path(folder).resolve())
            print(f"Python {version}: {file.name} installs and runs", flush=True)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
