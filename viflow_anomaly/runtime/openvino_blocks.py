"""The evidence head, fed and read by blocks of 4x4 pixels instead of by pixels.

Its convolutions work on blocks, whose pixels are channels, and OpenVINO computes with the channels innermost. Shuffling
pixels into that order and back inside the graph takes a fifth of the head's time, because it goes element by element
through several layouts. Four neighbouring pixels of a row stay neighbours, so that numpy moves them at once.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from openvino import opset13 as operations

from viflow_anomaly.config import EVIDENCE_BLOCK_PX
from viflow_anomaly.geometry import Float32Array

CUES, LOGITS = "cue_blocks", "logit_blocks"
"""Input [1, h, w, C] and output [1, h, w, 2 * 16] that take the place of the cues and of the logits."""
PIXELS = EVIDENCE_BLOCK_PX**2
QUAD = np.complex128
"""Four float32 as one value that numpy copies: a row of a block."""
QUAD_VALUES = 4
assert EVIDENCE_BLOCK_PX == QUAD_VALUES


def by_blocks(model: Any) -> None:
    """Give a head's model the input ``CUES`` and the output ``LOGITS``; a model of another build stays as it is.

    Channels of ``CUES``: as the head's own concatenation, then zeros up to a multiple of four.
    """
    _take_cue_blocks(model)
    _give_logit_blocks(model)
    model.validate_nodes_and_infer_types()


def _take_cue_blocks(model: Any) -> None:
    pixels, blocks = (model.input(name).get_node() for name in ("photometric", "geometric"))
    cues = _only_consumer(blocks)
    mix = None if cues is None or cues.get_type_name() != "Concat" else _only_consumer(cues)
    if mix is None or mix.get_type_name() != "Convolution":
        return
    constant = mix.input_value(1).get_node()
    if constant.get_type_name() != "Constant":
        return
    weights = constant.get_data()
    missing = -weights.shape[1] % QUAD_VALUES
    padded = np.pad(weights, ((0, 0), (0, missing), (0, 0), (0, 0)))
    parameter = operations.parameter([1, -1, -1, padded.shape[1]], np.float32, name=CUES)
    parameter.output(0).set_names({CUES})
    mix.input(0).replace_source_output(operations.transpose(parameter, [0, 3, 1, 2]).output(0))
    mix.input(1).replace_source_output(operations.constant(padded).output(0))
    model.add_parameters([parameter])
    for unused in (pixels, blocks):
        model.remove_parameter(unused)


def _give_logit_blocks(model: Any) -> None:
    port = model.output("logits")
    shuffled = port.get_node().input_value(0).get_node()
    if shuffled.get_type_name() != "DepthToSpace" or shuffled.get_attributes()["mode"] != "depth_first":
        return
    logits = operations.transpose(shuffled.input_value(0), [0, 2, 3, 1])
    logits.output(0).set_names({LOGITS})
    model.add_results([operations.result(logits)])
    model.remove_result(port.get_node())


def _only_consumer(node: Any) -> Any:
    consumers = list(node.output(0).get_target_inputs())
    return consumers[0].get_node() if len(consumers) == 1 else None


def write_cue_blocks(photometric: Float32Array, geometric: Float32Array, out: Float32Array) -> None:
    """Cues [P, H, W] and [G, H / 4, W / 4] into [H / 4, W / 4, C]; channels beyond theirs stay as they are."""
    count, (rows, columns, _) = len(photometric), out.shape
    pixels = np.ascontiguousarray(photometric).view(QUAD).reshape(count, rows, EVIDENCE_BLOCK_PX, columns)
    quads = out.view(QUAD)
    for cue, its_pixels in enumerate(pixels.transpose(0, 2, 3, 1)):  # 4, columns, rows
        first = cue * EVIDENCE_BLOCK_PX
        np.copyto(quads[..., first : first + EVIDENCE_BLOCK_PX].transpose(2, 1, 0), its_pixels)
    out[..., count * PIXELS : count * PIXELS + len(geometric)] = geometric.transpose(1, 2, 0)


def read_logit_blocks(blocks: Float32Array) -> Float32Array:
    """Logits [H / 4, W / 4, 2 * 16] -> [2, H, W]."""
    rows, columns, channels = blocks.shape
    count = channels // PIXELS
    logits = np.empty((count, rows * EVIDENCE_BLOCK_PX, columns * EVIDENCE_BLOCK_PX), dtype=np.float32)
    quads = blocks.view(QUAD).reshape(rows, columns, count, EVIDENCE_BLOCK_PX)
    pixels = logits.view(QUAD).reshape(count, rows, EVIDENCE_BLOCK_PX, columns)
    np.copyto(pixels, quads.transpose(2, 0, 3, 1))
    return logits
