"""Options that several commands share, their parsing, and sockets."""

import errno
import math
import re
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from ipaddress import ip_address
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stereoweave.errors import StereoweaveError, reason, require_extra

if TYPE_CHECKING:
    from stereoweave.cameras.spherical import SphereRequest
    from stereoweave.pictures.prepare import Request
    from stereoweave.rendering.comfort import ScreenChoice
    from stereoweave.system.ray_engine import Engine

_LEAST_SIDE_PX = 32

Pictures = Annotated[
    list[Path],
    typer.Argument(
        metavar="PICTURE",
        help="LEFT RIGHT, two pictures of the same size; or one picture that holds both views.",
    ),
]
Format = Annotated[
    str | None,
    typer.Option(
        "--format",
        help="Layout of a picture that holds both views: side_by_side, side_by_side_half, crossed, "
        "crossed_half, top_bottom, top_bottom_half, top_bottom_right_first, top_bottom_right_first_half, "
        "row_interleaved, column_interleaved, checkerboard, row_interleaved_right_first, "
        "column_interleaved_right_first, checkerboard_right_first, mpo or jps (default: detected).",
    ),
]
Projection = Annotated[
    str | None,
    typer.Option(
        help="Projection of VR180 and 360-degree files: equirectangular (360 degrees), half_equirectangular "
        "(VR180), fisheye, or rectilinear for ordinary ones (default: from the file's metadata or its name)."
    ),
]
Look = Annotated[
    str | None,
    typer.Option(
        metavar="YAW,PITCH",
        help="Direction of the window that is cut from a VR180 or 360-degree file, in degrees to the right "
        "and upwards (default: 0,0, straight ahead).",
    ),
]
Fov = Annotated[
    float | None,
    typer.Option(metavar="DEGREES", help="Field of view of that window, from 10 to 150 (default: 90)."),
]
LensFov = Annotated[
    float | None,
    typer.Option(
        metavar="DEGREES",
        help="Field of view of a fisheye lens, such as 190 (default: from the file, or 180).",
    ),
]
Whole = Annotated[
    bool,
    typer.Option(
        "--whole",
        help="Process the whole field of view of a VR180 or 360-degree file, instead of a window; the result "
        "is equirectangular again.",
    ),
]
OldFormat = Annotated[str | None, typer.Option("--arrangement", hidden=True, help="Old name of --format.")]
Calib = Annotated[
    Path | None,
    typer.Option(
        help="Calibration file in OpenCV, Kalibr, KITTI or Middlebury format, for metres and rectification."
    ),
]
FocalPx = Annotated[
    float | None, typer.Option(help="Focal length in pixels, in place of a calibration file.")
]
BaselineM = Annotated[
    float | None,
    typer.Option(help="Distance between the cameras in metres, in place of a calibration file."),
]
Rectify = Annotated[
    bool | None,
    typer.Option(
        "--rectify/--no-rectify",
        help="Rectify the pair by its calibration or, without one, by matched features (default: by matched "
        "features, if corresponding points lie in different rows and no camera is given).",
    ),
]
Range = Annotated[
    str | None,
    typer.Option(
        "--range",
        metavar="LOW,HIGH",
        help="Least and greatest disparity in pixels (default: estimated from the pair).",
    ),
]
Refined = Annotated[
    bool,
    typer.Option(
        "--refined",
        help="Match once more at full resolution (up to 2 megapixels) wherever the confidence is below 0.85, "
        "instead of 0.45: more thin structures and sharper edges. base and best always do.",
    ),
]
Raw = Annotated[
    bool,
    typer.Option(
        "--raw",
        help="Write the network's own disparity: occluded pixels are not filled, and nothing is refined.",
    ),
]
Strength = Annotated[
    float | None,
    typer.Option(
        min=0,
        help="Factor that scales the baseline about its midpoint (default: 1, or what suits --screen).",
    ),
]
Screen = Annotated[
    str | None,
    typer.Option(
        help="Screen that will show a layout (not rgbd, sweep, wiggle or viewer): phone, television, "
        "headset or light_field. Strength, at most 1, and convergence are chosen so that the depth fits it "
        "without strain, and black bars cover what near objects lose at the left and right border; "
        "--strength and --convergence keep the values given."
    ),
]
Model = Annotated[
    str,
    typer.Option(
        help="Shipped network (small or base), or an .onnx matcher file. small is matched once more where it "
        "is unsure, base wherever it is not certain. For stills, also best, which runs base a second time at "
        "1.5 times the size and settles edges by vote."
    ),
]
Threads = Annotated[int | None, typer.Option(min=1, help="Number of CPU threads (default: all cores).")]
Cluster = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="Run on a Ray cluster: host:port or ray://host:port of its head node, auto for one that runs "
        "on this machine, or local for this machine's cores. All nodes must see the folder under the same "
        "path. Needs the extra 'cluster'.",
    ),
]
Provider = Annotated[
    str,
    typer.Option(
        help="Hardware that runs the network: cpu, cuda or tensorrt (NVIDIA GPUs), openvino (Intel "
        "processors), coreml (macOS) or directml (Windows). If a provider's package is missing, the error "
        "names it."
    ),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
Port = Annotated[int, typer.Option(min=0, max=65535, help="Port to listen on; 0 takes any free port.")]


def replace_old_option(old: tuple[str, str | None], new: tuple[str, str | None]) -> str | None:
    """Return the value of a renamed option from its old or its new name; warn about the old one.

    Args:
        old: The old name and the value given with it, if any.
        new: The new name and the value given with it, if any.

    Raises:
        StereoweaveError: If both are given.
    """
    (old_name, old_value), (new_name, new_value) = old, new
    if old_value is None:
        return new_value
    if new_value is not None:
        raise StereoweaveError(f"{old_name}: expected only {new_name}, which replaces {old_name}, found both")
    typer.echo(f"stereoweave: warning: {old_name} is deprecated; use {new_name}", err=True)
    return old_value


def make_sphere_request(
    projection: str | None = None,
    look: str | None = None,
    fov: float | None = None,
    lens_fov: float | None = None,
    whole: bool = False,
) -> "SphereRequest":
    """Return the `SphereRequest` that the options of a command line describe."""
    from stereoweave.cameras.spherical import SphereRequest

    expected = "yaw and pitch in degrees, such as 30,-10"
    return SphereRequest(
        projection=projection,
        look_deg=None if look is None else _parse_two_numbers("--look", look, expected),
        fov_deg=fov,
        lens_fov_deg=lens_fov,
        whole=whole,
    )


def make_screen_choice(
    screen: str | None, strength: float | None, convergence_px: float | None
) -> "ScreenChoice | None":
    """Return the screen of --screen with the values that the user gave; None if it is not given."""
    if screen is None:
        return None
    from stereoweave.rendering.comfort import ScreenChoice

    return ScreenChoice(name=screen, strength=strength, convergence_px=convergence_px)


def make_request(  # noqa: PLR0913 - each is an option of the command line
    format: str | None = None,
    calib: Path | None = None,
    focal_px: float | None = None,
    baseline_m: float | None = None,
    rectify: bool | None = None,
    sphere: "SphereRequest | None" = None,
) -> "Request":
    """Return the `Request` that the options of a command line describe."""
    from stereoweave.cameras.spherical import SphereRequest
    from stereoweave.pictures.prepare import Request

    return Request(
        format=format,
        calibration=calib,
        focal_px=focal_px,
        baseline_m=baseline_m,
        rectify=rectify,
        sphere=sphere or SphereRequest(),
    )


def parse_range_px(text: str | None) -> tuple[float, float] | None:
    """Parse --range into the least and greatest disparity in px; None if it is not given."""
    if text is None:
        return None
    low_px, high_px = _parse_two_numbers("--range", text, "least and greatest disparity, such as -20,150")
    if low_px >= high_px:
        raise StereoweaveError(f"--range: expected the least disparity first, found {text!r}")
    return low_px, high_px


def parse_pixel(option: str, text: str) -> tuple[int, int]:
    """Parse an option's value X,Y into the column and row of a pixel."""
    expected = "column and row of a pixel, such as 320,240"
    column, row = _parse_two_numbers(option, text, expected)
    if not (column.is_integer() and row.is_integer()):
        raise StereoweaveError(f"{option}: expected {expected}, in whole numbers, found {text!r}")
    return int(column), int(row)


def _parse_two_numbers(option: str, text: str, expected: str) -> tuple[float, float]:
    try:
        first, second = (float(word) for word in text.split(","))
    except ValueError:
        first = second = math.nan
    if not (math.isfinite(first) and math.isfinite(second)):
        raise StereoweaveError(f"{option}: expected {expected}, found {text!r}")
    return first, second


def make_engine(cluster: str | None, workers: int | None = None, cpus_each: float = 1) -> "Engine | None":
    """Return the cluster to run on; None if --cluster is not given."""
    from stereoweave.system.ray_engine import Engine

    return Engine(cluster, workers, cpus_each) if cluster else None


def parse_size_px(size: str) -> tuple[int, int]:
    """Parse --size into width and height in px."""
    return parse_two_counts("--size", size, "width x height in pixels, such as 640x480")


def parse_two_counts(option: str, text: str, expected: str) -> tuple[int, int]:
    """Parse two whole numbers joined by an x; `expected` is how an error describes them."""
    found = re.fullmatch("([0-9]{1,9})x([0-9]{1,9})", text)
    if found is None:
        raise StereoweaveError(f"{option}: expected {expected}, found {text!r}")
    return int(found[1]), int(found[2])


def parse_largest_size_px(size: str | None) -> tuple[int, int] | None:
    """Parse --size into the largest width and height in px; None if it is not given."""
    if size is None:
        return None
    found = re.fullmatch("([0-9]{1,9})(?:x([0-9]{1,9}))?", size)
    sides = (int(found[1]), int(found[2] or found[1])) if found else (0, 0)
    if min(sides) < _LEAST_SIDE_PX:
        raise StereoweaveError(
            "--size: expected the longer side in pixels, or width x height, such as 1600 or 1600x1200, at "
            f"least {_LEAST_SIDE_PX} px per side, found {size!r}"
        )
    return sides


def make_parent_folder(*files: Path) -> Path:
    """Call `io.files.make_parent_folder`, which is imported here so that --help stays fast."""
    from stereoweave.io import files as io

    return io.make_parent_folder(*files)


def listen(host: str, port: int) -> socket.socket:
    """Open a listening socket; raise StereoweaveError if the address is not available."""
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        return socket.create_server(address[:2], family=family)
    except OSError as error:
        if isinstance(error, socket.gaierror) or error.errno == errno.EADDRNOTAVAIL:
            raise StereoweaveError(
                f"--host {host}: expected an address of this computer, found another one; 127.0.0.1 accepts "
                "this computer only, and 0.0.0.0 any computer that can reach it"
            ) from error
        # create_server appends the address to the system's text.
        found = reason(error).partition(" (while attempting")[0]
        raise StereoweaveError(
            f"--host {host} --port {port}: expected a free address, found none ({found}); "
            "--port 0 takes any free port"
        ) from error


def format_url(host: str, port: int) -> str:
    """Return the URL of an HTTP server."""
    return f"http://{_bracket_ipv6(host)}:{port}"


def find_allowed_hosts(listener: socket.socket, host: str) -> tuple[str, ...] | None:
    """Return the names allowed in the Host header; None (any name) if other machines can reach the listener.

    This prevents DNS rebinding, where a foreign site's name is made to resolve to this machine's address.

    Args:
        listener: The listening socket.
        host: Address of the listener as the user gave it, such as a name in /etc/hosts.
    """
    address = listener.getsockname()[0]
    if not ip_address(address).is_loopback:
        return None
    return tuple(dict.fromkeys([_bracket_ipv6(address), "localhost", _bracket_ipv6(host.lower())]))


def _bracket_ipv6(host: str) -> str:
    return f"[{host}]" if ":" in host else host


@contextmanager
def require_train_extra(what: str = "this command needs PyTorch and other libraries") -> Iterator[None]:
    """Raise a one-line error that names the `train` extra if a library is missing."""
    with require_extra("train", what):
        yield


@contextmanager
def require_synth_extra() -> Iterator[None]:
    """Raise a one-line error that names the `synth` extra if a library is missing."""
    with require_extra("synth", "this command needs the rendering libraries"):
        import skimage  # noqa: F401 - textures need it later, also in worker processes

        yield
