"""Ground truth in a folder ``groundtruth0``: depth, static flow; of a simulated sequence also masks and movers.

The simulator's lies in ``mav0`` and takes camera and poses from the files there (docs/simulator.md). What was rendered
for a recording (docs/ground_truth.md) lies anywhere: ``groundtruth0/ground_truth.json`` has the camera, with its
distortion, and ``groundtruth0/poses.csv`` the poses. Needs neither mujoco nor torch.
"""

from __future__ import annotations

import csv
import itertools
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.datasets import euroc
from viflow_anomaly.datasets.camera_json import camera_from_mapping
from viflow_anomaly.datasets.ground_truth_png import (
    read_depth_png,
    read_flow_png,
    read_instances_png,
    read_mask_png,
)
from viflow_anomaly.errors import DatasetError, InvalidInputError
from viflow_anomaly.geometry import occluded_pixels, rigid_motion_flow
from viflow_anomaly.sensor_data import Float64Array, Int64Array, PinholeCamera, Uint8Array

Float32Array = NDArray[np.float32]
BoolArray = NDArray[np.bool_]

FOLDER_NAME = "groundtruth0"
SIMULATED_CAMERA = "cam0"
RECORD_NAME = "ground_truth.json"
POSES_NAME = "poses.csv"
OBJECT_COLUMNS = (
    "timestamp_ns",
    "instance_id",
    "area_px",
    "u_min",
    "v_min",
    "u_max",
    "v_max",
    "independent_flow_px",
)


@dataclass(frozen=True)
class MovingObject:
    """A moving thing in one frame. Box corners are inclusive pixels; ``independent_flow_px`` is the median distance
    between its flow and what a static thing in its place would show, to the next frame."""

    timestamp_ns: int
    instance_id: int
    area_px: int
    u_min: int
    v_min: int
    u_max: int
    v_max: int
    independent_flow_px: float


def ground_truth_folder(root: Path) -> Path | None:
    """``mav0/groundtruth0`` in a folder, else ``groundtruth0``; None without either."""
    places = (root / "mav0" / FOLDER_NAME, root / FOLDER_NAME)
    return next((place for place in places if place.is_dir()), None)


class GroundTruthFolder:
    """Ground truth of one sequence: simulated, or rendered for a recording.

    Args:
        root: the sequence, its ``mav0`` folder, or what else ``ground_truth_folder`` accepts.

    Raises:
        DatasetError: ``ground_truth_missing`` when there is none.
    """

    def __init__(self, root: Path) -> None:
        folder = ground_truth_folder(root)
        if folder is None:
            raise DatasetError(
                f"{root}: expected groundtruth0 or mav0/groundtruth0, found none", code="ground_truth_missing"
            )
        self.folder = folder
        self.is_rendered = (folder / RECORD_NAME).is_file()
        """For a recording, whose record it has then; else it is a simulated sequence's."""

    @classmethod
    def find(cls, root: Path) -> Self | None:
        """The ground truth beside a sequence (its root or its ``mav0``), or None."""
        return None if ground_truth_folder(root) is None else cls(root)

    @cached_property
    def camera(self) -> PinholeCamera:
        """Intrinsics and distortion of the images that depth and flow belong to.

        Raises:
            DatasetError: ``ground_truth_missing``, ``ground_truth_malformed``.
        """
        if self.is_rendered:
            return self._record[0]
        sensors = [self.folder.with_name(name) / "sensor.yaml" for name in (SIMULATED_CAMERA, "imu0")]
        with _as_ground_truth():
            camera = euroc.read_camera(*sensors)
        if camera is None:
            raise DatasetError(
                f"{sensors[0]}: expected the simulated camera's calibration, found no such file",
                code="ground_truth_malformed",
            )
        return camera

    @cached_property
    def camera_name(self) -> str | None:
        """As ``Recording.camera_name``; None also where an older record does not say.

        Raises:
            DatasetError: ``ground_truth_malformed``.
        """
        return self._record[1] if self.is_rendered else SIMULATED_CAMERA

    @cached_property
    def _record(self) -> tuple[PinholeCamera, str | None]:
        path = self.folder / RECORD_NAME
        try:
            return _parse_record(path.read_bytes())
        except (OSError, ValueError, KeyError, TypeError, RecursionError, InvalidInputError) as err:
            raise DatasetError(
                f"{path}: expected the record of rendered ground truth with its camera, found {err!r:.200}",
                code="ground_truth_malformed",
            ) from err

    @cached_property
    def has_instances(self) -> bool:
        """Whether movers are known: ``instances`` is there. Rendered ground truth knows of none."""
        return any((self.folder / "instances").glob("*.png"))

    @cached_property
    def _poses(self) -> tuple[Int64Array, Float64Array]:
        """Stamps [N] in the camera's clock, T_world_cam [N, 4, 4]."""
        if self.is_rendered:
            with _as_ground_truth():
                return euroc.read_body_poses(self.folder / POSES_NAME)
        states = self.folder.with_name("state_groundtruth_estimate0") / "data.csv"
        with _as_ground_truth():
            trajectory = euroc.read_trajectory(states, self.folder.with_name(SIMULATED_CAMERA) / "sensor.yaml")
        if trajectory is None:
            raise DatasetError(
                f"{states}: expected the simulated states, and {SIMULATED_CAMERA}/sensor.yaml beside them, found not "
                "both",
                code="ground_truth_missing",
            )
        return trajectory.timestamps_ns, trajectory.T_world_cam

    def camera_pose(self, timestamp_ns: int) -> Float64Array:
        """T_world_cam [4, 4] at a frame's stamp.

        Raises:
            DatasetError: ``ground_truth_missing`` when there is no pose of that very stamp; ``ground_truth_malformed``.
        """
        stamps, poses = self._poses
        index = int(np.searchsorted(stamps, timestamp_ns))
        if index == len(stamps) or stamps[index] != timestamp_ns:
            raise DatasetError(
                f"{self.folder}: expected a ground-truth pose at {timestamp_ns}, found none",
                code="ground_truth_missing",
            )
        return np.array(poses[index])

    def depth(self, source_ns: int) -> Float32Array:
        """[H, W] metres, inf where nothing was hit (simulated) or nothing is known (rendered for a recording)."""
        return read_depth_png(self.folder / "depth" / f"{source_ns}.png")

    def static_flow(self, source_ns: int, target_ns: int) -> tuple[Float32Array, BoolArray]:
        """Flow of the static world [H, W, 2] and validity [H, W] between any two frames.

        The stored PNG for the next frame, else from depth (to 2 mm) and poses. Occluded pixels and those that leave
        the image count as valid; so does the simulator's sky, but no pixel whose depth is not known.

        Raises:
            DatasetError: ``ground_truth_missing``, ``ground_truth_malformed``.
        """
        stored = self.folder / "static_flow" / f"{source_ns}.png"
        if target_ns == self._next_stamps.get(source_ns) and stored.is_file():
            return read_flow_png(stored)
        depth = self.depth(source_ns)
        flow, valid = rigid_motion_flow(self.camera, depth, self._motion(source_ns, target_ns))
        if not self.is_rendered:
            return flow, valid
        known = valid & np.isfinite(depth)
        return np.where(known[..., None], flow, np.float32(0)), known

    def occluded(self, source_ns: int, target_ns: int) -> BoolArray:
        """[H, W]: the point is in the target's image, but behind something nearer (of the static world and, in a
        simulated sequence, of the movers).

        The stored PNG for the next frame, else from the depth of both frames and the poses.

        Raises:
            DatasetError: ``ground_truth_missing`` (also where the target has no depth), ``ground_truth_malformed``.
        """
        stored = self.folder / "occluded" / f"{source_ns}.png"
        if target_ns == self._next_stamps.get(source_ns) and stored.is_file():
            return read_mask_png(stored)
        depths = self.depth(source_ns), self.depth(target_ns)
        return occluded_pixels(self.camera, *depths, self._motion(source_ns, target_ns))

    def _motion(self, source_ns: int, target_ns: int) -> Float64Array:
        return np.asarray(np.linalg.inv(self.camera_pose(target_ns)) @ self.camera_pose(source_ns))

    @cached_property
    def source_stamps(self) -> tuple[int, ...]:
        """The frames that have depth, in order of time: static flow can be had from each of them."""
        return tuple(sorted(int(path.stem) for path in (self.folder / "depth").glob("*.png") if path.stem.isdecimal()))

    @cached_property
    def _next_stamps(self) -> dict[int, int]:
        # Rendered ground truth may lack depth for some frames; every frame that has a pose is in its poses.
        stamps = self._poses[0].tolist() if self.is_rendered else self.source_stamps
        return dict(itertools.pairwise(stamps))

    def flow(self, source_ns: int) -> tuple[Float32Array, BoolArray]:
        """Flow of everything, movers included, to the next frame: [H, W, 2] and validity [H, W]."""
        return read_flow_png(self.folder / "flow" / f"{source_ns}.png")

    def instances(self, source_ns: int) -> Uint8Array:
        """[H, W] uint8: 0 the static world, 1.. movers."""
        return read_instances_png(self.folder / "instances" / f"{source_ns}.png")

    def objects(self, source_ns: int) -> list[MovingObject]:
        """The movers that show in a frame, in order of their number; empty for the last frame (it has no flow)."""
        return self._objects.get(source_ns, [])

    @cached_property
    def _objects(self) -> dict[int, list[MovingObject]]:
        path = self.folder / "objects.csv"
        found: dict[int, list[MovingObject]] = {}
        for number, row in _csv_rows(path):
            try:
                thing = _object_of(row)
            except ValueError as err:
                raise _malformed(path, number, ",".join(OBJECT_COLUMNS), row) from err
            found.setdefault(thing.timestamp_ns, []).append(thing)
        return found


@contextmanager
def _as_ground_truth() -> Iterator[None]:
    """What the recordings' readers refuse is ground truth that is missing or malformed here."""
    try:
        yield
    except DatasetError as err:
        code = "ground_truth_missing" if err.code == "file_missing" else "ground_truth_malformed"
        raise DatasetError(err.message, code=code) from err


def _parse_record(text: bytes) -> tuple[PinholeCamera, str | None]:
    record = json.loads(text)
    camera, name = camera_from_mapping(record["camera"]), record.get("camera_name")
    if not isinstance(name, str | None):
        raise TypeError(f"camera_name {name!r:.40}")
    return camera, name


def _object_of(row: list[str]) -> MovingObject:
    if len(row) != len(OBJECT_COLUMNS):
        raise ValueError(f"{len(row)} columns")
    stamp, number, area, u_min, v_min, u_max, v_max = (int(value) for value in row[:7])
    return MovingObject(stamp, number, area, u_min, v_min, u_max, v_max, float(row[7]))


def _malformed(path: Path, line: int, expected: str, row: list[str]) -> DatasetError:
    return DatasetError(
        f"{path}, line {line}: expected {expected}, found {','.join(row)!r}", code="ground_truth_malformed"
    )


def _csv_rows(path: Path) -> list[tuple[int, list[str]]]:
    """Line numbers and fields below the header."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            return [(number, row) for number, row in enumerate(csv.reader(file), start=1) if number > 1 and row]
    except OSError as err:
        raise DatasetError(f"{path}: expected a CSV file, cannot read it: {err}", code="ground_truth_missing") from err
    except (UnicodeDecodeError, csv.Error) as err:
        raise DatasetError(f"{path}: expected a CSV file, found {err}", code="ground_truth_malformed") from err
