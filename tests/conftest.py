"""Fixtures that tests share, and handling of tests that need more than a bare machine has.

A marker from `CAPABILITIES` states what a test needs. If that is missing, the test is skipped and counted in
the summary; with STEREOWEAVE_REQUIRE_ALL=1 it fails instead.
"""

import gc
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple
from urllib.request import Request, urlopen
from uuid import uuid4

import jaxtyping
import numpy as np
import pytest
from other_processes import UNMEASURED, find_free_ports, list_processes
from tracing import without_tracer
from xdist.workermanage import WorkerController

TESTDATA = Path(
    os.environ.get("STEREOWEAVE_TESTDATA") or Path(__file__).resolve().parent.parent.parent / "shared"
)


class Capability(NamedTuple):
    present: bool
    tests: str
    missing: str


def renders() -> bool:
    """Return whether OpenGL works without a window; tested in another process, which a driver may crash."""
    program = "import moderngl; moderngl.create_context(standalone=True, backend='egl')"
    return subprocess.run([sys.executable, "-c", program], capture_output=True, check=False).returncode == 0


CAPABILITIES = {
    "testdata": Capability(
        (TESTDATA / "stereo").is_dir(), "on the real pictures", f"STEREOWEAVE_TESTDATA={TESTDATA} not found"
    ),
    "needs_chromium": Capability(
        shutil.which("chromium") is not None, "in a browser", "no chromium on the PATH"
    ),
    "needs_strace": Capability(shutil.which("strace") is not None, "under strace", "no strace on the PATH"),
    "needs_nginx": Capability(
        shutil.which("nginx", path=f"{os.environ['PATH']}:/usr/sbin") is not None,
        "behind nginx",
        "no nginx: apt install nginx-light",
    ),
    "needs_egl": Capability(renders(), "of the renderer", "no EGL: apt install libegl1 libgl1-mesa-dri"),
    "needs_git": Capability(
        (Path(__file__).resolve().parent.parent / ".git").exists(), "of what git tracks", "no git checkout"
    ),
}

# The value that `ray_engine.set_environment` sets before it imports Ray; tests import Ray earlier.
os.environ["RAY_DEDUP_LOGS_SKIP_REGEX"] = ".*"
# PyTorch reads it when it is imported. Its exporter takes a sixth less time without this cache.
os.environ["TORCH_FAKE_TENSOR_DISPATCH_CACHE"] = "0"

# Stereoweave sets it to 0 when it starts Ray itself. A cluster started with it would listen only on the
# loopback address, but the processes of the tests have imported Ray without it, and expect another address.
LOOPBACK_ALONE = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"

# The garbage collector would traverse all imported modules repeatedly, for a quarter of the tests' time.
gc.disable()

# Files that take minutes, besides those directly in tests/.
LONG = ("test_deployment.py", "test_ray_engine.py")

MISSING = [name for name, capability in CAPABILITIES.items() if not capability.present]
LEFT_OUT = pytest.StashKey[dict[str, int]]()


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    # The longest first: one process would end late because of them.
    items.sort(key=lambda item: item.path.parent != Path(__file__).parent and item.path.name not in LONG)
    if os.environ.get("STEREOWEAVE_REQUIRE_ALL") == "1":
        return
    left_out = [item for item in items if any(map(item.get_closest_marker, MISSING))]
    config.stash[LEFT_OUT] = {
        name: sum(item.get_closest_marker(name) is not None for item in left_out) for name in MISSING
    }
    if hasattr(config, "workeroutput"):  # a worker of pytest-xdist; the controller shows the results
        config.workeroutput["left_out"] = config.stash[LEFT_OUT]
    items[:] = [item for item in items if item not in left_out]
    config.hook.pytest_deselected(items=left_out)


@pytest.hookimpl(trylast=True)
def pytest_collection_finish() -> None:
    gc.freeze()
    gc.enable()


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: WorkerController) -> None:
    node.config.stash[LEFT_OUT] = node.workeroutput.get("left_out", {})


def pytest_runtest_setup(item: pytest.Item) -> None:
    for name in filter(item.get_closest_marker, MISSING):
        pytest.fail(f"{CAPABILITIES[name].missing}; STEREOWEAVE_REQUIRE_ALL=1 forbids skipping this test")


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    for name, count in config.stash.get(LEFT_OUT, {}).items():
        if count:
            capability = CAPABILITIES[name]
            terminalreporter.write_line(
                f"left out: {count} tests {capability.tests}: {capability.missing}", yellow=True
            )


@pytest.fixture
def untraced() -> Iterator[None]:
    """Run a test of processor time without the tracer of coverage (see `tracing`)."""
    with without_tracer():
        yield


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture(scope="session")
def testdata() -> Path:
    """Return the folder of real pictures and the referee, for tests with the marker `testdata`."""
    return TESTDATA


@pytest.fixture
def without_shape_checks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Disable jaxtyping's checks, so that a test sees the errors that users see."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


@pytest.fixture(scope="session")
def ray_address(s3: str) -> Iterator[str]:
    """Yield the address, for `--address`, of a Ray cluster with 2 CPUs that can reach the S3 server."""
    variables = {
        # As if each start of a proxy of Ray Serve were slow; the service must wait for it nevertheless.
        "RAY_SERVE_PROXY_READY_CHECK_TIMEOUT_S": "0.1",
        # A replica that fails to start is not started a second time, which takes long.
        "RAY_SERVE_MAX_PER_REPLICA_RETRY_COUNT": "1",
    }
    with ray_head(cpus=2, **variables) as address:
        yield address


@pytest.fixture
def guarded_ray_address() -> Iterator[str]:
    """Yield the address of a Ray cluster whose token is 64 times the letter a."""
    with ray_head(cpus=1, RAY_AUTH_MODE="token", RAY_AUTH_TOKEN=64 * "a") as address:
        yield address


@contextmanager
def ray_head(cpus: int, **variables: str) -> Iterator[str]:
    """Run a Ray cluster on free ports until the end of the block. Yields its address."""
    port, client_port = find_free_ports(2)
    # Directly below /tmp: the names of Unix sockets have at most 107 bytes.
    with tempfile.TemporaryDirectory(prefix="sw-", dir="/tmp", ignore_cleanup_errors=True) as folder:
        options = {
            "node-ip-address": "127.0.0.1",
            "port": port,
            "ray-client-server-port": client_port,
            "dashboard-agent-listen-port": 0,
            "temp-dir": folder,
            "num-cpus": cpus,
            "object-store-memory": 150_000_000,
            "include-dashboard": "false",
            "include-log-monitor": "false",
        }
        command = [sys.executable, "-m", "ray.scripts.scripts", "start", "--head", "--block"]
        command += ["--disable-usage-stats", *(f"--{name}={value}" for name, value in options.items())]
        log = Path(folder, "start.log")
        root = Path(__file__).parent.parent
        paths = [str(root), str(root / "tests" / "helpers"), *filter(None, [os.environ.get("PYTHONPATH")])]
        with log.open("wb") as out:
            environment = {name: value for name, value in os.environ.items() if name != LOOPBACK_ALONE} | {
                **UNMEASURED,
                # A token in the user's home folder would otherwise be required.
                "RAY_AUTH_MODE": "disabled",
                # With usage reports turned off, the head node would still report that they are off.
                "RAY_USAGE_STATS_REPORT_URL": "http://127.0.0.1:9",
                # Workers import modules of the tests.
                "PYTHONPATH": os.pathsep.join(paths),
                # Other tests keep all cores busy.
                "RAY_worker_niceness": "0",
                **variables,
            }
            head = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT, env=environment)
        try:
            while head.poll() is None and "Ray runtime started" not in log.read_text():
                time.sleep(0.05)
            assert head.poll() is None, log.read_text()
            yield f"127.0.0.1:{port}"
        finally:
            # On SIGTERM it would wait for half a minute. All processes of the cluster are among its children.
            for process in list_processes(head.pid):
                with suppress(ProcessLookupError):
                    os.kill(process, signal.SIGKILL)
            head.wait()


@pytest.fixture(scope="session")
def s3() -> Iterator[str]:
    """Yield the endpoint of an S3 server on this machine, which the environment variables point to."""
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer("127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    settings = {
        "AWS_ENDPOINT_URL": f"http://{host}:{port}",
        "AWS_ACCESS_KEY_ID": "testing",
        "AWS_SECRET_ACCESS_KEY": "testing",
        "AWS_DEFAULT_REGION": "us-east-1",
        # Ignore the AWS settings of this machine's user.
        "AWS_CONFIG_FILE": os.devnull,
        "AWS_SHARED_CREDENTIALS_FILE": os.devnull,
        "AWS_EC2_METADATA_DISABLED": "true",
    }
    with pytest.MonkeyPatch.context() as patch:
        for name, value in settings.items():
            patch.setenv(name, value)
        yield settings["AWS_ENDPOINT_URL"]
    server.stop()


@pytest.fixture
def bucket(s3: str) -> str:
    """Return the URL of a new bucket on the S3 server."""
    name = f"bucket-{uuid4().hex}"
    urlopen(Request(f"{s3}/{name}", method="PUT")).close()
    return f"s3://{name}"


@pytest.fixture
def default_interrupts():
    """Restore the handler for Ctrl-C, which Python ignores if a shell starts the tests in the background."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)
