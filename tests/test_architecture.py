import ast
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parent.parent
CONTRACTS = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]

# Public despite their underscores: names of named tuples and of the module os.
DOCUMENTED = {"_asdict", "_exit", "_fields", "_replace"}
# Lightning registers this function with atexit; only its name allows removing it.
TOLERATED = {"_destroy_dist_connection"}

# By contract: a file, a line in this file that the contract forbids, and what the report says of it.
BREACHES = {
    "Rooms import downwards": [
        (
            "matching/matcher.py",
            "import stereoweave.cameras.rig",
            "stereoweave.matching.matcher -> stereoweave.cameras.rig",
        ),
        (
            "outputs/report.py",
            "import stereoweave.learn.recipe",
            "stereoweave.outputs.report -> stereoweave.learn.recipe",
        ),
        ("new_file.py", "import stereoweave.stereo", "stereoweave.new_file"),
    ],
    "No circle of imports": [
        ("learn/recipe.py", "import stereoweave.learn.training.loop", ".recipe -> .training"),
        ("synth/world.py", "import stereoweave.synth.stage", ".world -> .stage"),
        ("../experiments/trial.py", "import experiments.paper.trials", ".trial -> .paper"),
    ],
    "One network never imports another": [
        (
            "learn/models/rival.py",
            "import stereoweave.learn.models.weave",
            "stereoweave.learn.models.rival -> stereoweave.learn.models.weave",
        ),
    ],
    "The package imports PyTorch under learn alone, and no experiment": [
        ("io/files.py", "def tensor():\n    import torch", "stereoweave.io.files -> torch"),
        (
            "io/files.py",
            "from lightning_fabric import Fabric",
            "stereoweave.io.files -> lightning_fabric",
        ),
        (
            "learn/checkpoint.py",
            "def trials():\n    import experiments.paper.trials",
            "stereoweave.learn.checkpoint -> experiments.paper.trials",
        ),
    ],
}


def printed_by(program: str) -> str:
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    return done.stdout.strip()


def lint_imports(folder: Path) -> subprocess.CompletedProcess[str]:
    command = [Path(sys.executable).with_name("lint-imports"), "--no-cache"]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


def modules_without_pytorch() -> list[str]:
    files = (path.relative_to(REPOSITORY) for path in (REPOSITORY / "stereoweave").rglob("*.py"))
    names = (".".join(path.with_suffix("").parts).removesuffix(".__init__") for path in files)
    return sorted(name for name in names if not name.startswith("stereoweave.learn"))


def private_names(nodes: Iterable[ast.AST]) -> Iterator[str]:
    """Return the names with one leading underscore that are imported or read as attributes."""
    for node in nodes:
        names: list[str] = []
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load):
            names = [node.attr]
        elif isinstance(node, ast.Import | ast.ImportFrom):
            paths = [alias.name for alias in node.names] + [getattr(node, "module", None) or ""]
            names = [name for path in paths for name in path.split(".")]
        yield from (name for name in names if re.match("_[^_]", name))


def defined_names(nodes: Iterable[ast.AST]) -> Iterator[str]:
    """Return the names of functions, classes, and assigned variables and attributes."""
    for node in nodes:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.id if isinstance(node, ast.Name) else node.attr


def test_importing_the_package_imports_only_itself_and_the_standard_library():
    program = (
        "import sys; before = set(sys.modules); import stereoweave; "
        "after = {name.partition('.')[0] for name in sys.modules.keys() - before}; "
        "print(after - sys.stdlib_module_names)"
    )
    assert printed_by(program) == "{'stereoweave'}"


def test_every_module_outside_learn_can_be_imported_without_pytorch_and_gradio():
    modules = modules_without_pytorch()
    assert "stereoweave.matching.matcher" in modules
    # Imported only by the command `app`.
    for name in (
        "events",
        "frame_panel",
        "page",
        "pair_form",
        "pair_tab",
        "server",
        "stereo_picture_tab",
        "video_tab",
    ):
        modules.remove(f"stereoweave.app.{name}")
    program = (
        f"import sys, {', '.join(modules)}; "
        "print({'torch', 'lightning_fabric', 'gradio', 'onnx', 'skimage'} & sys.modules.keys())"
    )
    assert printed_by(program) == "set()"


def test_the_imports_of_the_package_keep_every_contract():
    done = lint_imports(REPOSITORY)
    assert done.returncode == 0, done.stdout
    assert f"{len(CONTRACTS)} kept, 0 broken" in done.stdout


@pytest.mark.parametrize(("contract", "breaches"), BREACHES.items())
def test_each_breach_of_a_contract_is_caught(tmp_path, contract, breaches):
    for package in ("stereoweave", "experiments"):
        # Another process may be writing the compiled files.
        ignore = shutil.ignore_patterns("__pycache__")
        shutil.copytree(REPOSITORY / package, tmp_path / package, ignore=ignore)
    shutil.copy(REPOSITORY / "pyproject.toml", tmp_path)
    for file, line, _ in breaches:
        with (tmp_path / "stereoweave" / file).open("a") as stream:
            stream.write(f"\n{line}\n")
    done = lint_imports(tmp_path)
    assert done.returncode == 1
    assert re.findall(r"^(.+?) BROKEN", done.stdout, re.MULTILINE) == [contract]
    # Each ends with a line's number or a count of imports.
    told = re.findall(r"^- +(.+?)(?: \(.+\))?$", done.stdout, re.MULTILINE)
    assert sorted(told) == sorted(expected for _, _, expected in breaches)


def test_each_contract_has_a_breach_that_is_tested():
    assert {contract["name"] for contract in CONTRACTS} == set(BREACHES)


def test_no_private_name_of_a_library_is_used():
    files = sorted((REPOSITORY / "stereoweave").rglob("*.py"))
    nodes = [node for file in files for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))]
    assert set(private_names(nodes)) - set(defined_names(nodes)) - DOCUMENTED == TOLERATED


@pytest.mark.parametrize(
    "line",
    [
        "ray._private.worker.show = False",
        "from ray import _raylet",
        "import ray._private.worker as worker",
        "from torch.nn.modules.batchnorm import _BatchNorm",
    ],
)
def test_a_private_name_of_a_library_is_caught(line):
    nodes = list(ast.walk(ast.parse(line)))
    assert set(private_names(nodes)) - set(defined_names(nodes)) - DOCUMENTED
