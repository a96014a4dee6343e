"""OpenVINO on a CPU: the exported evidence head."""

from __future__ import annotations

import numpy as np

from viflow_anomaly.checkpoint_record import EvidenceRecord
from viflow_anomaly.config import EVIDENCE_BLOCK_PX, Precision
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.pair_detector import Backend
from viflow_anomaly.runtime.exported import Export, require_head
from viflow_anomaly.runtime.interface import HeadAnswer
from viflow_anomaly.runtime.openvino_blocks import (
    CUES,
    LOGITS,
    PIXELS,
    QUAD_VALUES,
    by_blocks,
    read_logit_blocks,
    write_cue_blocks,
)
from viflow_anomaly.runtime.openvino_network import OpenvinoNetwork, Size


class OpenvinoEvidence:
    """Runs an export of the head; arguments and errors as ``OpenvinoNetwork``, and as ``require_head``."""

    def __init__(
        self, export: Export, record: EvidenceRecord, *, threads: int = 1, precision: Precision = "auto"
    ) -> None:
        counts = (len(record.photometric_cues), len(record.geometric_cues))

        def shapes(size: Size) -> dict[str, list[int]]:
            blocks = [side // EVIDENCE_BLOCK_PX for side in size]
            cues = {"photometric": [1, counts[0], *size], "geometric": [1, counts[1], *blocks]}
            return {**cues, CUES: [1, *blocks, -(-(counts[0] * PIXELS + counts[1]) // QUAD_VALUES) * QUAD_VALUES]}

        self._network = OpenvinoNetwork(export, shapes=shapes, adapt=by_blocks, threads=threads, precision=precision)
        require_head(export, self._network.metadata, record)
        self.backend = Backend("openvino", "cpu", self._network.precision)

    def judge(self, photometric: Float32Array, geometric: Float32Array) -> HeadAnswer:
        height, width = photometric.shape[1:]
        request, inputs, outputs = self._network.request((height, width))
        if CUES in inputs:
            write_cue_blocks(photometric, geometric, inputs[CUES][0])
        else:
            np.copyto(inputs["photometric"][0], photometric)
            np.copyto(inputs["geometric"][0], geometric)
        request.infer()
        logits = read_logit_blocks(outputs[LOGITS][0]) if LOGITS in outputs else np.array(outputs["logits"][0])
        return HeadAnswer(np.asarray(logits, dtype=np.float32), np.array(outputs["offsets"][0], dtype=np.float32))
