"""One interface to folders on disk and in object stores (s3://, gs://, az:// and abfs:// through fsspec).

Endpoint, region and keys come from the environment and the provider's own files, such as AWS_ENDPOINT_URL and
~/.aws/credentials. The store's library retries requests that fail with "slow down" or a server error.
"""

import errno
import importlib
import os
import re
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

from stereoweave.errors import StereoweaveError, require_extra
from stereoweave.io.files import make_folder, reading, replacing

if TYPE_CHECKING:
    from fsspec.asyn import AsyncFileSystem


class _Kind(NamedTuple):
    """A kind of object store.

    Attributes:
        library: Name of the Python library that accesses the store.
        keys: Environment variables for the keys.
        endpoint: Environment variable for the endpoint.
        settings: Settings for the library.
    """

    library: str
    keys: str
    endpoint: str
    settings: Mapping[str, Any]


_URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]*)://(.*)", re.DOTALL)
# Three attempts at most, so that a refused connection is reported within 3 seconds.
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
# Retries may take minutes in total, which is acceptable during a run but not at its start.
_ANSWER_S = 15.0
_NO_KEYS = {
    *("NoCredentialsError", "PartialCredentialsError", "CredentialRetrievalError", "ProfileNotFound"),
    *("DefaultCredentialsError", "RefreshError", "ClientAuthenticationError"),
}
_UNREACHABLE = {
    *("EndpointConnectionError", "HTTPClientError", "ConnectionError", "ClientConnectionError"),
    *("ServiceRequestError", "ServiceResponseError", "TimeoutError", "TransportError"),
}
# Metadata that changes with a file's content; the first entry that a store reports is used.
_VERSIONS = ("ETag", "etag", "md5Hash", "updated", "last_modified")


class StoredFile(NamedTuple):
    """A file in a store. Its path is relative to the folder; its version changes with its content."""

    path: str
    size_bytes: int
    version: str


@runtime_checkable
class Store(Protocol):
    """A folder on a disk or in an object store; it can be pickled and connects on first use.

    Paths are relative to the folder and use "/" as the separator.

    Raises:
        StereoweaveError: The folder is unreachable, the file is missing, or access is denied. Every method
            may raise it.
    """

    @property
    def place(self) -> str:
        """Path or URL without a trailing slash."""
        ...

    @property
    def folder(self) -> Path | None:
        """Path of a folder on a disk, where files need neither `fetch` nor `put`; None for object stores."""
        ...

    def check_source(self) -> None:
        """Raise a StereoweaveError if the folder is missing, is unreachable or cannot be listed."""
        ...

    def check_destination(self) -> None:
        """Create the folder if it is on a disk; raise a StereoweaveError if the folder cannot be reached."""
        ...

    def files(self, below: str = "") -> Iterator[StoredFile]:
        """List the files below the folder, or below one of its subfolders, except hidden files.

        A missing folder has no files. On a disk and in s3:// the listing is lazy; the other stores' libraries
        list all files before they return the first one.
        """
        ...

    def fetch(self, path: str, into: Path) -> Path:
        """Return a local path of the file: its own path on a disk, else the path of a copy, `into`/path."""
        ...

    def put(self, file: Path, path: str) -> None:
        """Copy a local file to the path, atomically."""
        ...

    def read_bytes(self, path: str) -> bytes:
        """Return the content of a file."""
        ...

    def write_bytes(self, path: str, content: bytes) -> None:
        """Write content to a file, atomically."""
        ...

    def exists(self, path: str) -> bool:
        """Return whether a file exists."""
        ...

    def remove(self, path: str) -> None:
        """Remove a file if it exists."""
        ...

    def at(self, path: str) -> str:
        """Return the full path or URL of a file."""
        ...


def store_at(place: str | Path) -> Store:
    """Return the store for a path or URL, without connecting to it.

    Raises:
        StereoweaveError: The protocol is unknown, its library is missing, or the URL has no bucket.
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
            f"{place}: expected a path, or a URL that begins with {known} or file://, found {protocol}://"
        )
    if not path.strip("/") or path.startswith("/"):
        raise StereoweaveError(f"{place}: expected {protocol}://bucket/folder, found no bucket")
    library = _KINDS[protocol].library
    with require_extra("cluster", f"{place}: {protocol}:// needs the library {library}"):
        importlib.import_module(library)
    return ObjectStore(f"{protocol}://{path.rstrip('/')}")


@dataclass(frozen=True)
class DiskStore:
    """A folder on a local or mounted disk."""

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
            entries = _list_entries(self.folder / within)
            paths = [f"{within}/{entry.name}" if within else entry.name for entry in entries]
            for entry, path in zip(entries, paths, strict=True):
                if status := _read_status(entry):
                    yield StoredFile(path, status.st_size, str(status.st_mtime_ns))
            folders = zip(entries, paths, strict=True)
            # Links are not followed: they may form a cycle.
            waiting += [path for entry, path in folders if entry.is_dir(follow_symlinks=False)][::-1]

    def fetch(self, path: str, into: Path) -> Path:
        return self.folder / path

    def put(self, file: Path, path: str) -> None:
        with replacing(self.folder / path) as temporary:
            shutil.copyfile(file, temporary)

    def read_bytes(self, path: str) -> bytes:
        with reading(self.at(path), "a readable file"):
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
    """A folder in an object store: all objects whose names begin with the folder's name."""

    place: str

    @property
    def folder(self) -> None:
        return None

    def check_source(self) -> None:
        if not self._has_any():
            raise StereoweaveError(
                f"{self.place}: expected a folder, found no objects in it; check the spelling"
            )

    def check_destination(self) -> None:
        self._has_any()

    def files(self, below: str = "") -> Iterator[StoredFile]:
        with self._library(below, "a folder that can be listed") as (library, folder):
            start = len(folder) - len(below) + (not below)
            for file in (_list_s3 if self._is_s3() else _list_files)(library, folder):
                path = file.path[start:]
                # Some programs mark a folder with an empty object whose name ends in "/".
                if path and "/." not in f"/{path}" and not path.endswith("/"):
                    yield file._replace(path=path)

    def fetch(self, path: str, into: Path) -> Path:
        with (
            replacing(into / path) as temporary,
            self._library(path, "a readable file") as (library, source),
        ):
            library.get_file(source, str(temporary))
        return into / path

    def put(self, file: Path, path: str) -> None:
        with self._library(path, "a writable file") as (library, target):
            library.put_file(str(file), target)

    def read_bytes(self, path: str) -> bytes:
        with self._library(path, "a readable file") as (library, source):
            return library.cat_file(source)

    def write_bytes(self, path: str, content: bytes) -> None:
        with self._library(path, "a writable file") as (library, target):
            library.pipe_file(target, content)

    def exists(self, path: str) -> bool:
        with self._library(path, "a readable file") as (library, source):
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
        """Return whether the folder contains objects; raise an error within seconds if it is unreachable."""
        with self._library("", "a folder that can be listed") as (library, folder):
            bucket = folder.partition("/")[0]
            try:
                if self._is_s3():
                    # `info` would begin with a HEAD request, whose error gives no reason except "Forbidden".
                    return bool(_fetch_page(library, folder, MaxKeys=1, timeout=_ANSWER_S).get("Contents"))
                with suppress(FileNotFoundError):
                    library.info(folder, timeout=_ANSWER_S)
                    return True
                with suppress(PermissionError):  # inspecting a bucket needs a separate permission
                    library.info(bucket, timeout=_ANSWER_S)
            except FileNotFoundError as error:
                raise StereoweaveError(
                    f"{self.place}: expected a bucket, found none named {bucket}; "
                    f"check its spelling and {self._kind().endpoint}"
                ) from error
        return False

    @contextmanager
    def _library(self, path: str, expected: str) -> Iterator[tuple["AsyncFileSystem", str]]:
        """Yield the library and its name for a path; turn library errors into a StereoweaveError."""
        import fsspec

        try:
            # A cached listing would hide files that other processes write. Connections stay cached.
            library, name = fsspec.url_to_fs(self.at(path), use_listings_cache=False, **self._kind().settings)
            yield library, name
        except StereoweaveError:
            raise
        except Exception as error:  # the libraries' exceptions have no common base
            raise StereoweaveError(
                f"{self.at(path)}: expected {expected}, found {_describe_error(error, self._kind())}"
            ) from error

    def _kind(self) -> _Kind:
        return _KINDS[self.place.partition("://")[0]]


def _list_entries(folder: Path) -> list[os.DirEntry[str]]:
    """Return a folder's visible entries, sorted by name; [] if the folder is missing or unreadable."""
    with suppress(FileNotFoundError, PermissionError), os.scandir(folder) as entries:
        return sorted((entry for entry in entries if entry.name[0] != "."), key=lambda entry: entry.name)
    return []


def _read_status(entry: os.DirEntry[str]) -> os.stat_result | None:
    """Return the status of a file; None if the entry is not a file that can be reached."""
    try:
        return entry.stat() if entry.is_file() else None
    except FileNotFoundError:  # it has just been removed
        return None
    except OSError as error:
        if error.errno != errno.ELOOP:  # a link to itself
            raise
        return None


def _list_s3(library: "AsyncFileSystem", folder: str) -> Iterator[StoredFile]:
    """Yield the files below a folder with their full names, listed lazily in pages of a thousand."""
    bucket = folder.partition("/")[0]
    more: dict[str, Any] | None = {}
    while more is not None:
        page = _fetch_page(library, folder, **more)
        for entry in page.get("Contents", ()):
            yield StoredFile(f"{bucket}/{entry['Key']}", entry["Size"], entry["ETag"])
        more = {"ContinuationToken": page["NextContinuationToken"]} if page["IsTruncated"] else None


def _list_files(library: "AsyncFileSystem", folder: str) -> Iterator[StoredFile]:
    for name, info in library.find(folder, detail=True).items():
        version = next((str(info[key]) for key in _VERSIONS if info.get(key)), "")
        yield StoredFile(name, info["size"], version)


def _fetch_page(library: "AsyncFileSystem", folder: str, **more: Any) -> dict[str, Any]:
    bucket, _, path = folder.partition("/")
    prefix = f"{path}/" if path else ""
    return library.call_s3("list_objects_v2", Bucket=bucket, Prefix=prefix, **more, **library.req_kw)


def _describe_error(error: Exception, kind: _Kind) -> str:
    names = {name.__name__ for name in type(error).__mro__}
    text = " ".join(str(error).split()) or "timeout"
    # Azure's library raises a plain ValueError.
    if names & _NO_KEYS or (isinstance(error, ValueError) and "credentials" in text):
        return f"no usable keys ({text}); set {kind.keys}"
    if names & _UNREACHABLE:
        return f"no answer ({text}); check the network and {kind.endpoint}"
    if isinstance(error, PermissionError):
        return f"no permission ({text}); check the keys and their permissions"
    if isinstance(error, FileNotFoundError):
        return f"no such file ({text})"
    return f"{type(error).__name__}: {text}"
