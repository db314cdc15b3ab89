"""onnxruntime sessions that run where they were told to run, in bounded memory."""

import os
import threading
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from models.errors import ModelError, PackError, ProviderUnavailable

PROVIDERS = {
    "cpu": "CPUExecutionProvider",
    "cuda": "CUDAExecutionProvider",
    "tensorrt": "TensorrtExecutionProvider",
    "rocm": "ROCMExecutionProvider",
    "migraphx": "MIGraphXExecutionProvider",
    "openvino": "OpenVINOExecutionProvider",
    "directml": "DmlExecutionProvider",
    "coreml": "CoreMLExecutionProvider",
    "xnnpack": "XnnpackExecutionProvider",
}
_SHORT = {full: short for short, full in PROVIDERS.items()}

Optimisation = Literal["all", "extended"]
_LEVELS = {
    "all": ort.GraphOptimizationLevel.ORT_ENABLE_ALL,
    "extended": ort.GraphOptimizationLevel.ORT_ENABLE_EXTENDED,
}

# onnxruntime writes warnings about declared output shapes to stderr for every detector that runs
# at another size than it was exported for; errors still reach us as exceptions.
_LOG_ERRORS_ONLY = 3


def available_providers() -> list[str]:
    """Short names of the execution providers of the installed onnxruntime."""
    return [_SHORT.get(name, name) for name in ort.get_available_providers()]


def resolve_providers(names: Sequence[str]) -> list[str]:
    """Full onnxruntime names for the requested providers, in the requested order.

    Raises
    ------
    ProviderUnavailable
        If a name is unknown, or its provider is not in the installed onnxruntime.
    """
    if not names:
        raise ProviderUnavailable(
            f"No execution provider was named; available are: {', '.join(available_providers())}."
        )
    installed = ort.get_available_providers()
    resolved = []
    for name in names:
        full = PROVIDERS.get(name.lower(), name)
        if full not in installed:
            raise ProviderUnavailable(
                f"The execution provider '{name}' was requested and is not available; available"
                f" are: {', '.join(available_providers())}. Install the onnxruntime build for"
                " that accelerator, or request one of these."
            )
        resolved.append(full)
    return resolved


class Session:
    """One ONNX graph, loaded once, that any number of threads may run.

    Parameters
    ----------
    model
        Serialised ONNX bytes. They are what was hashed, so the hash is of what runs.
    name
        File name for error messages.
    providers
        Short (``cpu``, ``cuda``) or full onnxruntime names, best first. Each must be present and
        be in use after loading; nothing falls back silently.
    threads
        Threads inside one operator; ``None`` leaves the choice to onnxruntime (all cores).
    optimisation
        What onnxruntime may change in the graph: ``all``, its default, or ``extended``, which
        leaves the layout of the tensors as it is. All else runs with ``all``.
    """

    def __init__(
        self,
        model: bytes,
        *,
        name: str,
        providers: Sequence[str] = ("cpu",),
        threads: int | None = None,
        optimisation: Optimisation = "all",
    ) -> None:
        if threads is not None and threads < 1:
            raise ModelError(f"The number of inference threads must be at least 1, not {threads}.")
        self.name = name
        self.providers = resolve_providers(providers)
        self.threads = threads
        self.optimisation = optimisation
        self._model: bytes | None = model
        self._loaded: Any = None
        self._loading = threading.Lock()

    def load(self) -> None:
        """Build the onnxruntime session now rather than at the first run.

        Raises
        ------
        PackError
            If onnxruntime refuses the graph.
        ProviderUnavailable
            If a requested provider failed to start.
        """
        with self._loading:
            if self._loaded is None:
                self._loaded = self._create()
                self._model = None

    def _create(self) -> Any:
        options = ort.SessionOptions()
        options.log_severity_level = _LOG_ERRORS_ONLY
        # Memory patterns are kept for every input shape ever seen, and photos have many shapes.
        # The arena stays: it levels off at the largest canvas and batch, which are bounded
        # (docs/models.md has the measurement).
        options.enable_mem_pattern = False
        options.enable_cpu_mem_arena = True
        options.graph_optimization_level = _LEVELS[self.optimisation]
        if self.threads is not None:
            options.intra_op_num_threads = self.threads
            options.inter_op_num_threads = 1
        # Idle workers sleep: spinning would take the cores from the other sessions of the process.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        try:
            session = ort.InferenceSession(
                self._model, options, providers=self.providers, enable_fallback=0
            )
        # onnxruntime raises a family of unrelated classes here; the cause stays attached.
        except Exception as error:
            raise PackError(f"{self.name}: onnxruntime cannot load this graph: {error}") from error
        session.disable_fallback()
        running = session.get_providers()
        missing = [name for name in self.providers if name not in running]
        if missing:
            raise ProviderUnavailable(
                f"{self.name}: the execution provider {', '.join(missing)} was requested and did"
                f" not start; running would be {', '.join(running)}. Check its drivers and"
                " libraries, or request another provider."
            )
        return session

    def run(
        self, feeds: Mapping[str, NDArray[np.float32]], outputs: Sequence[str] | None = None
    ) -> list[NDArray[np.float32]]:
        """Run the graph; safe from several threads at once.

        Parameters
        ----------
        outputs
            Names of the wanted outputs, in order; all where absent.

        Raises
        ------
        ModelError
            If onnxruntime fails on these inputs.
        """
        if self._loaded is None:
            self.load()
        try:
            results = self._loaded.run(list(outputs) if outputs else None, dict(feeds))
        except Exception as error:
            # Only the kind: onnxruntime may quote values of the input.
            raise ModelError(f"{self.name}: inference failed ({type(error).__name__}).") from None
        return [np.asarray(result) for result in results]


def default_workers() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
