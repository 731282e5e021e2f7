"""What the commands share: words of the command line, and what they do before they work."""

import math
import re
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from ipaddress import ip_address
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stereoweave.errors import StereoweaveError, needing_extra

if TYPE_CHECKING:
    from stereoweave.pictures.prepare import Request
    from stereoweave.system.ray_engine import Engine

Pictures = Annotated[
    list[Path],
    typer.Argument(metavar="PICTURE", help="LEFT RIGHT, of one size; or one picture with both views."),
]
Format = Annotated[
    str | None,
    typer.Option(
        "--format",
        help="How one picture holds both views: side_by_side, side_by_side_half, crossed, crossed_half, "
        "top_bottom, top_bottom_half, top_bottom_right_first, top_bottom_right_first_half, mpo, jps; found "
        "out unless given.",
    ),
]
Calib = Annotated[
    Path | None,
    typer.Option(
        help="The cameras' calibration, for metres and --rectify: of OpenCV, Kalibr, KITTI, Middlebury."
    ),
]
FocalPx = Annotated[
    float | None, typer.Option(help="Without a calibration, for metres: the focal length in pixels.")
]
BaselineM = Annotated[float | None, typer.Option(help="And the distance between the two cameras in metres.")]
Rectify = Annotated[
    bool,
    typer.Option(
        "--rectify", help="Bring the rows of both to match: by the calibration, or without one by features."
    ),
]
Range = Annotated[
    str | None,
    typer.Option(
        "--range",
        metavar="LOW,HIGH",
        help="The least and the greatest disparity in pixels; found out unless given.",
    ),
]
Refined = Annotated[
    bool,
    typer.Option(
        "--refined",
        help="Match once more, at full resolution up to 2 megapixels: thin things, sharper edges.",
    ),
]
Raw = Annotated[
    bool,
    typer.Option(
        "--raw",
        help="The network's own disparity: occluded pixels not filled, nothing brought to a part of a pixel.",
    ),
]
Strength = Annotated[
    float, typer.Option(min=0, help="Multiplies the distance of the cameras, about their middle.")
]
Model = Annotated[
    str,
    typer.Option(
        help="The name of a shipped network, or an .onnx file; or best, for stills: base, once more at 1.5 "
        "times the size, and refined."
    ),
]
Threads = Annotated[int | None, typer.Option(min=1, help="Processor threads; as many as cores unless given.")]
Cluster = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="Work on a Ray cluster: host:port or ray://host:port of its head, auto for one that runs here, "
        "local for this machine's cores. All its nodes have to see the folder under the same name. Extra "
        "'cluster'.",
    ),
]
Provider = Annotated[
    str,
    typer.Option(
        help="What the network is run on: cpu; cuda or tensorrt (NVIDIA's GPUs), openvino (Intel's "
        "processors), coreml (macOS), directml (Windows). What one needs, it says where that is missing."
    ),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
Host = Annotated[
    str,
    typer.Option(
        help="The address to serve. 127.0.0.1 is this computer alone; 0.0.0.0 is everyone in its networks."
    ),
]
Port = Annotated[int, typer.Option(min=0, max=65535, help="0 takes any that is free.")]

# Options that are not called after their setting's keyword.
_OPTIONS = {
    "arrangement": "--format",
    "calibration": "--calib",
    "convergence_px": "--convergence",
    "files": "--write",
    "listed": "--list",
    "range_px": "--range",
    "size_px": "--size",
    "views": "--view",
}


def option_name(setting: str) -> str:
    """The option for a setting, given its Python keyword."""
    return _OPTIONS.get(setting, f"--{setting.replace('_', '-')}")


def video_option_name(setting: str) -> str | None:
    """The option of the commands for video, which cannot rectify."""
    if setting == "arrangement":
        return "--arrangement"
    return None if setting == "rectify" else option_name(setting)


@contextmanager
def naming_video_options() -> Iterator[None]:
    """Errors name the options of the commands for video."""
    try:
        yield
    except StereoweaveError as error:
        raise type(error)(error.worded(video_option_name)) from error


def request_of(
    arrangement: str | None = None,
    calib: Path | None = None,
    focal_px: float | None = None,
    baseline_m: float | None = None,
    rectify: bool = False,
) -> "Request":
    """What a command was told of a pair beside its pictures."""
    from stereoweave.pictures.prepare import Request

    return Request(
        arrangement=arrangement,
        calibration=calib,
        focal_px=focal_px,
        baseline_m=baseline_m,
        rectify=rectify,
    )


def range_of(text: str | None) -> tuple[float, float] | None:
    """The least and the greatest disparity of --range, None where it is not given."""
    if text is None:
        return None
    low_px, high_px = _two_numbers("--range", text, "the least and the greatest disparity, such as -20,150")
    if low_px >= high_px:
        raise StereoweaveError(f"--range: expected the least disparity first, found {text!r}")
    return low_px, high_px


def pixel_of(option: str, text: str) -> tuple[int, int]:
    """Column and row that the words of an option name."""
    column, row = _two_numbers(option, text, "column and row of a pixel, such as 320,240")
    return round(column), round(row)


def _two_numbers(option: str, text: str, expected: str) -> tuple[float, float]:
    try:
        first, second = (float(word) for word in text.split(","))
    except ValueError:
        first = second = math.nan
    if not (math.isfinite(first) and math.isfinite(second)):
        raise StereoweaveError(f"{option}: expected {expected}, found {text!r}")
    return first, second


def engine_of(cluster: str | None, workers: int | None = None, cpus_each: float = 1) -> "Engine | None":
    """Where a command's work is done; None where it is not to be a cluster."""
    from stereoweave.system.ray_engine import Engine

    return Engine(cluster, workers, cpus_each) if cluster else None


def parse_size_px(size: str) -> tuple[int, int]:
    """Width and height of --size."""
    found = re.fullmatch("([0-9]{1,9})x([0-9]{1,9})", size)
    if found is None:
        raise StereoweaveError(f"--size: expected width x height in pixels, such as 640x480, found {size!r}")
    return int(found[1]), int(found[2])


def make_parent_folder(*files: Path) -> Path:
    """As `io.make_parent_folder`, which is imported where it is needed alone."""
    from stereoweave.io import files as io

    return io.make_parent_folder(*files)


def listening(host: str, port: int) -> socket.socket:
    """A socket that listens there; an error in one line where that cannot be."""
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        return socket.create_server(address[:2], family=family)
    except OSError as error:
        raise StereoweaveError(
            f"--host {host} --port {port}: expected an address that is free, found {str(error).lower()}; "
            "--port 0 takes any port that is free"
        ) from error


def url_at(host: str, port: int) -> str:
    """The URL of what listens there."""
    return f"http://{_in_url(host)}:{port}"


def own_names(listener: socket.socket, host: str) -> tuple[str, ...] | None:
    """The names that the header Host may have; None, for any, where other machines reach the listener.

    A name that another site's DNS server gives this machine's address would open the listener to that site.

    Args:
        listener: What listens.
        host: Its address as the user gave it, such as a name in /etc/hosts.
    """
    address = listener.getsockname()[0]
    if not ip_address(address).is_loopback:
        return None
    return tuple(dict.fromkeys([_in_url(address), "localhost", _in_url(host.lower())]))


def _in_url(host: str) -> str:
    return f"[{host}]" if ":" in host else host


@contextmanager
def needing_train_extra(what: str = "this command needs PyTorch and its company") -> Iterator[None]:
    """Turns the lack of a library into one line that names the extra."""
    with needing_extra("train", what):
        yield


@contextmanager
def needing_synth_extra() -> Iterator[None]:
    """As `needing_train_extra`."""
    with needing_extra("synth", "this command needs what renders"):
        import skimage  # noqa: F401 - which textures need later, in other processes too

        yield
