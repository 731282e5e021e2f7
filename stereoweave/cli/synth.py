"""The commands `stereoweave synth make | check | sheet | costs`."""

import os
from pathlib import Path
from typing import Annotated

import typer

from stereoweave.cli.commands import Commands, shows_steps
from stereoweave.cli.options import Cluster, make_engine, parse_size_px, require_synth_extra
from stereoweave.errors import StereoweaveError

synth = Commands("Render and check stereo pairs with exact ground truth.")

# Listed here so that --help imports nothing heavy.
SCENE_NAMES = (
    "antenna", "boards", "bridge", "crane", "figures", "propeller", "pylon", "refinery", "rooms", "ship",
    "street", "wind_turbine",
)  # fmt: skip

Scene = Annotated[str, typer.Argument(help=f"One of {', '.join(SCENE_NAMES)}.")]
Jobs = Annotated[int | None, typer.Option(min=1, help="Number of processes (default: all cores).")]


NewSet = Annotated[
    Path, typer.Option("--out", "-o", help="Folder of the set: a new one, or one to resume or extend.")
]
Pairs = Annotated[
    int | None, typer.Option(min=1, help="Number of pairs in the finished set, unless --worlds is given.")
]
Worlds = Annotated[
    int | None,
    typer.Option(
        min=1,
        help="Number of worlds in the finished set, each with one video of --frames pairs from a camera "
        "that keeps moving around the target; the set also holds the camera's poses.",
    ),
]
Seed = Annotated[int, typer.Option(min=0, help="Random seed.")]
Size = Annotated[str, typer.Option(help="Width and height in pixels.")]
Plain = Annotated[
    bool, typer.Option("--plain", help="Render faster, without shadows, gloss or other effects.")
]
Layout = Annotated[
    str, typer.Option(help="Layout of the set: shards (tar files), or paper (folders left, right and depth).")
]
Frames = Annotated[
    int, typer.Option(min=1, help="Number of pairs per video from a moving camera; 1 makes stills.")
]
Views = Annotated[
    list[float] | None,
    typer.Option(
        help="Position of an additional view, from -1 to 2; 0.5 is halfway between the cameras. Repeatable."
    ),
]
Rig = Annotated[
    tuple[float, float] | None,
    typer.Option(
        metavar="FOCAL_PX BASELINE_M",
        help="Focal length in pixels and baseline in metres of all pairs (default: random for each "
        "pair; with --worlds, 0.825 times the width, and 0.5 m).",
    ),
]
Distance = Annotated[
    tuple[float, float] | None,
    typer.Option(
        metavar="NEAR_M FAR_M",
        help="With --worlds, least and greatest distance of the cameras from the target's centre in "
        "metres (default: the nearer half of the scene's).",
    ),
]
ShardJobs = Annotated[
    int | None,
    typer.Option(min=1, help="Number of processes (default: all cores); each makes shards of 50 pairs."),
]


@synth.command()
@shows_steps
def make(  # noqa: PLR0913 - each is an option of the command
    scene: Scene,
    out: NewSet,
    pairs: Pairs = None,
    worlds: Worlds = None,
    seed: Seed = 0,
    size: Size = "640x480",
    plain: Plain = False,
    layout: Layout = "shards",
    frames: Frames = 1,
    view: Views = None,
    rig: Rig = None,
    distance: Distance = None,
    jobs: ShardJobs = None,
    cluster: Cluster = None,
) -> None:
    """Render a set of pairs, or resume or extend an existing one."""
    with require_synth_extra():
        from stereoweave.synth.sets.make import PairRenderer
        from stereoweave.synth.sets.make import make as make_set
        from stereoweave.synth.sets.pair_rendering import RenderSpec
    count = _count_pairs(pairs, worlds, frames)
    spec = RenderSpec(
        scene=scene,
        seed=seed,
        size_px=parse_size_px(size),
        frames=frames,
        views=tuple(view or ()),
        rig=rig,
        by_world=worlds is not None,
        distance_m=distance,
    )
    pair_maker, engine = PairRenderer(plain), make_engine(cluster, workers=jobs)
    made = make_set(spec, count, out, layout=layout, jobs=_jobs(jobs), engine=engine, pair_maker=pair_maker)
    typer.echo(f"{out}: {made} pair{'s' * (made != 1)} made, {count - made} already there")


@synth.command()
@shows_steps
def check(
    folder: Annotated[Path, typer.Argument(help="Folder of a set made by synth make.")], jobs: Jobs = None
) -> None:
    """Check a set's checksums and disparities, and print statistics.

    The exit status is 1 if a check fails.
    """
    from stereoweave.synth.sets.check import check_set, report_lines

    found = check_set(folder, _jobs(jobs))
    typer.echo("\n".join(report_lines(found)))
    if found.problems:
        raise typer.Exit(1)


@synth.command()
@shows_steps
def sheet(
    out: Annotated[Path, typer.Option("--out", "-o", help="Picture to write.")],
    seed: Annotated[int, typer.Option(min=0, help="Random seed, as for synth make.")] = 0,
    quiz: Annotated[
        bool, typer.Option("--quiz", help="Show 16 unlabelled left pictures, and print their scenes.")
    ] = False,
) -> None:
    """Write a contact sheet with a row per scene.

    A row shows the left and the right picture, depth, and both occlusion masks.
    """
    from stereoweave.io.images import picture_kind, write_image

    picture_kind(out)
    with require_synth_extra():
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
@shows_steps
def costs(
    scene: Scene = "propeller",
    pairs: Annotated[int, typer.Option(min=1, help="Number of pairs to average over.")] = 3,
) -> None:
    """Measure the time of each rendering effect.

    Times are in milliseconds per 640x480 pair on one core.
    """
    # One thread, as in each process of synth make; Mesa reads the variable when the renderer starts.
    os.environ["LP_NUM_THREADS"] = "1"
    with require_synth_extra():
        from stereoweave.synth.sets.effect_costs import measure_effect_costs
    for cost in measure_effect_costs(scene, pairs):
        typer.echo(f"{cost.ms_a_pair:6.0f} ms  {cost.effect}")


def _count_pairs(pairs: int | None, worlds: int | None, frames: int) -> int:
    if worlds is None and pairs is not None:
        return pairs
    if pairs is None and worlds is not None:
        return worlds * frames
    raise StereoweaveError(
        "expected a number of pairs, or of worlds with --frames pairs each, found "
        f"{'neither' if pairs is None else 'both'}",
        setting="pairs",
    )


def _jobs(jobs: int | None) -> int:
    from stereoweave.system.threads import usable_cores

    return jobs or usable_cores()
