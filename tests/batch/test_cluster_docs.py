"""docs/cluster.md and its example files: they parse, and agree with each other and the measured rates."""

import csv
import json
import re
import shlex
from pathlib import Path

import jsonschema
import pytest
import ray
import typer
import yaml

from stereoweave.batch.manifest import MOST_IN_A_CHUNK, _make_rows_schema
from stereoweave.cli.root import app

REPOSITORY = Path(__file__).resolve().parents[2]
EXAMPLES = REPOSITORY / "examples" / "cluster"
PAGE = (REPOSITORY / "docs" / "cluster.md").read_text(encoding="utf-8")
RATES = list(csv.DictReader((REPOSITORY / "results" / "cluster.csv").read_text().splitlines()))
MODELS, SIZES = ("small", "base"), ("320x240", "640x480", "1280x720")
PLANS = {"1 million": 10**6, "100 million": 10**8, "10 billion": 10**10}
# The least share of a plain loop's throughput that a cluster keeps.
KEPT = 0.85
FILES_OF_A_PAIR = 5  # if no camera is known
# Fields of ray.io/v1 as KubeRay 1.6 documents them.
JOB_FIELDS = {
    *("activeDeadlineSeconds", "backoffLimit", "clusterSelector", "entrypoint", "entrypointNumCpus"),
    *("entrypointNumGpus", "entrypointResources", "jobId", "metadata", "rayClusterSpec", "runtimeEnvYAML"),
    *("shutdownAfterJobFinishes", "submissionMode", "submitterConfig", "submitterPodTemplate", "suspend"),
    "ttlSecondsAfterFinished",
}
CLUSTER_FIELDS = {
    *("authOptions", "autoscalerOptions", "enableInTreeAutoscaling", "gcsFaultToleranceOptions"),
    *("headGroupSpec", "headServiceAnnotations", "managedBy", "rayVersion", "suspend", "workerGroupSpecs"),
}
GROUP_FIELDS = {
    *("groupName", "idleTimeoutSeconds", "maxReplicas", "minReplicas", "numOfHosts", "rayStartParams"),
    *("replicas", "scaleStrategy", "suspend", "template"),
}


def of_yaml(name):
    return yaml.safe_load((EXAMPLES / name).read_text())


def rate_lines(rates=RATES):
    """Yield the lines of the table of measured rates."""
    measured = {(row["model"], row["size"]): row for row in rates}
    yield "| network | size | pairs per core-hour | read, MB a pair | written, MB a pair |"
    yield "|---|---|---:|---:|---:|"
    for model in MODELS:
        for size in SIZES:
            row = measured[model, size]
            read_mb, written_mb = (float(row[f"{what}_kb"]) / 1000 for what in ("read", "written"))
            rate = int(row["pairs_per_core_hour"])
            yield f"| {model} | {size} | {rate:,} | {read_mb:.2f} | {written_mb:.2f} |"


def plan_lines(rates=RATES):
    """Yield the lines of the table of the resources for each plan, computed for `small` at 640x480."""
    (row,) = (row for row in rates if (row["model"], row["size"]) == ("small", "640x480"))
    yield "| | " + " | ".join(f"{name} pairs" for name in PLANS) + " |"
    yield "|---|" + "---:|" * len(PLANS)
    hours = {count: count / (KEPT * int(row["pairs_per_core_hour"])) for count in PLANS.values()}
    needs = {"core-hours": lambda count: rounded(hours[count])}
    for cores in (2, 64, 1_000, 10_000):
        needs[f"on {cores:,} cores"] = lambda count, cores=cores: duration(hours[count] / cores)
    needs |= {
        "read": lambda count: stored(count * float(row["read_kb"]) * 1e3),
        "written": lambda count: stored(count * float(row["written_kb"]) * 1e3),
        "files, each a request to write": lambda count: f"{FILES_OF_A_PAIR * count / 1e6:,.0f} million",
        "requests to read and to list them": lambda count: f"{3 * count / 1e6:,.0f} million",
        "parts of the manifest": lambda count: f"{count // MOST_IN_A_CHUNK:,}",
        "memory of the driver, 1.1 kB a pair": lambda count: stored(1100 * count),
    }
    for what, need in needs.items():
        yield f"| {what} | " + " | ".join(need(count) for count in PLANS.values()) + " |"


def rounded(number):
    """Return a number as text with two significant figures."""
    return f"{number:.1f}" if number < 9.95 else f"{float(f'{number:.2g}'):,.0f}"


def duration(hours):
    if hours < 1:
        return f"{rounded(60 * hours)} minutes"
    if hours < 48:
        return f"{rounded(hours)} hours"
    days = hours / 24
    return f"{rounded(days)} days" if days < 730 else f"{rounded(days / 365)} years"


def stored(size_bytes):
    for unit, of in (("PB", 1e15), ("TB", 1e12), ("GB", 1e9)):
        if size_bytes >= of:
            return (
                f"{size_bytes / of:.2g} {unit}" if size_bytes < 100 * of else f"{size_bytes / of:.0f} {unit}"
            )
    raise AssertionError(size_bytes)


def commands():
    """Return all stereoweave commands in the page and in the example files."""
    texts = [PAGE, *(path.read_text() for path in EXAMPLES.iterdir())]
    lines = [line for text in texts for line in text.splitlines()]
    found = [
        re.search(r"(?:^|entrypoint: |')(stereoweave (?:batch|synth|bench|serve) [^'#`]*)", line)
        for line in lines
    ]
    return sorted({match[1].strip() for match in found if match})


def test_the_tables_agree_with_the_measured_rates():
    assert [line for line in (*rate_lines(), *plan_lines()) if line not in PAGE.splitlines()] == []


@pytest.mark.parametrize("line", commands())
def test_each_command_uses_existing_options(line):
    words = shlex.split(line)[1:]
    command = typer.main.get_command(app)
    while hasattr(command, "commands"):
        command = command.commands[words.pop(0)]
    command.make_context("stereoweave", words)


def test_the_options_that_the_page_names_exist():
    named = set(re.findall(r"`(--[a-z-]+)[ `]", PAGE))
    command = typer.main.get_command(app)
    options = set()
    for words in (("batch",), ("synth", "make"), ("bench", "pairs")):
        found = command
        for word in words:
            found = found.commands[word]
        options |= {option for parameter in found.params for option in parameter.opts}
    assert named - options == set()


def test_the_cluster_file_matches_the_schema_of_rays_launcher():
    config = of_yaml("ray-cluster.yaml")
    schema = json.loads((Path(ray.__file__).parent / "autoscaler" / "ray-schema.json").read_text())
    jsonschema.validate(config, schema)
    assert config["head_node_type"] in config["available_node_types"]
    workers = config["available_node_types"]["worker"]
    assert workers["min_workers"] <= workers["max_workers"] <= config["max_workers"]


def test_the_kubernetes_manifest_has_only_fields_that_kuberay_documents():
    job = of_yaml("rayjob.yaml")
    assert (job["apiVersion"], job["kind"]) == ("ray.io/v1", "RayJob")
    assert job["spec"].keys() <= JOB_FIELDS
    cluster = job["spec"]["rayClusterSpec"]
    assert cluster.keys() <= CLUSTER_FIELDS
    assert cluster["authOptions"] == {"mode": "token"}
    (workers,) = cluster["workerGroupSpecs"]
    assert workers.keys() <= GROUP_FIELDS
    assert workers["minReplicas"] <= workers["replicas"] <= workers["maxReplicas"]
    for group in (cluster["headGroupSpec"], workers):
        assert all(isinstance(value, str) for value in group["rayStartParams"].values())
        (container,) = group["template"]["spec"]["containers"]
        assert container["image"] == of_yaml("ray-cluster.yaml")["docker"]["image"]
        assert container["resources"]["requests"] == container["resources"]["limits"]


def test_one_version_of_ray_is_named_everywhere():
    texts = [PAGE, *(path.read_text() for path in EXAMPLES.iterdir())]
    named = {version for text in texts for version in re.findall(r"ray[^ \n]*?[:=-](2\.\d+\.\d+)", text)}
    assert named == {of_yaml("rayjob.yaml")["spec"]["rayClusterSpec"]["rayVersion"]}
    assert int(named.pop().split(".")[1]) >= 54  # the minimum of the extra `cluster`


def test_the_page_names_all_columns_of_the_manifest_in_order():
    (table,) = re.findall(r"\| column \|.*?\n\n", PAGE, re.DOTALL)
    names = re.findall(r"`(\w+)`", "".join(line.split("|")[1] for line in table.split("\n") if line))
    assert names == _make_rows_schema().names


def test_links_lead_to_existing_files():
    links = re.findall(r"\]\(([^)#]+)\)", PAGE)
    missing = [link for link in links if "://" not in link and not (REPOSITORY / "docs" / link).exists()]
    assert missing == []
