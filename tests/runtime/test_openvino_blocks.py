"""The head by blocks: the same numbers as by pixels, and a network of another build is left alone."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F  # noqa: N812  # torch's own convention

pytest.importorskip("openvino", reason="the extra 'openvino' is not installed")

import openvino
from openvino import opset13 as operations

from viflow_anomaly.checkpoint_record import bundled_evidence_head
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.runtime.openvino_blocks import (
    CUES,
    LOGITS,
    by_blocks,
    read_logit_blocks,
    write_cue_blocks,
)

HEIGHT, WIDTH = 64, 96
ROWS, COLUMNS = HEIGHT // 4, WIDTH // 4


def noise(*shape: int) -> Float32Array:
    return np.random.default_rng(len(shape)).uniform(-1, 1, shape).astype(np.float32)


@pytest.mark.parametrize("geometric", [1, 12, 13])
def test_cue_blocks_are_what_the_head_concatenates(geometric: int) -> None:
    photometric, blocks = noise(3, HEIGHT, WIDTH), noise(geometric, ROWS, COLUMNS)
    channels = 48 + geometric
    out = np.full((ROWS, COLUMNS, -(-channels // 4) * 4), 7, dtype=np.float32)
    write_cue_blocks(photometric, blocks, out)
    shuffled = F.pixel_unshuffle(torch.from_numpy(photometric), 4).numpy()
    np.testing.assert_array_equal(out[..., :channels].transpose(2, 0, 1), np.concatenate([shuffled, blocks]))
    assert (out[..., channels:] == 7).all()


def test_logit_blocks_are_shuffled_as_the_head_does() -> None:
    blocks = noise(ROWS, COLUMNS, 32)
    pixels = F.pixel_shuffle(torch.from_numpy(blocks.transpose(2, 0, 1).copy()), 4).numpy()
    np.testing.assert_array_equal(read_logit_blocks(blocks), pixels)


def answer(model: Any, cues: dict[str, Float32Array], output: str) -> Float32Array:
    compiled = openvino.Core().compile_model(model, "CPU", {"INFERENCE_PRECISION_HINT": "f32"})
    return np.asarray(compiled({name: values[None] for name, values in cues.items()})[output][0])


def bundled() -> Any:
    return openvino.Core().read_model(bundled_evidence_head().with_suffix(".onnx"))


def test_the_bundled_head_by_blocks_says_the_same() -> None:
    plain, blocks = bundled(), bundled()
    by_blocks(blocks)
    assert {port.get_any_name() for port in blocks.inputs} == {CUES}
    assert LOGITS in {port.get_any_name() for port in blocks.outputs}
    channels = blocks.input(CUES).partial_shape[3].get_length()
    geometric = plain.input("geometric").partial_shape[1].get_length()
    cues = {"photometric": noise(3, HEIGHT, WIDTH), "geometric": noise(geometric, ROWS, COLUMNS)}
    written = np.zeros((ROWS, COLUMNS, channels), dtype=np.float32)
    write_cue_blocks(cues["photometric"], cues["geometric"], written)
    by_pixels = answer(plain, cues, "logits")
    np.testing.assert_allclose(read_logit_blocks(answer(blocks, {CUES: written}, LOGITS)), by_pixels, atol=1e-4)
    offsets = (answer(plain, cues, "offsets"), answer(blocks, {CUES: written}, "offsets"))
    np.testing.assert_allclose(*offsets, atol=1e-4)
    assert np.abs(by_pixels).max() > 1


def test_channels_are_padded_with_weights_of_zero() -> None:
    model = drawn_head(geometric=13)
    by_blocks(model)
    assert model.input(CUES).partial_shape[3].get_length() == 64
    cues = {"photometric": noise(3, HEIGHT, WIDTH), "geometric": noise(13, ROWS, COLUMNS)}
    written = np.full((ROWS, COLUMNS, 64), 1e3, dtype=np.float32)
    write_cue_blocks(cues["photometric"], cues["geometric"], written)
    plain = answer(drawn_head(geometric=13), cues, "logits")
    np.testing.assert_allclose(read_logit_blocks(answer(model, {CUES: written}, LOGITS)), plain, atol=1e-4)


def test_a_head_of_another_build_stays_as_it_is() -> None:
    model = drawn_head(geometric=12, scaled=True)
    by_blocks(model)
    assert {port.get_any_name() for port in model.inputs} == {"photometric", "geometric"}
    assert "logits" in {port.get_any_name() for port in model.outputs}


def drawn_head(*, geometric: int, scaled: bool = False) -> Any:
    """One convolution between unshuffling and shuffling; ``scaled``: something stands before and behind it."""
    names = {"photometric": 3, "geometric": geometric}
    pixels, blocks = (operations.parameter([1, count, -1, -1], np.float32, name=name) for name, count in names.items())
    for parameter in (pixels, blocks):
        parameter.output(0).set_names({parameter.get_friendly_name()})
    cues = operations.concat([operations.space_to_depth(pixels, "depth_first", 4), blocks], 1)
    two = operations.constant(np.float32(2))
    seen = operations.multiply(cues, two) if scaled else cues
    mix = operations.convolution(seen, noise(32, 48 + geometric, 1, 1), [1, 1], [0, 0], [0, 0], [1, 1])
    logits = operations.depth_to_space(mix, "depth_first", 4)
    told = operations.multiply(logits, two) if scaled else logits
    told.output(0).set_names({"logits"})
    return openvino.Model([operations.result(told)], [pixels, blocks], "drawn")
