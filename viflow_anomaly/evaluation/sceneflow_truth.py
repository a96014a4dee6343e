"""KITTI scene flow 2015 as ground truth: the paper's KITTI test set, one truth for each raw drive."""

from __future__ import annotations

from pathlib import Path

from viflow_anomaly.config import MotorSource
from viflow_anomaly.datasets.kitti_sceneflow import KittiSceneFlow
from viflow_anomaly.errors import DatasetError
from viflow_anomaly.evaluation.flow_truth import PairName, TrueFlow
from viflow_anomaly.sensor_data import FramePair


def is_scene_flow(path: Path) -> bool:
    """Whether a folder is the benchmark's (``training/flow_occ``)."""
    return (path / "training" / "flow_occ").is_dir()


def open_scene_flow(path: Path, *, movers: bool = True) -> list[SceneFlowTruth]:
    """The usable pairs of the training set, by drive.

    Args:
        path: holds ``training/``.
        movers: False: pixels of moving cars do not count (``obj_map``).

    Raises:
        DatasetError: as ``KittiSceneFlow``.
    """
    flows = KittiSceneFlow(path)
    by_drive: dict[str, list[int]] = {}
    for index in range(len(flows)):
        by_drive.setdefault(flows.sequence(index), []).append(index)
    return [SceneFlowTruth(flows, name, indices, movers=movers) for name, indices in sorted(by_drive.items())]


class SceneFlowTruth:
    """Pairs of one raw drive. Unlike the simulator's, the flow of moving cars is their own.

    Args:
        flows: the benchmark.
        sequence: the drive.
        indices: its pairs.
        movers: False: pixels of moving cars do not count.
    """

    def __init__(self, flows: KittiSceneFlow, sequence: str, indices: list[int], *, movers: bool) -> None:
        self._flows = flows
        self._indices = indices
        self._movers = movers
        self.sequence = sequence

    def __len__(self) -> int:
        return len(self._indices)

    def name(self, index: int) -> PairName:
        source_ns, target_ns = self._flows.stamps(self._indices[index])
        return PairName(self.sequence, 1, source_ns, target_ns)

    def pair(self, index: int, motor_source: MotorSource | None = None) -> FramePair:
        return self._flows.pair(self._indices[index], motor_source)

    def truth(self, index: int) -> TrueFlow:
        flow_px, valid = self._flows.truth(self._indices[index])
        if self._movers:
            return TrueFlow(flow_px, valid)
        moving = self._flows.moving(self._indices[index]) > 0
        if moving.shape != valid.shape:
            raise DatasetError(
                f"{self.name(index)}: expected a map of objects of the flow's shape {valid.shape}, "
                f"found {moving.shape}",
                code="ground_truth_malformed",
            )
        return TrueFlow(flow_px, valid & ~moving)
