"""What a matcher file is run on: ONNX Runtime's providers, by name, and one line where one is missing.

Where a provider cannot be had, ONNX Runtime logs that and goes on with the processor. Here it is an error:
who asks for a GPU is never served by the processor unknowingly. Only operations that a provider does not have
are left to the next one, which is CUDA for TensorRT's, and the processor in the end.
"""

import contextlib
import importlib
import io
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stereoweave.arguments import check_kind
from stereoweave.errors import MatcherError, ProviderError, Remedy

CPU = "cpu"
_USE_CPU = Remedy(f"or run it on {CPU}", ("provider",))


@dataclass(frozen=True, kw_only=True)
class Provider:
    """How ONNX Runtime is asked for a provider.

    Attributes:
        name: ONNX Runtime's name of it.
        needs: What a machine must have, and how to install it.
        options: ONNX Runtime's options for it, by the number of threads.
        then: Who has the operations that it does not have, by the name in `PROVIDERS`.
        batches: Whether it is given several pairs at once, as a GPU is. A processor is slower with them, for
            their maps leave its caches (measured: 53 ms a pair of 320x240 in a batch of 8, 35 ms alone).
    """

    name: str
    needs: str
    options: Callable[[int], dict[str, str]] = lambda threads: {}
    then: str = CPU
    batches: bool = False


def _cuda_options(threads: int) -> dict[str, str]:
    return {
        # Not the exhaustive search, which tries all ways of each convolution anew for every size of picture.
        "cudnn_conv_algo_search": "HEURISTIC",
        # By default each enlargement doubles the memory, of which other processes may need some.
        "arena_extend_strategy": "kSameAsRequested",
        # Products of numbers with 10 bits would not be the processor's to a part of a pixel.
        "use_tf32": "0",
    }


def _tensorrt_options(threads: int) -> dict[str, str]:
    """An engine takes minutes to build: it is kept in the user's place for caches, if that can be written."""
    from stereoweave.system.jit import cache_folder  # imports Numba

    folder = cache_folder().with_name("tensorrt")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return {}
    return {
        f"trt_{kind}_cache_{key}": value
        for kind in ("engine", "timing")
        # In Python's words: a 1, which CUDA's options may have, TensorRT's refuse.
        for key, value in (("enable", "True"), ("path", str(folder)))
    }


def _openvino_options(threads: int) -> dict[str, str]:
    # Not AUTO: with it ONNX Runtime 1.24 leaves every operation to its own provider.
    return {"device_type": "CPU", "precision": "FP32", "num_of_threads": str(threads)}


def _instead(package: str) -> str:
    """How to change packages: they overwrite one another's files, so that both together are one of them."""
    return (
        f"{package} instead of onnxruntime: pip uninstall onnxruntime {package}, then pip install {package}"
    )


_NVIDIA = f"an NVIDIA GPU with its driver, and {_instead('onnxruntime-gpu')}[cuda,cudnn]"
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
        needs=_instead("onnxruntime-openvino"),
        options=_openvino_options,
    ),
    "coreml": Provider(
        name="CoreMLExecutionProvider",
        needs="macOS, whose onnxruntime has it",
        options=lambda threads: {"ModelFormat": "MLProgram"},
    ),
    "directml": Provider(
        name="DmlExecutionProvider",
        needs=f"Windows with DirectX 12, and {_instead('onnxruntime-directml')}",
        batches=True,
    ),
}


def check_provider(provider: str) -> None:
    """MatcherError for a name that is none, or a provider that the installed ONNX Runtime does not have."""
    import onnxruntime  # type: ignore[import-untyped]

    check_kind("provider", provider, str)
    if provider not in PROVIDERS:
        raise MatcherError(f"expected one of {', '.join(PROVIDERS)}, found {provider!r}", setting="provider")
    there = [name for name, known in PROVIDERS.items() if known.name in onnxruntime.get_available_providers()]
    if provider not in there:
        raise MatcherError(
            f"provider {provider}: expected an ONNX Runtime that has it, found version "
            f"{onnxruntime.__version__} with {', '.join(there)}; it needs {PROVIDERS[provider].needs}"
        )


def open_session(path: Path, provider: str, threads: int) -> Any:
    """ONNX Runtime's session of a matcher file on a provider, with so many threads on the processor.

    Raises:
        MatcherError: The provider is unknown, missing or cannot begin, or ONNX Runtime refuses the file.
    """
    check_provider(provider)
    if provider == CPU:
        return _opened(path, CPU, threads)
    with _without_log():
        _load_libraries(provider)
        try:
            session = _opened(path, provider, threads)
        except MatcherError as error:
            _opened(path, CPU, threads)  # a file that is refused here too is at fault, and not the provider
            raise _cannot_begin(provider, _line(error.__cause__)) from error
    if PROVIDERS[provider].name not in session.get_providers():
        raise _cannot_begin(provider, "a library or a device that is missing")
    if _takes_nothing(session, PROVIDERS[provider].name):
        raise MatcherError(
            f"{path}: expected a matcher with operations that provider {provider} has, found none; export it "
            "for a fixed size with `stereoweave export`",
            remedy=_USE_CPU,
        )
    return session


@contextmanager
def running(provider: str, path: Path) -> Iterator[None]:
    """Turns what goes wrong in a run into one line: of the provider that failed, or of the matcher file."""
    try:
        yield
    except Exception as error:  # ONNX Runtime's have no common base class
        out_of_memory = isinstance(error, MemoryError) or "alloc" in str(error).lower()
        unfit = type(error).__name__ == "InvalidArgument"
        if unfit or (provider == CPU and not out_of_memory):
            raise _refused(path, error) from error
        raise ProviderError(
            f"provider {provider}: expected to run {path.name}, found that it failed: {_line(error)}; "
            "use smaller pictures, or fewer processes at a time on the device",
            remedy=None if provider == CPU else _USE_CPU,
        ) from error


def _opened(path: Path, provider: str, threads: int) -> Any:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    # Not ONNX Runtime's own choice: on a virtual machine it counts two cores as one with two threads.
    options.intra_op_num_threads = threads
    # Else its threads go on waiting busily after a run, and slow down what runs next on these cores.
    options.add_session_config_entry("session.force_spinning_stop", "1")
    options.log_severity_level = 4  # what is wrong with a file is said once, by the error below
    if provider != CPU:
        options.add_session_config_entry("session.record_ep_graph_assignment_info", "1")
        options.enable_mem_pattern = provider != "directml"  # which cannot work with it
    names = [provider]
    while names[-1] != CPU:
        names.append(PROVIDERS[names[-1]].then)
    providers = [(PROVIDERS[name].name, PROVIDERS[name].options(threads)) for name in names]
    try:
        # Without its fallback, which would go on with the processor when the provider fails.
        return onnxruntime.InferenceSession(str(path), options, providers=providers, enable_fallback=0)
    except Exception as error:  # they have no common base class
        raise _refused(path, error) from error


def _load_libraries(provider: str) -> None:
    """Loads what pip has installed of CUDA and TensorRT, which is not where a system's libraries are."""
    import onnxruntime

    if provider in ("cuda", "tensorrt") and hasattr(onnxruntime, "preload_dlls"):
        with contextlib.redirect_stdout(io.StringIO()):
            onnxruntime.preload_dlls()
    if provider == "tensorrt":
        with contextlib.suppress(ImportError):
            importlib.import_module("tensorrt")


@contextmanager
def _without_log() -> Iterator[None]:
    """Meanwhile ONNX Runtime logs nothing: what it has to say becomes an error."""
    import onnxruntime

    onnxruntime.set_default_logger_severity(4)
    try:
        yield
    finally:
        onnxruntime.set_default_logger_severity(2)  # as it is by default


def _takes_nothing(session: Any, name: str) -> bool:
    """Whether all of a graph is left to others; only ONNX Runtime 1.24 and later tell."""
    if not hasattr(session, "get_provider_graph_assignment_info"):
        return False
    return all(part.ep_name != name for part in session.get_provider_graph_assignment_info())


def _cannot_begin(provider: str, found: str) -> MatcherError:
    return MatcherError(
        f"provider {provider}: expected to begin, found {found}; it needs {PROVIDERS[provider].needs}"
    )


def _refused(path: Path, error: Exception) -> MatcherError:
    return MatcherError(
        f"{path}: expected an ONNX matcher, found a file ONNX Runtime refuses: {_line(error)}"
    )


def _line(error: BaseException | None) -> str:
    """What ONNX Runtime says first, without the place in its sources."""
    line = (str(error).splitlines() or [type(error).__name__])[0]
    return re.sub(r"/\S+:\d+ [^(]*\(.*?\) ", "", line)
