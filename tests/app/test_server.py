"""The page's server restricts who may open the page and which files it serves."""

import http.client
import socket
import sys
from collections.abc import Iterator
from contextlib import closing

import pytest
from other_processes import UNMEASURED
from page_examples import start, stop

from stereoweave.cli.root import main

pytestmark = pytest.mark.system


@pytest.fixture(scope="module")
def address(tmp_path_factory) -> Iterator[str]:
    server, address = start(tmp_path_factory.mktemp("page"), **UNMEASURED)
    yield address
    assert stop(server) == ""


def asked(address: str, path: str = "/", **headers: str) -> http.client.HTTPResponse:
    with closing(http.client.HTTPConnection(address.removeprefix("http://"), timeout=20)) as connection:
        connection.request("GET", path, headers=headers)
        answer = connection.getresponse()
        answer.read()
        return answer


def test_browsers_are_told_to_load_nothing_from_other_servers(address):
    policy = asked(address).headers["content-security-policy"]
    sources = set(policy.removeprefix("default-src ").split())
    assert sources == {"'self'", "'unsafe-inline'", "'unsafe-eval'", "data:", "blob:"}


def test_a_foreign_name_for_this_computer_does_not_open_the_page(address):
    port = address.rsplit(":", 1)[1]
    for name in ("somewhere.example", "127.0.0.1.somewhere.example", "[", "127.0.0.1@somewhere.example", ""):
        assert asked(address, Host=f"{name}:{port}").status == 400, name
        assert asked(address, "/gradio_api/info", Host=f"{name}:{port}").status == 400, name
    assert asked(address, Host=f"localhost:{port}").status == 200


@pytest.mark.parametrize("path", [__file__, "/etc/passwd", "../../etc/passwd", "%2Fetc%2Fpasswd"])
def test_a_file_that_nobody_uploaded_is_not_served(address, path):
    assert asked(address, f"/gradio_api/file={path}").status == 403


def test_only_this_computer_is_served(address):
    port = int(address.rsplit(":", 1)[1])
    assert address == f"http://127.0.0.1:{port}"
    # A second address of this computer: only a server that listens on all addresses would answer.
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.2", port), timeout=5)


def test_an_address_for_other_computers_is_told_and_shown_as_this_computer_reaches_it(tmp_path):
    server, address = start(tmp_path, "--host", "0.0.0.0", **UNMEASURED)
    assert address.startswith("http://127.0.0.1:")
    assert asked(address, Host="name-of-this-computer.example").status == 200
    expected = "The page has no password and no encryption, and other computers can reach it.\n"
    assert server.stdout.readline() == expected
    assert stop(server) == ""


def test_a_port_in_use_is_a_one_line_error(address, capsys):
    port = address.rsplit(":", 1)[1]
    assert main(["app", "--port", port]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert f"--port {port}: expected" in said


def test_without_gradio_the_extra_is_named(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "gradio", None)
    for name in ("page", "server"):
        monkeypatch.delitem(sys.modules, f"stereoweave.app.{name}", raising=False)
    assert main(["app", "--port", "0"]) == 2
    assert "install the extra 'app'" in capsys.readouterr().err
