"""Files at the root agree with the package and pyproject.toml."""

import ast
import re
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
import yaml

import stereoweave
from mutate.trees import repository_files

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def test_the_citation_names_the_package_its_version_and_its_licence():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["title"].lower() == PROJECT["name"]
    assert citation["version"] == stereoweave.__version__
    assert citation["license"] == PROJECT["license"]
    assert citation["keywords"] == PROJECT["keywords"]


def test_the_citation_refers_to_the_paper():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    (paper,) = citation["references"]
    assert f'# "{paper["title"]}"' in (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")
    names = [author["family-names"] for author in paper["authors"]]
    assert names == ["Anantrasirichai", "Geravand", "Braendler", "Bull"]


def imported_packages():
    modules = set()
    for path in (ROOT / "stereoweave").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                modules |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                modules.add(node.module.partition(".")[0])
    return modules - sys.stdlib_module_names - {"stereoweave"}


def normalise(distribution):
    return re.sub(r"[-_.]+", "-", distribution).lower()


def test_every_imported_package_is_declared():
    # Dependencies of ray[serve], on which the service runs, and of the file systems for object stores.
    required_by_declared = {"fastapi", "starlette", "uvicorn", "fsspec"}
    lines = [*PROJECT["dependencies"], *sum(PROJECT["optional-dependencies"].values(), [])]
    declared = {normalise(re.match(r"[\w.-]+", line)[0]) for line in lines} | required_by_declared
    distributions = packages_distributions()
    missing = {
        module
        for module in imported_packages()
        if not declared.intersection(map(normalise, distributions.get(module, [])))
    }
    assert missing == set()


def hooks():
    (repository,) = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]
    assert repository["repo"] == "local"
    return {hook["id"]: hook for hook in repository["hooks"]}


def test_pre_commit_runs_the_tools_that_constraints_txt_pins():
    packages = {"ruff": "ruff", "check-added-large-files": "pre-commit-hooks"}
    programs = [re.match(r"\.venv/bin/(\S+) ", hook["entry"])[1] for hook in hooks().values()]
    assert set(programs) == set(packages)
    pinned = re.findall(r"^([\w-]+)==", (ROOT / "constraints.txt").read_text(), re.MULTILINE)
    needed = {re.match(r"[\w-]+", line)[0] for line in PROJECT["optional-dependencies"]["dev"]}
    for package in {"pre-commit", *packages.values()}:
        assert package in pinned
        assert package in needed


@pytest.mark.needs_git
def test_only_trained_networks_are_larger_than_500_kb():
    hook = hooks()["check-added-large-files"]
    assert "--maxkb=500" in hook["entry"]
    large = [name for name in repository_files(ROOT) if (ROOT / name).stat().st_size > 500 * 1024]
    assert [name for name in large if not re.search(hook["exclude"], name)] == []


@pytest.mark.needs_git
def test_the_tree_stays_below_30_mb():
    assert sum((ROOT / name).stat().st_size for name in repository_files(ROOT)) < 30e6
