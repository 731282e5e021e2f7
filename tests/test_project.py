"""The project's metadata: files at the root that repeat what the package and pyproject.toml say."""

import tomllib
from pathlib import Path

import yaml

import stereoweave

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
