"""What is drawn once on a machine: banks of textures, kept in the user's cache folder."""

import hashlib
import tempfile
import time
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from stereoweave.compiling import cache_folder

_KEPT_DAYS = 30

Texels = UInt8[np.ndarray, "..."]


def kept(kind: str, sources: Iterable[Path], shape: tuple[int, ...], draw: Callable[[], Texels]) -> Texels:
    """What `draw` gives, read where an earlier process has kept it.

    Args:
        kind: Of bank; a file of it is removed after a month, once another version is kept.
        sources: The code that draws; once it changes, the bank is drawn anew.
        shape: Of what `draw` gives.
        draw: Draws the bank, the same in every process.
    """
    version = hashlib.sha256(b"".join(source.read_bytes() for source in sources)).hexdigest()[:16]
    file = cache_folder().with_name("textures") / f"{version}.{kind}"
    texels = _read(file, shape)
    if texels is None:
        texels = draw()
        _keep(file, texels)
    return texels


def _read(file: Path, shape: tuple[int, ...]) -> Texels | None:
    """What was kept, or None where there is nothing, or nothing whole."""
    try:
        content = np.fromfile(file, np.uint8)
    except OSError:
        return None
    texels, checksum = content[:-4], content[-4:]
    if texels.size != np.prod(shape) or checksum.tobytes() != _checksum(texels):
        return None
    return texels.reshape(shape)


def _keep(file: Path, texels: Texels) -> None:
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=file.parent) as folder:
            whole = Path(folder) / file.name
            with whole.open("wb") as stream:
                stream.write(texels.data)
                stream.write(_checksum(texels))
            whole.replace(file)
        # Not at once: versions side by side, in use by turns, would throw out one another's.
        for other in file.parent.glob(f"*{file.suffix}"):
            if time.time() - other.stat().st_mtime > _KEPT_DAYS * 86_400:
                other.unlink()
    except OSError:
        # Where nothing can be kept, each process draws the bank for itself, and that is all the harm.
        return


def _checksum(texels: Texels) -> bytes:
    return zlib.crc32(texels.data).to_bytes(4, "big")
