"""What is measured: this package's detector in its variants, and what else a user could run. All do the whole job of a
pair that is decoded already; flow methods stop at the flow, which is why they are the yardstick and no rival.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple, get_args

import cv2

from viflow_anomaly.checkpoint_record import CheckpointRecord
from viflow_anomaly.config import DetectorConfig, ModelConfig, RegionConfig, RuntimeName, ViewConfig
from viflow_anomaly.detection import ImageSize, rois_from_regions
from viflow_anomaly.detector import AnomalyDetector
from viflow_anomaly.evaluation.flow_baselines import farneback
from viflow_anomaly.evaluation.rivals import homography_difference
from viflow_anomaly.regions import find_regions
from viflow_anomaly.sensor_data import FramePair

RUNTIMES: tuple[RuntimeName, ...] = tuple(name for name in get_args(RuntimeName) if name != "auto")
PRESETS = ("bundled", "compact", "paper")
EVIDENCE = ("auto", "residual")
YARDSTICK = "DIS medium"
DIS_PRESETS = {
    "DIS ultrafast": cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST,
    "DIS fast": cv2.DISOPTICAL_FLOW_PRESET_FAST,
    YARDSTICK: cv2.DISOPTICAL_FLOW_PRESET_MEDIUM,
}
HOMOGRAPHY = "homography difference"
OTHERS = (*DIS_PRESETS, "Farneback", HOMOGRAPHY)

Run = Callable[[FramePair], object]


class Subject(NamedTuple):
    """One row: ``name`` of another method, or ours with its runtime, preset and evidence ("-" where it has none)."""

    name: str
    runtime: RuntimeName | Literal["-"] = "-"
    preset: str = "-"
    evidence: str = "-"

    @property
    def ours(self) -> bool:
        return self.preset != "-"


def choose_subjects(runtimes: Sequence[RuntimeName], presets: Sequence[str]) -> list[Subject]:
    """Ours under every runtime, then the others. Networks without weights of ours exist in torch alone, untrained:
    their time is that of trained ones. They are judged by the residual, which is all that they have.
    """
    ours = []
    for preset in presets:
        if preset == "bundled":
            ours += [Subject("viflow-anomaly", name, preset, of) for name in runtimes for of in EVIDENCE]
        else:
            ours.append(Subject("viflow-anomaly", "torch", preset, "residual"))
    return [*ours, *(Subject(name) for name in OTHERS)]


def load_subject(subject: Subject, threads: int) -> Run:
    """Ready to be called with pairs.

    Raises:
        ConfigError: ``runtime_unavailable``.
    """
    if subject.name in DIS_PRESETS:
        search = cv2.DISOpticalFlow_create(DIS_PRESETS[subject.name])  # type: ignore[attr-defined]
        return lambda pair: search.calc(pair.source.image, pair.target.image, None)
    if subject.name == "Farneback":
        return lambda pair: farneback(pair.source.image, pair.target.image)
    if subject.name == HOMOGRAPHY:
        return _homography_regions
    return _detector(subject, threads).detect


def _homography_regions(pair: FramePair) -> object:
    """Corners, Lucas-Kanade, RANSAC, warp, difference, and the same steps from evidence to regions as ours."""
    found, inside = homography_difference(pair)
    height, width = found.shape
    return rois_from_regions(find_regions(found, inside, RegionConfig()).regions, ImageSize(width, height))


def _detector(subject: Subject, threads: int) -> AnomalyDetector:
    assert subject.runtime != "-"
    config = DetectorConfig(evidence="residual" if subject.evidence == "residual" else "auto")
    if subject.preset == "bundled":
        return AnomalyDetector.from_checkpoint(
            config=config, runtime=subject.runtime, threads=threads, with_evidence=subject.evidence != "residual"
        )
    view = ViewConfig(mode="center_crop") if subject.preset == "paper" else ViewConfig()
    preset: Literal["paper", "compact"] = "paper" if subject.preset == "paper" else "compact"
    return untrained_detector(ModelConfig(preset=preset, view=view), config, threads)


def untrained_detector(model: ModelConfig, config: DetectorConfig, threads: int) -> AnomalyDetector:
    """A network of random weights in torch, without an evidence head."""
    import torch  # noqa: PLC0415  # a second of start-up

    from viflow_anomaly.model.builder import build_model  # noqa: PLC0415
    from viflow_anomaly.runtime.torch_runtime import TorchRuntime  # noqa: PLC0415

    torch.set_num_threads(threads)
    record = CheckpointRecord(name=f"untrained-{model.preset}", version="0", sha256="0" * 64, model=model)
    return AnomalyDetector(TorchRuntime(build_model(model).eval()), record, config=config)
