from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from constant_flow import ConstantFlow
from simulated_truth import add_ground_truth
from torch import nn
from worlds import make_world, write_euroc

from viflow_anomaly.config import CorrectionConfig, ModelConfig, MotionWindowConfig, ViewConfig
from viflow_anomaly.datasets.registry import open_recording
from viflow_anomaly.errors import DatasetError
from viflow_anomaly.evaluation.endpoint_error import (
    EndpointErrors,
    PairError,
    measure_endpoint_errors,
    require_ground_truth,
)
from viflow_anomaly.runtime.torch_runtime import TorchRuntime

CONFIG = ModelConfig(hypotheses=4, motion_window=MotionWindowConfig(samples_before=2, samples_between=4))
FOCAL_PX = 80.0  # of the world's camera


def measured(
    network: nn.Module, config: ModelConfig, recordings: list[Path], *, corrected: bool = False, **more: Any
) -> EndpointErrors:
    correction = CorrectionConfig(enabled=corrected)
    return measure_endpoint_errors(TorchRuntime(network), config, recordings, correction=correction, **more)


def config_of(focal_px: float) -> ModelConfig:
    return CONFIG.model_copy(update={"view": ViewConfig(focal_px=focal_px)})


def summary(epe_px: Any, identity_px: float, ratio: float) -> dict[str, Any]:
    """Without correction what is used is what was predicted."""
    return {
        "epe_px": epe_px,
        "predicted_epe_px": epe_px,
        "identity_epe_px": identity_px,
        "epe_ratio": ratio,
        "predicted_epe_ratio": ratio,
    }


@pytest.fixture
def drone(tmp_path: Path) -> Path:
    return add_ground_truth(tmp_path / "drone_000001", make_world(frames=4))


@pytest.mark.parametrize("focal_px", [40.0, 80.0, 120.0])
@pytest.mark.parametrize("stride", [1, 4])
def test_the_true_flow_has_no_error_at_any_scale_of_the_view(drone: Path, focal_px: float, stride: int) -> None:
    true_px = -2.0 * focal_px / FOCAL_PX
    network = ConstantFlow((true_px, 0.0), (5.0, 5.0), (0.0, 0.0), (-true_px, 0.0), stride=stride)
    errors = measured(network, config_of(focal_px), [drone])
    assert len(errors.pairs) == 3
    for pair in errors.pairs:
        assert pair.epe_px == pytest.approx(0.0, abs=1e-4)
        assert pair.identity_epe_px == 2.0
        assert pair.hypothesis == 0
    assert errors.summary() == summary(pytest.approx(0.0, abs=1e-4), 2.0, 0.0)


def test_no_motion_has_the_identity_error(drone: Path) -> None:
    errors = measured(ConstantFlow((0.0, 0.0)), config_of(FOCAL_PX), [drone])
    assert errors.summary() == summary(2.0, 2.0, 1.0)


def test_the_error_is_a_distance(drone: Path) -> None:
    errors = measured(ConstantFlow((1.0, 4.0)), config_of(FOCAL_PX), [drone])
    assert errors.summary() == summary(5.0, 2.0, 2.5)


def test_the_hypothesis_is_chosen_without_ground_truth(tmp_path: Path) -> None:
    """The picture moves 2 px; a ground truth that says otherwise does not change the choice."""
    folder = add_ground_truth(tmp_path / "drone_1", shift_px=6.0)
    network = ConstantFlow((-6.0, 0.0), (-2.0, 0.0))
    errors = measured(network, config_of(FOCAL_PX), [folder])
    assert [pair.hypothesis for pair in errors.pairs] == [1, 1]
    assert errors.summary()["epe_px"] == 4.0


def test_the_correction_finds_a_flow_between_the_hypotheses(drone: Path) -> None:
    """The picture moves by -2 px; the hypotheses say -3 and +1."""
    errors = measured(ConstantFlow((-3.0, 0.0), (1.0, 0.0)), config_of(FOCAL_PX), [drone], corrected=True)
    for pair in errors.pairs:
        assert pair.predicted_epe_px == pytest.approx(1.0, abs=1e-3)
        assert pair.epe_px < 0.3


def test_only_pixels_with_ground_truth_count(tmp_path: Path) -> None:
    valid = np.zeros((64, 96), np.bool_)
    valid[:, :10] = True
    folder = add_ground_truth(tmp_path / "drone_1", valid=valid)
    errors = measured(ConstantFlow((-2.0, 1.0)), config_of(FOCAL_PX), [folder])
    assert errors.summary() == summary(1.0, 2.0, 0.5)


@pytest.mark.parametrize(
    ("wanted", "found"), [(1, [0]), (2, [0, 2]), (3, [0, 1, 2]), (9, [0, 1, 2]), (None, [0, 1, 2])]
)
def test_pairs_are_spread_evenly(drone: Path, wanted: int | None, found: list[int]) -> None:
    steps: list[tuple[int, int]] = []
    errors = measured(
        ConstantFlow((0.0, 0.0)),
        config_of(FOCAL_PX),
        [drone],
        max_pairs=wanted,
        on_progress=lambda done, total: steps.append((done, total)),
    )
    stamps = open_recording(drone).frame_timestamps_ns.tolist()
    assert [stamps.index(pair.source_timestamp_ns) for pair in errors.pairs] == found
    assert steps == [(done, len(found)) for done in range(1, len(found) + 1)]


def test_errors_by_sequence_and_group() -> None:
    def pair(sequence: str, epe_px: float) -> PairError:
        return PairError(sequence, 0, epe_px, 2 * epe_px, 4.0, 0)

    errors = EndpointErrors((pair("drone_2", 1), pair("car_1", 2), pair("drone_1", 3), pair("plain", 4)))
    assert {name: some.summary()["epe_px"] for name, some in errors.per_sequence().items()} == {
        "car_1": 2,
        "drone_1": 3,
        "drone_2": 1,
        "plain": 4,
    }
    assert {name: some.summary()["epe_ratio"] for name, some in errors.per_group().items()} == {
        "car": 0.5,
        "drone": 0.5,
        "plain": 1.0,
    }
    assert list(errors.per_group()) == ["car", "drone", "plain"]


def test_a_world_that_stands_still_has_no_ratio() -> None:
    summary = EndpointErrors((PairError("a", 0, 1.0, 1.0, 0.0, 0),)).summary()
    assert np.isnan(summary["epe_ratio"])


# --- refusals


def refusal(folder: Path, *, at_once: bool) -> DatasetError:
    def measure(folders: list[Path]) -> None:
        measured(ConstantFlow((0.0, 0.0)), config_of(FOCAL_PX), folders)

    def require_at_once(folders: list[Path]) -> None:
        require_ground_truth(folders, config_of(FOCAL_PX))

    with pytest.raises(DatasetError, match=folder.name) as raised:
        (require_at_once if at_once else measure)([folder])
    return raised.value


@pytest.mark.parametrize("at_once", [True, False])
def test_a_recording_without_ground_truth(tmp_path: Path, at_once: bool) -> None:
    error = refusal(write_euroc(tmp_path / "V1_01"), at_once=at_once)
    assert (error.code, error.field) == ("ground_truth_missing", "validation")
    assert "found none" in error.message


@pytest.mark.parametrize("at_once", [True, False])
def test_a_recording_of_one_frame(tmp_path: Path, at_once: bool) -> None:
    error = refusal(add_ground_truth(tmp_path / "drone_1", make_world(frames=1)), at_once=at_once)
    assert error.code == "ground_truth_missing"
    assert "found 1 frame" in error.message


@pytest.mark.parametrize("at_once", [True, False])
def test_ground_truth_that_is_broken(drone: Path, at_once: bool) -> None:
    stamp = int(open_recording(drone).frame_timestamps_ns[0])
    (drone / "mav0/groundtruth0/static_flow" / f"{stamp}.png").write_bytes(b"no picture")
    assert refusal(drone, at_once=at_once).code == "ground_truth_malformed"


def test_ground_truth_without_a_valid_pixel(tmp_path: Path) -> None:
    folder = add_ground_truth(tmp_path / "drone_1", valid=np.zeros((64, 96), np.bool_))
    error = refusal(folder, at_once=False)
    assert (error.code, error.field) == ("ground_truth_missing", "validation")


def test_ground_truth_that_is_there(drone: Path) -> None:
    require_ground_truth([], ModelConfig())
    require_ground_truth([drone, drone / "mav0"], ModelConfig())
