"""The command stereoweave batch."""

from typing import Annotated

import typer

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
    option_name,
    range_of,
    request_of,
)

Source = Annotated[
    str,
    typer.Argument(help="Pairs and films: a folder, or s3://bucket/folder, gs://bucket/folder, az://…"),
]
Destination = Annotated[
    str, typer.Argument(help="Where the results go: a new folder or URL, or one that this was begun in.")
]
Address = Annotated[
    str | None,
    typer.Option(
        help="The Ray cluster to work on: host:port or ray://host:port of its head, auto for one that runs "
        "here, local for this machine's cores. RAY_ADDRESS, or else local, unless given."
    ),
]
Workers = Annotated[
    int | None, typer.Option(min=1, help="At most so many; as many as find room unless given.")
]
CpusEach = Annotated[float, typer.Option(help="Processor cores for each worker.")]
GpusEach = Annotated[float, typer.Option(help="GPUs for each worker: with 0.25 four share one.")]
Write = Annotated[
    list[str] | None,
    typer.Option(metavar="NAME", help="A further file to write, as `stereoweave depth` knows them, or all."),
]


def batch(  # noqa: PLR0913 - each is a word of the command line
    source: Source,
    destination: Destination,
    address: Address = None,
    workers: Workers = None,
    cpus_each: CpusEach = 1.0,
    gpus_each: GpusEach = 0.0,
    arrangement: Format = None,
    calib: Calib = None,
    focal_px: FocalPx = None,
    baseline_m: BaselineM = None,
    rectify: Rectify = False,
    range_px: Range = None,
    write: Write = None,
    refined: Refined = False,
    raw: Raw = False,
    model: Model = "small",
    provider: Provider = "cpu",
    as_json: AsJson = False,
) -> None:
    """Depth of an archive of pairs and films, on one machine or a cluster, with a row for each in Parquet.

    Stopped in whatever way, the same command goes on, and tries again what failed.
    """
    from stereoweave.batch.cluster import batch_on_cluster
    from stereoweave.matching.backend import Backend
    from stereoweave.matching.options import MatchOptions
    from stereoweave.outputs.results import DepthJob
    from stereoweave.system.ray_engine import Engine

    job = DepthJob(
        request=request_of(arrangement, calib, focal_px, baseline_m, rectify),
        backend=Backend(model=model, provider=provider),
        options=MatchOptions(range_px=range_of(range_px), refined=refined, raw=raw),
        files=tuple(write or ()),
        name_of=option_name,
    )
    engine = Engine(address, workers, cpus_each, gpus_each)
    raise typer.Exit(batch_on_cluster(source, destination, job, engine, as_json=as_json))
