"""Cues of reconstructions whose errors are drawn: what moves across, what moves along, what nothing is wrong with."""

from __future__ import annotations

import numpy as np
import pytest
from worlds import textured_image

from viflow_anomaly.alignment import align, remaining_evidence
from viflow_anomaly.config import DetectorConfig, ViewConfig
from viflow_anomaly.correction import Correction, RigidMotion
from viflow_anomaly.evidence_cues import (
    GEOMETRIC_CUES,
    HALF_REMAINING_PX,
    PHOTOMETRIC_CUES,
    EvidenceCues,
    evidence_cues,
)
from viflow_anomaly.explanation import explain
from viflow_anomaly.measured_flow import measure_remaining_flow
from viflow_anomaly.model_input import ModelInput
from viflow_anomaly.motion_input import MotionWindow
from viflow_anomaly.prediction import PredictedFlow
from viflow_anomaly.sensor_data import Frame, FramePair, ImuSamples, Uint8Array
from viflow_anomaly.view import make_view

WIDTH, HEIGHT = 192, 128
STRIDE = 4
BOX = (slice(48, 80), slice(72, 120))


def predicted(
    view_size: tuple[int, int], translation: tuple[float, float, float] | None = (0.2, 0.0, 0.0)
) -> PredictedFlow:
    """No flow, by a camera that moved to the left; None: a network that gives flow only."""
    shape = (view_size[1] // STRIDE, view_size[0] // STRIDE)
    flow, ones = np.zeros((*shape, 2), np.float32), np.ones(shape, np.float32)
    correction = None
    if translation is not None:
        motion = RigidMotion(np.eye(3), np.array(translation))
        correction = Correction(flow, motion, 1.0, 0.0, True, ones, np.zeros_like(ones))
    return PredictedFlow(flow, STRIDE, 0, flow, correction, None, flow[None])


def cues_of(source: Uint8Array, rebuilt: Uint8Array, *, translation: tuple[float, float, float] | None) -> EvidenceCues:
    height, width = source.shape
    view = make_view(ViewConfig(), width=width, height=height, camera=None)
    model_input = ModelInput(source, source, MotionWindow(np.zeros((16, 6), np.float32), 0.05, ()), view)
    flows, pair = predicted((view.width, view.height), translation), pair_of(source, rebuilt)
    config = DetectorConfig(photometric_compensation=False)
    alignment = align(pair, model_input, flows, focal_px=116.0)
    explained = explain(pair, model_input, flows, config, coordinates=alignment.target_coordinates)
    return evidence_cues(remaining_evidence(explained, alignment))


def pair_of(source: Uint8Array, target: Uint8Array) -> FramePair:
    stamps = np.arange(0, 60_000_000, 5_000_000, dtype=np.int64)
    imu = ImuSamples(stamps, np.zeros((len(stamps), 3)), None)
    return FramePair(Frame(0, source), Frame(50_000_000, target), imu)


def with_shifted_box(source: Uint8Array, du: int, dv: int) -> Uint8Array:
    """What is in ``BOX`` of the source is found at an offset (du, dv) in the result."""
    rebuilt = source.copy()
    rows, columns = BOX
    rebuilt[rows.start + dv : rows.stop + dv, columns.start + du : columns.stop + du] = source[BOX]
    return rebuilt


def in_box(cues: EvidenceCues, name: str) -> float:
    """The middle of the box, on blocks."""
    return float(np.median(cues.geometric[GEOMETRIC_CUES.index(name), 14:18, 21:27]))


@pytest.fixture(scope="module")
def source() -> Uint8Array:
    return np.asarray(textured_image(WIDTH, HEIGHT, seed=3), np.uint8)


def test_a_perfect_reconstruction_leaves_nothing(source: Uint8Array) -> None:
    cues = cues_of(source, source, translation=(0.2, 0.0, 0.0))
    assert np.abs(cues.photometric[:2]).max() == 0.0
    for name in GEOMETRIC_CUES:
        if "flow" in name or "mismatch" in name:
            assert np.abs(cues.geometric[GEOMETRIC_CUES.index(name)]).max() < 0.02, name


@pytest.mark.parametrize("kind", ["remaining", "local"])
def test_what_moves_across_the_epipolar_line_shows_there(source: Uint8Array, kind: str) -> None:
    cues = cues_of(source, with_shifted_box(source, 0, 3), translation=(0.2, 0.0, 0.0))
    assert in_box(cues, f"{kind} flow across") == pytest.approx(3 / (3 + HALF_REMAINING_PX), abs=0.06)
    assert abs(in_box(cues, f"{kind} flow along")) < 0.3


def test_what_moves_along_the_epipolar_line_shows_as_another_depth(source: Uint8Array) -> None:
    cues = cues_of(source, with_shifted_box(source, 3, 0), translation=(0.2, 0.0, 0.0))
    assert abs(in_box(cues, "remaining flow across")) < 0.3
    parallax = in_box(cues, "parallax")
    parallax_px = 4 * parallax / (1 - parallax)
    ratio = 3 / (parallax_px + 0.25)
    assert in_box(cues, "remaining depth") == pytest.approx(ratio / (ratio + 0.5), abs=0.06)


def test_a_network_without_depth_has_no_parallax(source: Uint8Array) -> None:
    cues = cues_of(source, with_shifted_box(source, 3, 0), translation=None)
    assert np.ptp(cues.geometric[GEOMETRIC_CUES.index("parallax")]) < 1e-6
    assert in_box(cues, "remaining flow along") == pytest.approx(0.75, abs=0.06)  # along is then along x


@pytest.mark.parametrize(("width", "height"), [(192, 128), (75, 101), (33, 64)])
def test_cues_are_bounded_and_padded(width: int, height: int) -> None:
    rng = np.random.default_rng(0)
    source, rebuilt = rng.integers(0, 256, (2, height, width), dtype=np.uint8)
    cues = cues_of(source, rebuilt, translation=(0.1, 0.2, 1.5))
    rows, columns = -(-height // 32) * 32, -(-width // 32) * 32
    assert cues.photometric.shape == (len(PHOTOMETRIC_CUES), rows, columns)
    assert cues.geometric.shape == (len(GEOMETRIC_CUES), rows // 4, columns // 4)
    for values in cues:
        assert values.dtype == np.float32
        assert np.isfinite(values).all()
        assert np.abs(values).max() <= 1.0
    inside = cues.geometric[GEOMETRIC_CUES.index("inside")]
    share = width * height / (rows * columns)
    assert 0.5 * share < inside.mean() <= share * (1 + 1e-5)  # noise may be explained by a motion out of the picture


def test_small_things_show_in_the_local_flow() -> None:
    source = np.asarray(textured_image(WIDTH, HEIGHT, seed=5), np.uint8)
    rebuilt = source.copy()
    rebuilt[60:74, 90:104] = source[60:74, 89:103]  # 14 px wide, moved by one pixel to the right
    remaining = measure_remaining_flow(source, rebuilt, block_px=4)
    local = remaining.local_flow_px[16:18, 23:25, 0].mean()
    assert 0.4 < local < 1.5
    assert abs(remaining.local_flow_px[2:8, 2:8]).max() < 0.1
