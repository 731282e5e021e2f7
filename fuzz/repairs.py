"""Repair of checksums in damaged files, most of which the first check would otherwise reject."""

import io
import struct
import tarfile
import zlib
from contextlib import suppress

from stereoweave.data.checksums import make_checksums

_PNG = b"\x89PNG\r\n\x1a\n"


def repair_png(content: bytes) -> bytes:
    """Correct the checksum of every chunk of a PNG file; return any other file unchanged."""
    if not content.startswith(_PNG):
        return content
    repaired, place = bytearray(content), len(_PNG)
    while place + 12 <= len(content):
        (length,) = struct.unpack_from(">I", content, place)
        end = place + 8 + length
        if end + 4 > len(content):
            break
        struct.pack_into(">I", repaired, end, zlib.crc32(content[place + 4 : end]))
        place = end + 4
    return bytes(repaired)


def repair_shard(content: bytes) -> bytes:
    """Correct the checksums of a shard: those of its member headers and of the files of its pairs."""
    files = _files_in(_with_right_heads(content))
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w", encoding="latin-1") as tar:
        for pair in sorted({name.partition(".")[0] for name in files}):
            own = {name: body for name, body in files.items() if name.startswith(f"{pair}.")}
            own.pop(f"{pair}.sha256", None)
            for name, body in {**own, f"{pair}.sha256": make_checksums(own)}.items():
                head = tarfile.TarInfo(name)
                head.size = len(body)
                tar.addfile(head, io.BytesIO(body))
    return stream.getvalue()


def _files_in(content: bytes) -> dict[str, bytes]:
    """Read the members of a tar file by name, up to the first unreadable one."""
    files: dict[str, bytes] = {}
    with (
        suppress(tarfile.TarError, ValueError, OverflowError),
        tarfile.open(fileobj=io.BytesIO(content), mode="r:", encoding="latin-1") as tar,
    ):
        for member in tar:
            if member.size < 0:  # otherwise, the same header would be read again forever
                break
            if member.name.isprintable():  # a lone surrogate cannot be written again
                files[member.name] = content[member.offset_data :][: member.size]
    return files


def _with_right_heads(content: bytes) -> bytes:
    """Correct the checksum of every block of a tar file that looks like a member header."""
    repaired = bytearray(content)
    for start in range(0, len(content) - 511, 512):
        head = repaired[start : start + 512]
        if head[257:262] == b"ustar":
            head[148:156] = b" " * 8
            repaired[start + 148 : start + 156] = b"%06o\0 " % sum(head)
    return bytes(repaired)
