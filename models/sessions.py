"""onnxruntime sessions that run where they were told to run, in bounded memory."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from models.errors import ModelError, PackError, ProviderUnavailable

_SUFFIX = "ExecutionProvider"
# onnxruntime writes warnings about declared output shapes to stderr for every detector that runs
# at another size than it was exported for; errors still reach us as exceptions.
_LOG_ERRORS_ONLY = 3
# No folder: weights that lie outside the file would escape its hash.
_NO_FOLDER = f"{os.devnull}/weights"


def available_providers() -> dict[str, str]:
    """Execution providers of the installed onnxruntime: their full names by the short ones."""
    names = ort.get_available_providers()
    return {name.removesuffix(_SUFFIX).lower(): name for name in names}


def resolve_providers(names: Sequence[str]) -> list[str]:
    """Full names of the providers that are asked for, by full or short ones, in their order."""
    available = available_providers()
    short = [name.removesuffix(_SUFFIX).lower() for name in names]
    missing = [name for name in short if name not in available]
    if missing or not names:
        raise ProviderUnavailable(
            f"Not available as an execution provider: {', '.join(missing) or '(none named)'};"
            f" available are: {', '.join(available)}. Install the onnxruntime build for that"
            " accelerator, or request one of these."
        )
    return [available[name] for name in short]


@dataclass(frozen=True)
class Tensor:
    """Name and shape of a graph's input or output; a size is ``None`` where any will do."""

    name: str
    shape: tuple[int | None, ...]


class Session:
    """One ONNX graph, loaded once, that any number of threads may run.

    ``model`` is serialised ONNX: what was hashed is what runs. Each of the ``providers``, best
    first, must be in use after loading: nothing falls back silently. ``inputs`` is empty where one
    is not of float32.
    """

    def __init__(
        self,
        model: bytes,
        *,
        name: str,
        providers: Sequence[str] = ("cpu",),
        threads: int | None = None,
    ) -> None:
        if threads is not None and threads < 1:
            raise ModelError(f"The number of inference threads must be at least 1, not {threads}.")
        self.name = name
        self._loaded = _load(model, name, resolve_providers(providers), threads)
        given = self._loaded.get_inputs()
        is_float = all(value.type == "tensor(float)" for value in given)
        self.inputs = tuple(map(_tensor, given)) if is_float else ()
        self.outputs = tuple(map(_tensor, self._loaded.get_outputs()))

    def run(
        self, feeds: Mapping[str, NDArray[np.float32]], outputs: Sequence[str] | None = None
    ) -> list[NDArray[np.float32]]:
        """Run the graph; safe from several threads at once."""
        try:
            results = self._loaded.run(list(outputs) if outputs else None, dict(feeds))
        except Exception as error:
            # Only the kind: onnxruntime may quote values of the input.
            raise ModelError(f"{self.name}: inference failed ({type(error).__name__}).") from None
        return [np.asarray(result) for result in results]


@cache
def _share_arena() -> None:
    """Let the sessions of this process take their memory from one arena instead of one each."""
    memory = ort.OrtMemoryInfo(
        "Cpu", ort.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, ort.OrtMemType.DEFAULT
    )
    defaults = -1
    ort.create_and_register_allocator(memory, ort.OrtArenaCfg(0, defaults, defaults, defaults))


def _load(model: bytes, name: str, providers: list[str], threads: int | None) -> Any:
    options = ort.SessionOptions()
    options.log_severity_level = _LOG_ERRORS_ONLY
    # Memory patterns are kept for every input shape ever seen, and photos have many shapes.
    # One arena for all sessions levels off at the largest canvas and batch, which are bounded
    # (docs/results/photos.md has the measurement).
    options.enable_mem_pattern = False
    _share_arena()
    options.add_session_config_entry("session.use_env_allocators", "1")
    if threads is not None:
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
    # Idle workers sleep: spinning would take the cores from the other sessions of the process.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry(
        "session.model_external_initializers_file_folder_path", _NO_FOLDER
    )
    try:
        session = ort.InferenceSession(model, options, providers=providers, enable_fallback=0)
    # onnxruntime raises a family of unrelated classes here; the cause stays attached.
    except Exception as error:
        raise PackError(
            f"{name} is not a readable ONNX model: fetch the file again, or, where its weights lie"
            f" in another file, convert it to a single one. onnxruntime says: {error}"
        ) from error
    session.disable_fallback()
    # It keeps the bytes for a fallback to another provider, and no session here falls back.
    vars(session).pop("_model_bytes", None)
    running = session.get_providers()
    if missing := set(providers).difference(running):
        raise ProviderUnavailable(
            f"{name}: the execution provider {', '.join(missing)} was requested and did not start;"
            f" running would be {', '.join(running)}. Check its drivers and libraries, or request"
            " another provider."
        )
    return session


def _tensor(value: Any) -> Tensor:
    return Tensor(value.name, tuple(n if isinstance(n, int) else None for n in value.shape))


def default_workers() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
