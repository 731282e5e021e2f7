"""Every setting that an error or a remedy names has a name in some front end; every remedy is tested."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer

import stereoweave as sw
from stereoweave.app.pair_form import label_of
from stereoweave.cli.commands import option_names
from stereoweave.cli.root import app
from stereoweave.service.answers import field_name

# A warning by Pydantic about Ray Serve when that is imported.
pytestmark = pytest.mark.filterwarnings("ignore:Using extra keyword arguments on `Field`:DeprecationWarning")

PACKAGE = Path(sw.__file__).parent
TESTS = Path(__file__).parent
# Settings that no constant names, by module and expression.
VARIABLE: dict[tuple[str, str], set[str]] = {
    ("batch/worker.py", "given"): {
        *("calibration", "focal_px", "baseline_m", "range_px", "refined", "raw", "files"),
    },
    ("cameras/spherical.py", "given[0]"): {"whole", "look_deg", "fov_deg", "lens_fov_deg"},
    ("arguments.py", "setting"): {"range_px", "look_deg"},
    ("cameras/spherical.py", "setting"): {"look_deg", "fov_deg"},
    ("app/pair_form.py", "setting"): {"focal_px", "baseline_m"},
    ("errors.py", "error.setting"): set(),  # of an error that another one takes the place of
    ("io/files.py", "setting"): {"out", "timeline"},
    ("outputs/sphere_views.py", "setting"): {"up", "forward", "size_px", "crop"},
    ("pictures/pair_finding.py", "side"): {"left", "right"},
    ("rendering/renderer.py", "name"): {"up", "forward"},
    ("stereo.py", "name"): {"focal_px", "baseline_m"},
    ("synth/sets/make.py", "name"): {"pairs", "seed", "frames"},
    ("video/job.py", "setting"): {"strength", "convergence_px"},
    ("video/job.py", "tuple(kinds)"): {"depth", "depth10", "depth16", "position", "layout"},
}
# Subpackages whose errors reach the page and the service.
SHARED = {"cameras", "matching", "outputs", "pictures", "rendering"}
# Settings of these subpackages that the page and the service do not offer.
ABSENT = {
    "page": {
        *("align", "board", "convergence_px", "files", "forward", "layout", "left"),
        *("listed", "out", "provider", "quilt", "range_px", "raw", "refined"),
        *("right", "screen", "strength", "up"),
        *("projection", "look_deg", "fov_deg", "lens_fov_deg", "whole", "size_px"),
    },
    "service": {
        *("align", "board", "convergence_px", "crop", "files", "forward", "layout", "left"),
        *("listed", "no_rectify", "out", "provider", "quilt", "raw"),
        *("right", "screen", "up"),
        *("projection", "look_deg", "fov_deg", "lens_fov_deg", "whole", "size_px"),
    },
}


def find_calls() -> Iterator[tuple[str, ast.Call]]:
    """Yield all calls in the package, each with its module."""
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call):
                yield path.relative_to(PACKAGE).as_posix(), node


def is_remedy(call: ast.Call) -> bool:
    return isinstance(call.func, ast.Name) and call.func.id == "Remedy"


def find_settings() -> Iterator[tuple[str, str]]:
    """Yield each setting that an error or a remedy names, with its module."""
    for module, call in find_calls():
        values = [keyword.value for keyword in call.keywords if keyword.arg == "setting"]
        if isinstance(call.func, ast.Name) and call.func.id == "check_choice":
            values += call.args[:1]
        if is_remedy(call):
            values += [*call.args[1:], *(keyword.value for keyword in call.keywords)]
        for value in values:
            for part in value.elts if isinstance(value, ast.Tuple) else [value]:
                known = isinstance(part, ast.Constant)
                names = [part.value] if known else VARIABLE[module, ast.unparse(part)]
                yield from ((module, name) for name in names)


def list_commands(group):
    for command in group.commands.values():
        yield from list_commands(command) if hasattr(command, "commands") else [command]


SETTINGS = set(find_settings())
SHARED_SETTINGS = {setting for module, setting in SETTINGS if module.split("/")[0] in SHARED}


def test_a_command_has_an_option_for_each_setting():
    options = [option_names(command) for command in list_commands(typer.main.get_command(app))]
    unknown = {name for _, name in SETTINGS if not any(option_of(name) for option_of in options)}
    # Settings of recipes, of Python and of the page only, and an argument.
    assert unknown == {"split", "align", "start_s", "texture", "scene"}


def test_the_service_has_a_field_for_each_setting_that_it_offers():
    assert {name for name in SHARED_SETTINGS if not field_name(name)} == ABSENT["service"]


def test_the_page_has_a_label_for_each_setting_that_it_offers():
    assert {name for name in SHARED_SETTINGS if not label_of(name)} == ABSENT["page"]


def find_strings(node: ast.AST) -> Iterator[str]:
    for part in ast.walk(node):
        if isinstance(part, ast.Constant) and isinstance(part.value, str):
            yield part.value


def test_each_remedy_s_text_is_in_a_test():
    sources = (path.read_text() for path in TESTS.rglob("*.py"))
    tested = "\n".join(re.sub(r"""["']\s+f?["']""", "", source) for source in sources)
    remedies = {part for _, call in find_calls() if is_remedy(call) for part in find_strings(call.args[0])}
    assert len(remedies) > 20
    assert {text for text in remedies if text.strip() not in tested} == set()
