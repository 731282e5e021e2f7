import json
import pickle
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from urllib.request import Request, urlopen

import pytest

from stereoweave.errors import StereoweaveError
from stereoweave.io import stores
from stereoweave.io.stores import Store, store_at


@pytest.fixture(params=["disk", "s3"])
def store(request, tmp_path) -> Store:
    """Return the store of a new folder, on a disk or in an object store."""
    place = tmp_path / "disk" if request.param == "disk" else f"{request.getfixturevalue('bucket')}/of/ours"
    return store_at(place)


@contextmanager
def another_environment(monkeypatch, **settings: str) -> Iterator[None]:
    """Drop cached connections before and after the block, so that its environment variables take effect."""
    from s3fs import S3FileSystem

    with monkeypatch.context() as patch:
        for name, value in settings.items():
            patch.setenv(name, value)
        S3FileSystem.clear_instance_cache()
        yield
    S3FileSystem.clear_instance_cache()


@contextmanager
def with_permissions_checked(s3: str) -> Iterator[None]:
    def let_pass(requests: str) -> None:
        headers = {"Content-Type": "text/plain"}
        urlopen(Request(f"{s3}/moto-api/reset-auth", requests.encode(), headers)).close()

    let_pass("0")
    try:
        yield
    finally:
        let_pass("inf")


def keys_that_allow_nothing() -> dict[str, str]:
    import boto3

    iam = boto3.client("iam")
    iam.create_user(UserName="nobody")
    key = iam.create_access_key(UserName="nobody")["AccessKey"]
    return {"AWS_ACCESS_KEY_ID": key["AccessKeyId"], "AWS_SECRET_ACCESS_KEY": key["SecretAccessKey"]}


def put_object(s3: str, path: str) -> None:
    urlopen(Request(f"{s3}/{path}", b"", method="PUT")).close()


def error_of(action) -> str:
    with pytest.raises(StereoweaveError) as told:
        action()
    assert "\n" not in str(told.value)
    return str(told.value)


# Behaviour of both kinds of stores


def test_a_written_file_is_listed_and_read(store, tmp_path):
    store.check_destination()
    picture = tmp_path / "picture.png"
    picture.write_bytes(b"pixels")
    store.put(picture, "a/left [1]#?.png")
    store.write_bytes("b.json", b"{}")
    listed = {file.path: file.size_bytes for file in store.files()}
    assert listed == {"a/left [1]#?.png": 6, "b.json": 2}
    assert store.read_bytes("b.json") == b"{}"
    fetched = store.fetch("a/left [1]#?.png", tmp_path / "into")
    assert fetched.read_bytes() == b"pixels"
    assert (fetched == tmp_path / "disk/a/left [1]#?.png") == (store.folder is not None)


def test_a_subfolder_is_listed_with_paths_from_the_store_s_folder(store):
    for path in ("parts/1.parquet", "parts/2.parquet", "partsof/3.parquet", "1.parquet"):
        store.write_bytes(path, b"")
    assert sorted(file.path for file in store.files("parts")) == ["parts/1.parquet", "parts/2.parquet"]
    assert list(store.files("part")) == []


def test_hidden_files_and_folders_are_not_listed(store):
    for path in ("a/b.png", ".a.png", "a/.b.png", ".trash/c.png", "a/.d/e.png", "a/f.g/h.png"):
        store.write_bytes(path, b"")
    assert sorted(file.path for file in store.files()) == ["a/b.png", "a/f.g/h.png"]


def test_a_changed_file_has_another_version_and_an_untouched_one_the_same(store):
    store.write_bytes("a", b"old")
    store.write_bytes("b", b"old")
    before = {file.path: file.version for file in store.files()}
    store.write_bytes("a", b"new")
    after = {file.path: file.version for file in store.files()}
    assert after["a"] != before["a"]
    assert after["b"] == before["b"]


def test_a_removed_file_is_gone_and_may_be_removed_again(store):
    store.write_bytes("a/b", b"")
    assert store.exists("a/b")
    assert not store.exists("a")
    store.remove("a/b")
    store.remove("a/b")
    assert not store.exists("a/b")


def test_a_missing_source_is_a_one_line_error(store):
    assert list(store.files()) == []
    assert error_of(store.check_source).startswith(f"{store.place}: expected a folder, found no")
    store.write_bytes("a", b"")
    store.check_source()


def test_a_missing_file_is_named_in_full(store, tmp_path):
    store.check_destination()
    assert error_of(lambda: store.read_bytes("a/b")).startswith(
        f"{store.at('a/b')}: expected a readable file"
    )
    assert not list(tmp_path.rglob("b"))


def test_a_store_can_be_sent_to_another_process(store):
    store.write_bytes("a", b"here")
    assert pickle.loads(pickle.dumps(store)).read_bytes("a") == b"here"


# On a disk


def test_a_file_url_is_a_path(tmp_path):
    assert store_at(f"file://{tmp_path}/a") == store_at(tmp_path / "a") == store_at(f"{tmp_path}/a/")


def test_links_to_files_are_followed_and_links_to_folders_are_not(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "b.png").write_bytes(b"123")
    (tmp_path / "a" / "c.png").symlink_to("b.png")
    (tmp_path / "a" / "broken.png").symlink_to("none.png")
    (tmp_path / "a" / "again").symlink_to("..")
    assert [file[:2] for file in store_at(tmp_path).files()] == [("a/b.png", 3), ("a/c.png", 3)]


def test_a_link_that_leads_to_itself_is_left_out(tmp_path):
    (tmp_path / "loop.png").symlink_to("loop.png")
    (tmp_path / "other.png").touch()
    assert [file.path for file in store_at(tmp_path).files()] == ["other.png"]


def test_a_file_that_is_removed_while_it_is_listed_is_left_out(tmp_path):
    (tmp_path / "a").write_bytes(b"1")
    [entry] = stores._list_entries(tmp_path)
    assert stores._read_status(entry).st_size == 1
    [entry] = stores._list_entries(tmp_path)
    (tmp_path / "a").unlink()
    assert stores._read_status(entry) is None


def test_a_path_needs_no_library_for_object_stores(tmp_path):
    program = (
        "import json, sys; from stereoweave.io.stores import store_at\n"
        "store_at(sys.argv[1]).check_destination()\n"
        "print(json.dumps([name for name in ('fsspec', 's3fs', 'botocore') if name in sys.modules]))"
    )
    run = subprocess.run([sys.executable, "-c", program, str(tmp_path)], capture_output=True, check=True)
    assert json.loads(run.stdout) == []


# In an object store


def test_more_files_than_a_page_holds_are_all_listed_once(bucket, monkeypatch):
    monkeypatch.setenv("MOTO_S3_DEFAULT_MAX_KEYS", "2")
    store = store_at(f"{bucket}/many")
    names = [f"{number}.png" for number in range(5)]
    for name in names:
        store.write_bytes(name, b"")
    assert [file.path for file in store.files()] == names


def test_a_folder_s_marker_and_an_object_with_its_name_as_prefix_are_not_listed(bucket, s3):
    for path in ("a/", "a/b/", "a/b/c.png", "ab.png", "a"):
        put_object(s3, f"{bucket[5:]}/{path}")
    assert [file.path for file in store_at(f"{bucket}/a/").files()] == ["b/c.png"]
    assert sorted(file.path for file in store_at(bucket).files()) == ["a", "a/b/c.png", "ab.png"]


def test_a_path_that_leads_out_of_the_folder_is_not_listed(bucket, s3):
    put_object(s3, f"{bucket[5:]}/a/%2E%2E/%2E%2E/b.png")
    assert list(store_at(bucket).files()) == []


def test_a_missing_bucket_is_named(s3, tmp_path):
    store = store_at("s3://nobodys-bucket/pairs")
    for check in (store.check_source, store.check_destination):
        message = error_of(check)
        expected = "s3://nobodys-bucket/pairs: expected a bucket, found none named nobodys-bucket"
        assert message.startswith(expected)
        assert "AWS_ENDPOINT_URL" in message
    assert "bucket does not exist" in error_of(lambda: store.write_bytes("a", b""))
    assert "bucket does not exist" in error_of(lambda: list(store.files()))
    assert "bucket does not exist" in error_of(lambda: store.fetch("a.png", tmp_path))
    assert list(tmp_path.iterdir()) == []


def test_unknown_keys_and_keys_without_permission_are_reported(bucket, s3, monkeypatch):
    store = store_at(bucket)
    keys = keys_that_allow_nothing()
    with with_permissions_checked(s3):
        with another_environment(monkeypatch):
            message = error_of(store.check_source)
            assert message.startswith(
                f"{bucket}: expected a folder that can be listed, found no permission ("
            )
            assert "Access Key Id you provided does not exist" in message
        with another_environment(monkeypatch, **keys):
            assert "found no permission (Access Denied" in error_of(store.check_source)
            message = error_of(lambda: store.write_bytes("a", b""))
            assert message.startswith(f"{bucket}/a: expected a writable file, found no permission (")
            assert "found no permission (" in error_of(lambda: store.exists("a"))


def test_missing_keys_are_reported_with_their_environment_variables(bucket, monkeypatch):
    with another_environment(monkeypatch), monkeypatch.context() as patch:
        patch.delenv("AWS_ACCESS_KEY_ID")
        message = error_of(store_at(bucket).check_source)
    assert "found no usable keys (Unable to locate credentials); set AWS_ACCESS_KEY_ID" in message


def test_an_endpoint_that_refuses_connections_is_reported(bucket, monkeypatch):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        endpoint = f"http://127.0.0.1:{taken.getsockname()[1]}"
        with another_environment(monkeypatch, AWS_ENDPOINT_URL=endpoint):
            message = error_of(store_at(bucket).check_source)
    assert "found no answer (Could not connect to the endpoint URL" in message
    assert message.endswith("check the network and AWS_ENDPOINT_URL")


def test_an_endpoint_that_does_not_answer_fails_within_seconds(bucket, monkeypatch):
    monkeypatch.setattr("stereoweave.io.stores._ANSWER_S", 0.2)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        endpoint = f"http://127.0.0.1:{silent.getsockname()[1]}"
        with another_environment(monkeypatch, AWS_ENDPOINT_URL=endpoint):
            assert "found no answer (" in error_of(store_at(bucket).check_source)


# Invalid places


@pytest.mark.parametrize(
    ("place", "found"),
    [
        ("ftp://host/pairs", "found ftp://"),
        ("memory://pairs", "found memory://"),
        ("https://host/pairs", "found https://"),
        ("s3://", "expected s3://bucket/folder, found no bucket"),
        ("s3:///pairs", "expected s3://bucket/folder, found no bucket"),
    ],
)
def test_a_url_of_an_unknown_store_is_refused(place, found):
    message = error_of(lambda: store_at(place))
    assert message.startswith(f"{place}: expected ")
    assert found in message


@pytest.mark.parametrize(
    ("place", "library"), [("gs://b/a", "gcsfs"), ("az://b/a", "adlfs"), ("s3://b", "s3fs")]
)
def test_a_store_whose_library_is_missing_names_the_extra(place, library, monkeypatch):
    monkeypatch.setitem(sys.modules, library, None)
    message = error_of(lambda: store_at(place))
    assert message.startswith(
        f"{place}: {place[:2]}:// needs the library {library}, but the module {library} "
    )
    assert "install the extra 'cluster'" in message


def test_a_missing_azure_account_is_reported_with_its_environment_variables(monkeypatch):
    monkeypatch.delenv("AZURE_STORAGE_ACCOUNT_NAME", raising=False)
    monkeypatch.delenv("AZURE_STORAGE_CONNECTION_STRING", raising=False)
    message = error_of(store_at("az://container/pairs").check_source)
    assert "found no usable keys (" in message
    assert "AZURE_STORAGE_ACCOUNT_NAME" in message


def test_a_folder_without_write_permission_is_reported(tmp_path):
    (tmp_path / "file").touch()
    assert "found a file" in error_of(store_at(tmp_path / "file").check_destination)
    assert "found a file" in error_of(store_at(tmp_path / "file").check_source)
