"""The command `stereoweave batch`."""

from typing import Annotated

import typer

from stereoweave.cli.commands import running_command, running_options, shows_steps
from stereoweave.cli.options import (
    AsJson,
    BaselineM,
    Calib,
    FocalPx,
    Format,
    Model,
    Provider,
    Range,
    Raw,
    Rectify,
    Refined,
    make_request,
    parse_range_px,
)

Source = Annotated[
    str,
    typer.Argument(
        help="Folder of pairs and stereo videos: a path, or a URL such as s3://bucket/folder, gs://… or "
        "az://…"
    ),
]
Destination = Annotated[
    str, typer.Argument(help="Folder or URL for the results, either new or from a batch to resume.")
]
Address = Annotated[
    str | None,
    typer.Option(
        help="Ray cluster to run on: host:port or ray://host:port of its head node, auto for one that runs "
        "on this machine, or local for this machine's cores (default: RAY_ADDRESS if set, else local)."
    ),
]
Workers = Annotated[
    int | None,
    typer.Option(min=1, help="Maximum number of workers (default: as many as fit on the cluster)."),
]
CpusEach = Annotated[float, typer.Option(help="CPU cores per worker.")]
GpusEach = Annotated[float, typer.Option(help="GPUs per worker; with 0.25, four workers share one GPU.")]
Write = Annotated[
    list[str] | None,
    typer.Option(metavar="NAME", help="Additional file to write, as for stereoweave depth. Repeatable."),
]


@shows_steps
def batch(  # noqa: PLR0913 - each is an option of the command line
    source: Source,
    destination: Destination,
    address: Address = None,
    workers: Workers = None,
    cpus_each: CpusEach = 1.0,
    gpus_each: GpusEach = 0.0,
    format: Format = None,
    calib: Calib = None,
    focal_px: FocalPx = None,
    baseline_m: BaselineM = None,
    rectify: Rectify = None,
    range_px: Range = None,
    write: Write = None,
    refined: Refined = False,
    raw: Raw = False,
    model: Model = "small",
    provider: Provider = "cpu",
    as_json: AsJson = False,
) -> None:
    """Estimate the depth of an archive of pairs and videos.

    The batch runs on one machine or on a cluster. The results include a manifest: Parquet files with a row
    per pair or video. Rerun the same command to resume after any interruption and to retry failed pairs.
    """
    from stereoweave.batch.cluster import run_cluster_command
    from stereoweave.matching.backend import Backend
    from stereoweave.matching.options import MatchOptions
    from stereoweave.outputs.results import DepthJob
    from stereoweave.system.ray_engine import Engine

    job = DepthJob(
        request=make_request(format, calib, focal_px, baseline_m, rectify),
        backend=Backend(model=model, provider=provider),
        options=MatchOptions(range_px=parse_range_px(range_px), refined=refined, raw=raw),
        files=tuple(write or ()),
        name_of=running_options(),
        command=running_command(),
    )
    engine = Engine(address, workers, cpus_each, gpus_each)
    raise typer.Exit(run_cluster_command(source, destination, job, engine, as_json=as_json))
