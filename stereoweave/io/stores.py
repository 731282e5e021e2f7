"""Folders on a disk or in an object store, by one interface: s3://, gs://, az:// and abfs:// through fsspec.

Endpoint, region and keys are those of the environment and of the provider's own files, such as
AWS_ENDPOINT_URL and ~/.aws/credentials. A request that a store answers with "slow down" or with an error of
its own is repeated by the store's library.
"""

import importlib
import os
import re
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

from stereoweave.errors import StereoweaveError, needing_extra
from stereoweave.io.files import make_folder, reading, replacing

if TYPE_CHECKING:
    from fsspec.asyn import AsyncFileSystem


class _Kind(NamedTuple):
    """A kind of object store: its library, where that finds the keys and the endpoint, and its settings."""

    library: str
    keys: str
    endpoint: str
    settings: Mapping[str, Any]


_URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]*)://(.*)", re.DOTALL)
# A request is made 3 times at most, so that a refused connection is told after 3 seconds.
_OF_S3 = {"connect_timeout": 5, "read_timeout": 30, "retries": {"mode": "standard", "total_max_attempts": 3}}
_AZURE = _Kind("adlfs", "AZURE_STORAGE_ACCOUNT_NAME and AZURE_STORAGE_ACCOUNT_KEY", "the account's name", {})
_KINDS = {
    "s3": _Kind(
        "s3fs",
        "AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or for a public bucket FSSPEC_S3_ANON=true",
        "AWS_ENDPOINT_URL",
        {"config_kwargs": _OF_S3},
    ),
    "gs": _Kind("gcsfs", "GOOGLE_APPLICATION_CREDENTIALS", "STORAGE_EMULATOR_HOST", {}),
    "az": _AZURE,
    "abfs": _AZURE,
}
# All repetitions together may take minutes: right in the middle of a run, and wrong at its beginning.
_ANSWER_S = 15.0
_NO_KEYS = {
    *("NoCredentialsError", "PartialCredentialsError", "CredentialRetrievalError", "ProfileNotFound"),
    *("DefaultCredentialsError", "RefreshError", "ClientAuthenticationError"),
}
_UNREACHABLE = {
    *("EndpointConnectionError", "HTTPClientError", "ConnectionError", "ClientConnectionError"),
    *("ServiceRequestError", "ServiceResponseError", "TimeoutError", "TransportError"),
}
# A change of a file's content changes it; the first that a store tells of.
_VERSIONS = ("ETag", "etag", "md5Hash", "updated", "last_modified")


class StoredFile(NamedTuple):
    """A file of a store: its path below the folder, parted by "/"; bytes; what changes with its content."""

    path: str
    size_bytes: int
    version: str


@runtime_checkable
class Store(Protocol):
    """A folder on a disk or in an object store; it can be pickled, and costs nothing until it is used.

    A path is relative to the folder, and parted by "/". Every method raises a StereoweaveError in one line
    where the folder cannot be reached, or the file is not there or may not be read or written.
    """

    @property
    def place(self) -> str:
        """Path or URL, without a slash at its end."""
        ...

    @property
    def folder(self) -> Path | None:
        """The folder itself where it is on a disk; files there need neither `fetch` nor `put`."""
        ...

    def check_source(self) -> None:
        """Raises where the folder cannot be reached or listed, or is not there."""
        ...

    def check_destination(self) -> None:
        """Raises where the folder cannot be reached, or its bucket is not there; makes a folder on a disk."""
        ...

    def files(self, below: str = "") -> Iterator[StoredFile]:
        """The files below the folder, or below a folder in it; hidden ones are left out.

        None where there is no such folder. In s3:// and on a disk they come as they are listed; the other
        stores' libraries list all before the first.
        """
        ...

    def fetch(self, path: str, into: Path) -> Path:
        """A file on a disk: itself where it is on one already, else a copy, `into`/path."""
        ...

    def put(self, file: Path, path: str) -> None:
        """Copies a file from a disk to the path, where it is whole or not there."""
        ...

    def read_bytes(self, path: str) -> bytes:
        """What is in a file."""
        ...

    def write_bytes(self, path: str, content: bytes) -> None:
        """Writes a file, which is whole or not there."""
        ...

    def exists(self, path: str) -> bool:
        """Whether there is such a file."""
        ...

    def remove(self, path: str) -> None:
        """Removes a file, if it is there."""
        ...

    def at(self, path: str) -> str:
        """The whole path or URL of a file."""
        ...


def store_at(place: str | Path) -> Store:
    """The store of a path or a URL, of which nothing is read yet.

    Raises:
        StereoweaveError: A protocol that is not known, whose library is missing, or no bucket in the URL.
    """
    url = _URL.fullmatch(str(place))
    if url is None:
        return DiskStore(Path(place))
    protocol, path = url[1].lower(), url[2]
    if protocol == "file":
        return DiskStore(Path(path))
    if protocol not in _KINDS:
        known = ", ".join(f"{kind}://" for kind in _KINDS)
        raise StereoweaveError(
            f"{place}: expected a path, or a URL of {known} or file://, found {protocol}://"
        )
    if not path.strip("/") or path.startswith("/"):
        raise StereoweaveError(f"{place}: expected {protocol}://bucket/folder, found no bucket")
    library = _KINDS[protocol].library
    with needing_extra("cluster", f"{place}: expected the library {library}"):
        importlib.import_module(library)
    return ObjectStore(f"{protocol}://{path.rstrip('/')}")


@dataclass(frozen=True)
class DiskStore:
    """A folder on a disk, or what is mounted as one."""

    folder: Path

    @property
    def place(self) -> str:
        return str(self.folder)

    def check_source(self) -> None:
        if not self.folder.is_dir():
            found = "a file" if self.folder.exists() else "no such folder"
            raise StereoweaveError(f"{self.folder}: expected a folder, found {found}")
        with reading(self.folder, "a folder that can be listed"):
            os.scandir(self.folder).close()

    def check_destination(self) -> None:
        make_folder(self.folder)

    def files(self, below: str = "") -> Iterator[StoredFile]:
        waiting = [below]
        while waiting:
            within = waiting.pop()
            entries = _entries(self.folder / within)
            paths = [f"{within}/{entry.name}" if within else entry.name for entry in entries]
            for entry, path in zip(entries, paths, strict=True):
                if status := _status(entry):
                    yield StoredFile(path, status.st_size, str(status.st_mtime_ns))
            folders = zip(entries, paths, strict=True)
            # Not through links, which may lead back here.
            waiting += [path for entry, path in folders if entry.is_dir(follow_symlinks=False)][::-1]

    def fetch(self, path: str, into: Path) -> Path:
        return self.folder / path

    def put(self, file: Path, path: str) -> None:
        with replacing(self.folder / path) as temporary:
            shutil.copyfile(file, temporary)

    def read_bytes(self, path: str) -> bytes:
        with reading(self.at(path), "a file"):
            return (self.folder / path).read_bytes()

    def write_bytes(self, path: str, content: bytes) -> None:
        with replacing(self.folder / path) as temporary:
            temporary.write_bytes(content)

    def exists(self, path: str) -> bool:
        return (self.folder / path).is_file()

    def remove(self, path: str) -> None:
        with reading(self.at(path), "a file that can be removed"):
            (self.folder / path).unlink(missing_ok=True)

    def at(self, path: str) -> str:
        return str(self.folder / path)


@dataclass(frozen=True)
class ObjectStore:
    """A folder in an object store: all whose names begin with its own, for there are no folders in one."""

    place: str

    @property
    def folder(self) -> None:
        return None

    def check_source(self) -> None:
        if not self._has_any():
            raise StereoweaveError(
                f"{self.place}: expected a folder, found nothing whose name begins so; is it spelt right?"
            )

    def check_destination(self) -> None:
        self._has_any()

    def files(self, below: str = "") -> Iterator[StoredFile]:
        with self._library(below, "a folder that can be listed") as (library, folder):
            start = len(folder) - len(below) + (not below)
            for file in (_listed_in_s3 if self._is_s3() else _listed)(library, folder):
                path = file.path[start:]
                # A name that ends in "/" is an empty object that some programs make for a folder.
                if path and "/." not in f"/{path}" and not path.endswith("/"):
                    yield file._replace(path=path)

    def fetch(self, path: str, into: Path) -> Path:
        with (
            replacing(into / path) as temporary,
            self._library(path, "a file that can be read") as (library, source),
        ):
            library.get_file(source, str(temporary))
        return into / path

    def put(self, file: Path, path: str) -> None:
        with self._library(path, "a file that can be written") as (library, target):
            library.put_file(str(file), target)

    def read_bytes(self, path: str) -> bytes:
        with self._library(path, "a file that can be read") as (library, source):
            return library.cat_file(source)

    def write_bytes(self, path: str, content: bytes) -> None:
        with self._library(path, "a file that can be written") as (library, target):
            library.pipe_file(target, content)

    def exists(self, path: str) -> bool:
        with self._library(path, "a file that can be read") as (library, source):
            try:
                return library.info(source)["type"] == "file"
            except FileNotFoundError:
                return False

    def remove(self, path: str) -> None:
        with (
            self._library(path, "a file that can be removed") as (library, target),
            suppress(FileNotFoundError),
        ):
            library.rm_file(target)

    def at(self, path: str) -> str:
        return f"{self.place}/{path}" if path else self.place

    def _is_s3(self) -> bool:
        return self.place.startswith("s3://")

    def _has_any(self) -> bool:
        """Whether something is in the folder; an error within seconds where nobody answers."""
        with self._library("", "a folder that can be listed") as (library, folder):
            bucket = folder.partition("/")[0]
            try:
                if self._is_s3():
                    # Not `info`, which begins with a HEAD request, to which S3 says no more than "Forbidden".
                    return bool(_page(library, folder, MaxKeys=1, timeout=_ANSWER_S).get("Contents"))
                with suppress(FileNotFoundError):
                    library.info(folder, timeout=_ANSWER_S)
                    return True
                with suppress(PermissionError):  # to see a bucket is a right of its own
                    library.info(bucket, timeout=_ANSWER_S)
            except FileNotFoundError as error:
                raise StereoweaveError(
                    f"{self.place}: expected a bucket, found none that is called {bucket}; "
                    f"is it spelt right, and {self._kind().endpoint} as well?"
                ) from error
        return False

    @contextmanager
    def _library(self, path: str, expected: str) -> Iterator[tuple["AsyncFileSystem", str]]:
        """The store's library, and what it calls a path; its errors become one line."""
        import fsspec

        try:
            # What it remembered of a listing would hide what other processes write. It keeps its connections.
            library, name = fsspec.url_to_fs(self.at(path), use_listings_cache=False, **self._kind().settings)
            yield library, name
        except StereoweaveError:
            raise
        except Exception as error:  # each library has its own, and they have little in common
            raise StereoweaveError(
                f"{self.at(path)}: expected {expected}, found {_found(error, self._kind())}"
            ) from error

    def _kind(self) -> _Kind:
        return _KINDS[self.place.partition("://")[0]]


def _entries(folder: Path) -> list[os.DirEntry[str]]:
    """What is in a folder, by name, but for hidden entries; nothing where it is not there or is another's."""
    with suppress(FileNotFoundError, PermissionError), os.scandir(folder) as entries:
        return sorted((entry for entry in entries if entry.name[0] != "."), key=lambda entry: entry.name)
    return []


def _status(entry: os.DirEntry[str]) -> os.stat_result | None:
    """Size and time of a file; None of anything else, and of one that has just been removed."""
    with suppress(FileNotFoundError):
        return entry.stat() if entry.is_file() else None
    return None


def _listed_in_s3(library: "AsyncFileSystem", folder: str) -> Iterator[StoredFile]:
    """The files below a folder by their whole names, asked for a thousand at a time, as they are used."""
    bucket = folder.partition("/")[0]
    more: dict[str, Any] | None = {}
    while more is not None:
        page = _page(library, folder, **more)
        for entry in page.get("Contents", ()):
            yield StoredFile(f"{bucket}/{entry['Key']}", entry["Size"], entry["ETag"])
        more = {"ContinuationToken": page["NextContinuationToken"]} if page["IsTruncated"] else None


def _listed(library: "AsyncFileSystem", folder: str) -> Iterator[StoredFile]:
    for name, info in library.find(folder, detail=True).items():
        version = next((str(info[key]) for key in _VERSIONS if info.get(key)), "")
        yield StoredFile(name, info["size"], version)


def _page(library: "AsyncFileSystem", folder: str, **more: Any) -> dict[str, Any]:
    bucket, _, path = folder.partition("/")
    prefix = f"{path}/" if path else ""
    return library.call_s3("list_objects_v2", Bucket=bucket, Prefix=prefix, **more, **library.req_kw)


def _found(error: Exception, kind: _Kind) -> str:
    names = {name.__name__ for name in type(error).__mro__}
    text = " ".join(str(error).split()) or "none in time"
    # Azure's library has no error of its own for it.
    if names & _NO_KEYS or (isinstance(error, ValueError) and "credentials" in text):
        return f"no keys that can be used ({text}); set {kind.keys}"
    if names & _UNREACHABLE:
        return f"no answer ({text}); is the network there, and {kind.endpoint} right?"
    if isinstance(error, PermissionError):
        return f"no permission ({text}); are the keys right, and may they be used for this?"
    if isinstance(error, FileNotFoundError):
        return f"none ({text})"
    return f"{type(error).__name__}: {text}"
