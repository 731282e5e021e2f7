"""ONNX Runtime execution providers.

If a provider is unavailable, ONNX Runtime logs a message and falls back to the CPU. Here an error is raised
instead, so a request for a GPU never runs on the CPU unnoticed. Only operations that a provider does not
support run on the next provider: CUDA after TensorRT, and finally the CPU.
"""

import contextlib
import importlib
import io
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stereoweave.arguments import check_choice, check_kind
from stereoweave.errors import MatcherError, ProviderError, Remedy

CPU = "cpu"
_USE_CPU = Remedy(f"or run it on {CPU}", ("provider",))


@dataclass(frozen=True, kw_only=True)
class Provider:
    """Settings of an execution provider.

    Attributes:
        name: The provider's name in ONNX Runtime.
        needs: Requirements, and how to install them.
        options: Function that returns ONNX Runtime's provider options for a number of threads.
        then: Name in `PROVIDERS` of the provider that runs the operations this provider does not support.
        batches: Whether a batch of pairs is faster than single pairs, as on a GPU. On a CPU, batches are
            slower because their feature maps do not fit in the caches (measured at 320x240: 53 ms per pair in
            a batch of 8, 35 ms for a single pair).
    """

    name: str
    needs: str
    options: Callable[[int], dict[str, str]] = lambda threads: {}
    then: str = CPU
    batches: bool = False


def _cuda_options(threads: int) -> dict[str, str]:
    return {
        # The exhaustive search would try every convolution algorithm for each new image size.
        "cudnn_conv_algo_search": "HEURISTIC",
        # By default, the arena doubles whenever it grows, and takes memory that other processes may need.
        "arena_extend_strategy": "kSameAsRequested",
        # TF32 has 10 mantissa bits, too few to match the CPU's disparities to a fraction of a pixel.
        "use_tf32": "0",
    }


def _tensorrt_options(threads: int) -> dict[str, str]:
    """Return options that cache engines, which take minutes to build, if the cache folder is writable."""
    from stereoweave.system.kernel_cache import cache_folder

    folder = cache_folder().with_name("tensorrt")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return {}
    return {
        f"trt_{kind}_cache_{key}": value
        for kind in ("engine", "timing")
        # TensorRT's options, unlike CUDA's, accept "True" but not "1".
        for key, value in (("enable", "True"), ("path", str(folder)))
    }


def _openvino_options(threads: int) -> dict[str, str]:
    # With AUTO, ONNX Runtime 1.24 assigns every operation to its own CPU provider.
    return {"device_type": "CPU", "precision": "FP32", "num_of_threads": str(threads)}


def _explain_replacement(package: str) -> str:
    """Explain how to replace onnxruntime, which cannot be installed together with `package`."""
    return (
        f"{package} instead of onnxruntime: pip uninstall onnxruntime {package}, then pip install {package}"
    )


_NVIDIA = f"an NVIDIA GPU with its driver, and {_explain_replacement('onnxruntime-gpu')}[cuda,cudnn]"
PROVIDERS: dict[str, Provider] = {
    CPU: Provider(name="CPUExecutionProvider", needs="onnxruntime"),
    "cuda": Provider(
        name="CUDAExecutionProvider",
        needs=_NVIDIA,
        options=_cuda_options,
        batches=True,
    ),
    "tensorrt": Provider(
        name="TensorrtExecutionProvider",
        needs=f"{_NVIDIA} tensorrt",
        options=_tensorrt_options,
        then="cuda",
        batches=True,
    ),
    "openvino": Provider(
        name="OpenVINOExecutionProvider",
        needs=_explain_replacement("onnxruntime-openvino"),
        options=_openvino_options,
    ),
    "coreml": Provider(
        name="CoreMLExecutionProvider",
        needs="macOS, whose onnxruntime includes it",
        options=lambda threads: {"ModelFormat": "MLProgram"},
    ),
    "directml": Provider(
        name="DmlExecutionProvider",
        needs=f"Windows with DirectX 12, and {_explain_replacement('onnxruntime-directml')}",
        batches=True,
    ),
}


def check_provider(provider: str) -> None:
    """Raise MatcherError if the provider is unknown or the installed ONNX Runtime does not include it."""
    import onnxruntime  # type: ignore[import-untyped]

    check_kind("provider", provider, str)
    check_choice("provider", provider, PROVIDERS, MatcherError)
    there = [name for name, known in PROVIDERS.items() if known.name in onnxruntime.get_available_providers()]
    if provider not in there:
        raise MatcherError(
            f"provider {provider}: expected an ONNX Runtime that includes it, found version "
            f"{onnxruntime.__version__} with {', '.join(there)}; "
            f"the provider needs {PROVIDERS[provider].needs}"
        )


def open_session(path: Path, provider: str, threads: int) -> Any:
    """Open an ONNX Runtime session for a matcher file, with `threads` threads on the CPU.

    Raises:
        MatcherError: The provider is unknown, unavailable or fails to start, or the file is invalid.
    """
    check_provider(provider)
    if provider == CPU:
        return _create_session(path, CPU, threads)
    with _silence_log():
        _load_libraries(provider)
        try:
            session = _create_session(path, provider, threads)
        except MatcherError as error:
            _create_session(path, CPU, threads)  # if this fails too, the file is invalid, not the provider
            raise _start_error(provider, _first_line(error.__cause__)) from error
    if PROVIDERS[provider].name not in session.get_providers():
        raise _start_error(provider, "a missing library or device")
    if _runs_nothing(session, PROVIDERS[provider].name):
        raise MatcherError(
            f"{path}: expected a matcher with operations that provider {provider} supports, found only "
            "unsupported ones; export the matcher for a fixed size with `stereoweave export`",
            remedy=_USE_CPU,
        )
    return session


def open_session_of_size(graph: bytes, path: Path, threads: int, sizes: Mapping[str, int]) -> Any:
    """Open a session on the CPU for inputs of one size.

    Args:
        graph: Contents of the matcher file.
        path: Its path, for errors.
        threads: Number of threads.
        sizes: Sizes of the free dimensions, by name.

    Raises:
        MatcherError: The network cannot have these sizes.
    """
    return _create_session(path, CPU, threads, graph, sizes)


@contextmanager
def explain_failure(provider: str, path: Path) -> Iterator[None]:
    """Turn exceptions during a run into one-line errors that blame the provider or the matcher file."""
    try:
        yield
    except Exception as error:  # ONNX Runtime's exceptions have no common base class
        out_of_memory = isinstance(error, MemoryError) or "alloc" in str(error).lower()
        unfit = type(error).__name__ == "InvalidArgument"
        if unfit or (provider == CPU and not out_of_memory):
            raise _file_error(path, error) from error
        raise ProviderError(
            f"provider {provider}: failed to run {path.name}: {_first_line(error)}; "
            "use smaller pictures, or run fewer processes on the device at a time",
            remedy=None if provider == CPU else _USE_CPU,
        ) from error


def _create_session(
    path: Path,
    provider: str,
    threads: int,
    graph: bytes | None = None,
    sizes: Mapping[str, int] | None = None,
) -> Any:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    # By default, ONNX Runtime mistakes two cores of a virtual machine for one core with two hardware threads.
    options.intra_op_num_threads = threads
    # By default, the threads keep spinning after a run and slow down other work on the same cores.
    options.add_session_config_entry("session.force_spinning_stop", "1")
    options.log_severity_level = 4  # the error below reports problems with the file
    for name, size in (sizes or {}).items():
        options.add_free_dimension_override_by_name(name, size)
    if provider != CPU:
        options.add_session_config_entry("session.record_ep_graph_assignment_info", "1")
        options.enable_mem_pattern = provider != "directml"  # DirectML does not support it
    names = [provider]
    while names[-1] != CPU:
        names.append(PROVIDERS[names[-1]].then)
    providers = [(PROVIDERS[name].name, PROVIDERS[name].options(threads)) for name in names]
    try:
        # Do not fall back to the CPU if the provider fails.
        return onnxruntime.InferenceSession(
            str(path) if graph is None else graph, options, providers=providers, enable_fallback=0
        )
    except Exception as error:  # no common base class, as above
        raise _file_error(path, error) from error


def _load_libraries(provider: str) -> None:
    """Load the CUDA and TensorRT libraries that pip installed, which are not on the system's library path."""
    import onnxruntime

    if provider in ("cuda", "tensorrt") and hasattr(onnxruntime, "preload_dlls"):
        with contextlib.redirect_stdout(io.StringIO()):
            onnxruntime.preload_dlls()
    if provider == "tensorrt":
        with contextlib.suppress(ImportError):
            importlib.import_module("tensorrt")


@contextmanager
def _silence_log() -> Iterator[None]:
    """Silence ONNX Runtime's log, because failures are raised as errors instead."""
    import onnxruntime

    onnxruntime.set_default_logger_severity(4)
    try:
        yield
    finally:
        onnxruntime.set_default_logger_severity(2)  # the default


def _runs_nothing(session: Any, name: str) -> bool:
    """Return whether the provider runs none of the graph's operations; False before ONNX Runtime 1.24."""
    if not hasattr(session, "get_provider_graph_assignment_info"):
        return False
    return all(part.ep_name != name for part in session.get_provider_graph_assignment_info())


def _start_error(provider: str, found: str) -> MatcherError:
    return MatcherError(
        f"provider {provider}: failed to start: {found}; the provider needs {PROVIDERS[provider].needs}"
    )


def _file_error(path: Path, error: Exception) -> MatcherError:
    return MatcherError(
        f"{path}: expected an ONNX matcher file, found a file that ONNX Runtime rejects: {_first_line(error)}"
    )


def _first_line(error: BaseException | None) -> str:
    """Return the first line of ONNX Runtime's message, without its source location."""
    line = (str(error).splitlines() or [type(error).__name__])[0]
    return re.sub(r"/\S+:\d+ [^(]*\(.*?\) ", "", line)
