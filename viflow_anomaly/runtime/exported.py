"""What an exported file says of itself: the names of its inputs and outputs, and its metadata."""

from __future__ import annotations

from typing import Any

NAME_KEY = "viflow.name"
VERSION_KEY = "viflow.version"
WEIGHTS_KEY = "viflow.weights_sha256"
MODEL_KEY = "viflow.model"
FLOW_STRIDE_KEY = "viflow.flow_stride"
HEAD_KEY = "viflow.evidence_head"
INPUT_NAMES = ("source", "motion", "interval_s", "motor")
"""The last one where the network has a motor stream."""
FLOW_OUTPUTS = ("flow_px",)
HEAD_INPUTS, HEAD_OUTPUTS = ("photometric", "geometric"), ("logits", "offsets")
SCENE_OUTPUTS = ("flow_px", "inverse_depth", "rotation", "translation")


def exported_metadata(model: Any) -> dict[str, str]:
    """The metadata of an ONNX network as OpenVINO read it; empty where there is none."""
    info = model.get_rt_info()
    if "framework" not in info:
        return {}
    return {str(key): str(value.astype(str)) for key, value in info["framework"].items()}
