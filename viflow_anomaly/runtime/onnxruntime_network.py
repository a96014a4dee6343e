"""An exported network in ONNX Runtime, on a CPU or on CUDA; one session takes inputs of any size."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import onnxruntime

from viflow_anomaly.errors import ConfigError
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.runtime.exported import Export, Feed, foreign

_LOG_ERRORS = 3


def require_device(device: str) -> None:
    """Find out whether this ONNX Runtime can compute on ``device``.

    Raises:
        ConfigError: ``device_unavailable``.
    """
    provider = _provider(device)[0]
    if provider not in onnxruntime.get_available_providers():
        raise _unavailable(
            f"expected an ONNX Runtime that can compute on {device!r}, found one with "
            f"{', '.join(onnxruntime.get_available_providers())}: pip install onnxruntime-gpu in place of onnxruntime"
        )


class OnnxruntimeNetwork:
    """A session; ONNX Runtime lets threads share it.

    Args:
        export: of a network.
        device: "cpu", "cuda" or "cuda:N".
        threads: of one prediction.

    Raises:
        CheckpointError: ``checkpoint_corrupt``.
        ConfigError: ``device_unavailable``.
    """

    def __init__(self, export: Export, *, device: str, threads: int) -> None:
        require_device(device)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        # Threads that spin while they wait take the cores from whatever else runs.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.log_severity_level = _LOG_ERRORS
        provider = _provider(device)
        try:
            session = onnxruntime.InferenceSession(export.data, options, providers=[provider])
        except Exception as err:  # its errors have no class in common
            raise foreign(export, str(err)[-200:]) from err
        if session.get_providers()[0] != provider[0]:  # it goes on without a provider that does not start
            raise _unavailable(
                f"expected ONNX Runtime to start on {device!r}, found that {provider[0]} does not (no such device, or "
                "no CUDA and cuDNN of the versions that it was built for)"
            )
        self._session = session
        self._inputs = frozenset(one.name for one in session.get_inputs())
        self._outputs = [one.name for one in session.get_outputs()]

    @property
    def metadata(self) -> Mapping[str, str]:
        """What the file says of itself."""
        return dict(self._session.get_modelmeta().custom_metadata_map)

    def run(self, feed: Feed) -> dict[str, Float32Array]:
        """All outputs by name; inputs that the network ignores were dropped by the export and are left out."""
        given = {name: value for name, value in feed.items() if name in self._inputs}
        return dict(zip(self._outputs, self._session.run(self._outputs, given), strict=True))


def _provider(device: str) -> tuple[str, dict[str, Any]]:
    kind, colon, index = device.partition(":")
    if device == "cpu":
        return "CPUExecutionProvider", {}
    if kind == "cuda" and (index.isdecimal() or not colon):
        return "CUDAExecutionProvider", {"device_id": int(index or 0)}
    raise _unavailable(f"expected 'cpu', 'cuda' or 'cuda:N' for ONNX Runtime, found {device!r}")


def _unavailable(problem: str) -> ConfigError:
    return ConfigError(f"device: {problem}", code="device_unavailable", field="device")
