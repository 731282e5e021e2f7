"""The commands stereoweave synth make | check | sheet | costs."""

import os
from pathlib import Path
from typing import Annotated

import typer

from stereoweave.cli.options import Cluster, engine_of, needing_the_synth_extra, parse_size_px

synth = typer.Typer(help="Rendered stereo with exact ground truth: make it, check it, look at it.")

# Named here, because the help imports nothing heavy.
SCENE_NAMES = (
    "antenna", "boards", "bridge", "crane", "figures", "propeller", "pylon", "refinery", "rooms", "ship",
    "street", "wind_turbine",
)  # fmt: skip

Scene = Annotated[str, typer.Argument(help=f"One of {', '.join(SCENE_NAMES)}.")]
Jobs = Annotated[int | None, typer.Option(min=1, help="Processes; as many as cores unless given.")]


@synth.command()
def make(  # noqa: PLR0913 - each is a word of the command line
    scene: Scene,
    pairs: Annotated[int, typer.Option(min=1, help="How many there shall be in the folder.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The folder of the set.")],
    seed: Annotated[int, typer.Option(min=0, help="Another one gives other pairs.")] = 0,
    size: Annotated[str, typer.Option(help="Width and height in pixels.")] = "640x480",
    plain: Annotated[
        bool, typer.Option("--plain", help="Without shadows, gloss and the like: faster.")
    ] = False,
    layout: Annotated[str, typer.Option(help="shards, or paper: folders left, right and depth.")] = "shards",
    frames: Annotated[int, typer.Option(min=1, help="Pairs in a row as a film, from a moving camera.")] = 1,
    view: Annotated[
        list[float] | None,
        typer.Option(help="A further picture, 0.5 from half way, -1 to 2; again for more."),
    ] = None,
    rig: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="FOCAL_PX BASELINE_M", help="Of all pairs; drawn for each unless given."),
    ] = None,
    jobs: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Processes, as many as cores unless given; each makes a shard of 50 pairs at a time.",
        ),
    ] = None,
    cluster: Cluster = None,
) -> None:
    """Make a set of rendered pairs, or go on with one that was stopped or shall have more."""
    with needing_the_synth_extra():
        from stereoweave.synth.sets.make import PairRenderer
        from stereoweave.synth.sets.make import make as make_set
        from stereoweave.synth.sets.pair_rendering import RenderSpec
    spec = RenderSpec(
        scene=scene, seed=seed, size_px=parse_size_px(size), frames=frames, views=tuple(view or ()), rig=rig
    )
    pair_maker, engine = PairRenderer(plain), engine_of(cluster, workers=jobs)
    made = make_set(spec, pairs, out, layout=layout, jobs=_jobs(jobs), engine=engine, pair_maker=pair_maker)
    typer.echo(f"{out}: {made} pair{'s' * (made != 1)} made, {pairs - made} there before")


@synth.command()
def check(folder: Annotated[Path, typer.Argument(help="What synth make made.")], jobs: Jobs = None) -> None:
    """Check a set: checksums, disparity against the pictures, statistics; exit status 1 if one is wrong."""
    from stereoweave.synth.sets.check import check_set, report_lines

    found = check_set(folder, _jobs(jobs))
    typer.echo("\n".join(report_lines(found)))
    if found.problems:
        raise typer.Exit(1)


@synth.command()
def sheet(
    out: Annotated[Path, typer.Option("--out", "-o", help="The picture to write.")],
    seed: Annotated[int, typer.Option(min=0, help="As for make.")] = 0,
    quiz: Annotated[
        bool, typer.Option("--quiz", help="16 left pictures without a label; what they show is printed.")
    ] = False,
) -> None:
    """A picture of all scenes, a row each: left, right, depth, and what one camera alone sees."""
    from stereoweave.io.files import picture_kind, write_image

    picture_kind(out)
    with needing_the_synth_extra():
        from stereoweave.synth.scenes import SCENES
        from stereoweave.synth.sets.contact_sheet import contact_sheet, quiz_sheet
        from stereoweave.synth.sets.renderers import shared_renderer
    if quiz:
        picture, answers = quiz_sheet(
            shared_renderer(), [name for name in SCENES if name not in ("boards", "rooms")], seed
        )
        typer.echo("by row: " + ", ".join(answers))
    else:
        picture = contact_sheet(shared_renderer(), list(SCENES), seed)
    write_image(out, picture)
    typer.echo(f"{out}: {picture.shape[1]}x{picture.shape[0]} pixels")


@synth.command()
def costs(
    scene: Scene = "propeller",
    pairs: Annotated[int, typer.Option(min=1, help="How many, of which the mean is told.")] = 3,
) -> None:
    """Measure what each effect of the renderer costs: milliseconds of one core for a pair of 640x480."""
    # As in `make`: Mesa reads it when the renderer starts.
    os.environ["LP_NUM_THREADS"] = "1"
    with needing_the_synth_extra():
        from stereoweave.synth.sets.effect_costs import measure_effect_costs
    for cost in measure_effect_costs(scene, pairs):
        typer.echo(f"{cost.ms_a_pair:6.0f} ms  {cost.effect}")


def _jobs(jobs: int | None) -> int:
    from stereoweave.system.threads import usable_cores

    return jobs or usable_cores()
