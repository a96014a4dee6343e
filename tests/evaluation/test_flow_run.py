"""A whole measurement on drawn worlds, with methods whose errors are known."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import pytest
from constant_flow import ConstantFlow
from simulated_truth import add_ground_truth
from worlds import make_world, textured_image, write_euroc

from viflow_anomaly.checkpoint_record import CheckpointRecord
from viflow_anomaly.config import CorrectionConfig, ModelConfig, MotionWindowConfig, MotorSource, ViewConfig
from viflow_anomaly.errors import ConfigError, DatasetError, InvalidInputError, MissingDependencyError
from viflow_anomaly.evaluation.flow_baselines import BASELINES, choose_baselines
from viflow_anomaly.evaluation.flow_methods import MethodAbout, NoEstimateError, network_methods
from viflow_anomaly.evaluation.flow_run import measure_flow_methods
from viflow_anomaly.evaluation.flow_truth import PairName, RecordingTruth, TrueFlow
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.runtime.torch_runtime import TorchRuntime
from viflow_anomaly.sensor_data import Frame, FramePair, ImuSamples

IMU = ImuSamples(np.arange(0, 100_000_001, 5_000_000), np.zeros((21, 3)), np.zeros((21, 3)))


@dataclass
class Fixed:
    """The same flow for every pixel, NaN left of ``known_from``; nothing for pairs of ``silent``."""

    name: str
    flow_px: tuple[float, float]
    known_from: int = 0
    silent: str | None = None
    motor_source: MotorSource | None = None
    timed: bool = True
    calls: list[PairName] = field(default_factory=list)

    @property
    def about(self) -> MethodAbout:
        return MethodAbout(self.name, "baseline")

    def flow(self, pair: FramePair, name: PairName) -> Float32Array:
        self.calls.append(name)
        if name.sequence == self.silent:
            raise NoEstimateError("asleep")
        flow = np.full((*pair.source.image.shape, 2), self.flow_px, np.float32)
        flow[:, : self.known_from] = np.nan
        return flow


@pytest.fixture
def truths(tmp_path: Path) -> list[RecordingTruth]:
    frames = {"drone_1": 3, "drone_2": 2, "car_1": 2}
    return [
        RecordingTruth(add_ground_truth(tmp_path / name, make_world(frames=count))) for name, count in frames.items()
    ]


def test_by_sequence_by_group_and_in_total(truths: list[RecordingTruth]) -> None:
    steps: list[tuple[int, int]] = []
    method = Fixed("off by one", (-2.0, 1.0))
    run = measure_flow_methods([method], truths, on_progress=lambda done, total: steps.append((done, total)))
    pairs = {name: some["off by one"].pairs for name, some in run.sequences.items()}
    assert pairs == {"drone_1": 2, "drone_2": 1, "car_1": 1}
    assert {name: some["off by one"].pairs for name, some in run.groups().items()} == {"car": 1, "drone": 3}
    total = run.total()["off by one"].summary()
    assert (total["pairs"], total["pixels"], total["epe_mean_px"], total["identity_epe_px"]) == (
        4,
        4 * 64 * 96,
        1.0,
        2.0,
    )
    assert steps == [(1, 4), (2, 4), (3, 4), (4, 4)]


def test_the_first_call_warms_up_and_each_pair_is_repeated(truths: list[RecordingTruth]) -> None:
    timed, untimed = Fixed("timed", (0.0, 0.0)), Fixed("read", (0.0, 0.0), timed=False)
    run = measure_flow_methods([timed, untimed], truths, repeats=2)
    assert (len(timed.calls), len(untimed.calls)) == (1 + 4 * 2, 4)
    assert len(run.total()["timed"].runtimes_ms) == 8
    assert run.total()["read"].summary()["runtime_ms"] is None


def test_a_sparse_method_is_measured_at_its_own_points(truths: list[RecordingTruth]) -> None:
    run = measure_flow_methods([Fixed("right half", (-2.0, 3.0), known_from=48)], truths)
    found = run.total()["right half"].summary()
    assert (found["density"], found["epe_mean_px"]) == (0.5, 3.0)


def test_missing_pairs_are_counted(truths: list[RecordingTruth]) -> None:
    run = measure_flow_methods([Fixed("moody", (0.0, 0.0), silent="drone_1"), Fixed("steady", (0.0, 0.0))], truths)
    assert run.total()["moody"].summary()["missing_pairs"] == {"asleep": 2}
    assert (run.total()["moody"].pairs, run.total()["steady"].pairs) == (2, 4)
    with pytest.raises(DatasetError, match=r"moody: .*asleep") as raised:
        measure_flow_methods([Fixed("moody", (0.0, 0.0), silent="drone_1")], truths[:1])
    assert raised.value.code == "no_estimate"


def test_only_the_middle_is_measured_when_asked(truths: list[RecordingTruth]) -> None:
    run = measure_flow_methods([Fixed("left unknown", (0.0, 0.0), known_from=44)], truths, crop_px=16)
    statistics = run.total()["left unknown"]
    assert (statistics.valid_px, statistics.estimated_px) == (4 * 16 * 16, 4 * 16 * 12)
    larger = measure_flow_methods([Fixed("all", (0.0, 0.0))], truths[:1], crop_px=1000)
    assert larger.total()["all"].valid_px == 2 * 64 * 96


def test_max_pairs_are_spread(truths: list[RecordingTruth]) -> None:
    method = Fixed("any", (0.0, 0.0), timed=False)
    measure_flow_methods([method], truths, max_pairs=2)
    assert [name.sequence for name in method.calls] == ["drone_1", "car_1"]


class Broken(RecordingTruth):
    """Its first pair has no usable IMU, its second no valid pixel, its third no ground truth."""

    def pair(self, index: int, motor_source: MotorSource | None = None) -> FramePair:
        if index == 0:
            raise InvalidInputError("no samples", code="imu_empty")
        return super().pair(index, motor_source)

    def truth(self, index: int) -> TrueFlow:
        if index == 2:
            raise DatasetError("no file", code="ground_truth_missing")
        true = super().truth(index)
        return TrueFlow(true.flow_px, true.valid & (index != 1))


def test_pairs_that_cannot_be_used_are_left_out_for_all(tmp_path: Path) -> None:
    folder = add_ground_truth(tmp_path / "drone_1", make_world(frames=5))
    run = measure_flow_methods([Fixed("any", (0.0, 0.0))], [Broken(folder)])
    assert run.skipped == {"imu_empty": 1, "no_valid_ground_truth": 1, "ground_truth_missing": 1}
    assert run.total()["any"].pairs == 1
    with pytest.raises(DatasetError, match="imu_empty") as raised:
        measure_flow_methods([Fixed("any", (0.0, 0.0))], [Broken(folder)], max_pairs=1)
    assert raised.value.code == "ground_truth_missing"


def test_malformed_ground_truth_ends_the_run(tmp_path: Path) -> None:
    truth = RecordingTruth(add_ground_truth(tmp_path / "drone_1"))
    stamp = truth.name(1).source_timestamp_ns
    (truth.ground_truth.folder / "static_flow" / f"{stamp}.png").write_bytes(b"no picture")
    with pytest.raises(DatasetError, match=f"{stamp}") as raised:
        measure_flow_methods([Fixed("any", (0.0, 0.0))], [truth])
    assert raised.value.code == "ground_truth_malformed"


def test_ground_truth_of_another_size(tmp_path: Path) -> None:
    whole = add_ground_truth(tmp_path / "drone_1")
    bare = write_euroc(tmp_path / "V1_01", make_world(frames=3, width=64, height=32))
    with pytest.raises(DatasetError, match="V1_01") as raised:
        measure_flow_methods([Fixed("any", (0.0, 0.0))], [RecordingTruth(bare, ground_truth=whole)])
    assert raised.value.code == "ground_truth_malformed"


# --- networks


def record(view: ViewConfig) -> CheckpointRecord:
    window = MotionWindowConfig(samples_before=2, samples_between=4)
    model = ModelConfig(hypotheses=4, view=view, motion_window=window)
    return CheckpointRecord(name="n", version="1", sha256="0" * 64, model=model)


def test_a_network_is_measured_as_predicted_and_corrected(truths: list[RecordingTruth]) -> None:
    """The picture moves by -2 px; the hypotheses say -3 and +1."""
    runtime = TorchRuntime(ConstantFlow((-3.0, 0.0), (1.0, 0.0)))
    methods = network_methods("net", runtime, record(ViewConfig(focal_px=80.0)), CorrectionConfig())
    assert [method.about.series for method in methods] == ["calibrated imu", "calibrated imu+correction"]
    found = measure_flow_methods(methods, truths).total()
    assert found["net"].summary()["epe_mean_px"] == pytest.approx(1.0, abs=1e-3)
    assert found["net+correction"].summary()["epe_mean_px"] < 0.3
    alone = network_methods("net", runtime, record(ViewConfig()), CorrectionConfig(enabled=False))
    assert [method.about.name for method in alone] == ["net"]


def test_outside_its_view_a_network_has_no_estimate(truths: list[RecordingTruth]) -> None:
    runtime = TorchRuntime(ConstantFlow((-2.0, 0.0)))
    crop = record(ViewConfig(mode="center_crop", crop_size=32))
    found = measure_flow_methods(network_methods("crop", runtime, crop, CorrectionConfig(enabled=False)), truths)
    statistics = found.total()["crop"]
    assert statistics.estimated_px == 4 * 32 * 32
    assert statistics.summary()["epe_mean_px"] == pytest.approx(0.0, abs=1e-3)


def test_a_network_that_refuses_a_pair_misses_it(truths: list[RecordingTruth]) -> None:
    large = record(ViewConfig(mode="center_crop", crop_size=128))
    methods = network_methods("large", TorchRuntime(ConstantFlow((0.0, 0.0))), large, CorrectionConfig(enabled=False))
    with pytest.raises(DatasetError, match="image_smaller_than_crop"):
        measure_flow_methods(methods, truths)


# --- baselines


def panned() -> FramePair:
    """The camera pans by 3 px."""
    texture = textured_image(165, 120, seed=3)
    images = [np.ascontiguousarray(texture[:, start : start + 160]) for start in (0, 3)]
    return FramePair(Frame(20_000_000, images[0]), Frame(70_000_000, images[1]), IMU, None)


AVAILABLE = [method for method in choose_baselines().methods if method.about.name != "identity"]


@pytest.mark.parametrize("method", AVAILABLE, ids=lambda method: method.about.name)
def test_a_baseline_finds_a_pan(method: object) -> None:
    flow = method.flow(panned(), PairName("a", 1, 20_000_000, 70_000_000))  # type: ignore[attr-defined]
    assert (flow.shape, flow.dtype) == ((120, 160, 2), np.float32)
    np.testing.assert_allclose(np.nanmedian(flow, axis=(0, 1)), (-3.0, 0.0), atol=0.3)


def test_identity_is_no_motion_and_not_timed() -> None:
    (identity,) = choose_baselines(["identity"]).methods
    assert not identity.timed
    assert not identity.flow(panned(), PairName("a", 1, 0, 1)).any()


def test_what_the_build_lacks_is_left_out_by_default_only(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2, "optflow", object(), raising=False)
    chosen = choose_baselines()
    assert chosen.left_out == ["rlof-epic", "deepflow", "pcaflow", "simpleflow", "tv-l1"]
    assert [method.about.name for method in chosen.methods] + chosen.left_out == list(BASELINES)
    with pytest.raises(MissingDependencyError, match="opencv-contrib") as raised:
        choose_baselines(["identity", "deepflow"])
    assert raised.value.code == "method_unavailable"


def test_unknown_baselines() -> None:
    with pytest.raises(ConfigError, match="'flownet'") as raised:
        choose_baselines(["identity", "flownet"])
    assert raised.value.code == "method_unknown"
