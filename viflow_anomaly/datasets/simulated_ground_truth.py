"""Ground truth in a folder ``groundtruth0``: depth, static flow; of a simulated sequence also masks and movers.

The simulator's lies in ``mav0`` and takes camera and poses from the files there (docs/simulator.md). What was rendered
for a recording (docs/ground_truth.md) lies anywhere: ``groundtruth0/ground_truth.json`` has the camera, with its
distortion, and ``groundtruth0/poses.csv`` the poses. Needs neither mujoco nor torch.
"""

from __future__ import annotations

import csv
import itertools
import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Self

import numpy as np
import yaml
from numpy.typing import NDArray

from viflow_anomaly.datasets.camera_json import camera_from_mapping
from viflow_anomaly.datasets.ground_truth_png import (
    read_depth_png,
    read_flow_png,
    read_instances_png,
    read_mask_png,
)
from viflow_anomaly.errors import DatasetError, InvalidInputError
from viflow_anomaly.geometry import occluded_pixels, rigid_motion_flow
from viflow_anomaly.sensor_data import Float64Array, PinholeCamera, Uint8Array

Float32Array = NDArray[np.float32]
BoolArray = NDArray[np.bool_]

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


def _rotation(quaternion_wxyz: Float64Array) -> Float64Array:
    w, x, y, z = quaternion_wxyz / np.linalg.norm(quaternion_wxyz)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


class SimulatedGroundTruth:
    """Ground truth of one sequence: simulated, or rendered for a recording.

    Args:
        root: the sequence, its ``mav0`` folder, or anything ``find`` accepts: a folder that holds ``groundtruth0``.

    Raises:
        DatasetError: ``ground_truth_missing`` when there is none.
    """

    def __init__(self, root: Path) -> None:
        mav0 = root / "mav0" if (root / "mav0").is_dir() else root
        self.folder = mav0 / "groundtruth0"
        self._mav0 = mav0
        if not self.folder.is_dir():
            raise DatasetError(
                f"{root}: expected groundtruth0 or mav0/groundtruth0, found none", code="ground_truth_missing"
            )
        self._is_rendered = (self.folder / RECORD_NAME).is_file()

    @classmethod
    def find(cls, root: Path) -> Self | None:
        """The ground truth beside a sequence (its root or its ``mav0``), or None."""
        places = (root / "mav0" / "groundtruth0", root / "groundtruth0")
        return cls(root) if any(place.is_dir() for place in places) else None

    @cached_property
    def camera(self) -> PinholeCamera:
        """Intrinsics and distortion of the images that depth and flow belong to."""
        return self._calibration[0]

    @cached_property
    def _calibration(self) -> tuple[PinholeCamera, Float64Array]:
        if self._is_rendered:
            return _recorded_camera(self.folder / RECORD_NAME), np.eye(4)
        path = self._mav0 / "cam0" / "sensor.yaml"
        try:
            sensor = yaml.safe_load(path.read_text(encoding="utf-8"))
            fx, fy, cx, cy = (float(value) for value in sensor["intrinsics"])
            width, height = (int(value) for value in sensor["resolution"])
            T_body_cam = np.array(sensor["T_BS"]["data"], dtype=np.float64).reshape(4, 4)
            camera = PinholeCamera(fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height)
        except (OSError, yaml.YAMLError, KeyError, TypeError, ValueError, InvalidInputError) as err:
            raise DatasetError(
                f"{path}: expected intrinsics, resolution and T_BS, found {err!r}", code="ground_truth_malformed"
            ) from err
        return camera, T_body_cam

    @cached_property
    def _states(self) -> tuple[NDArray[np.int64], Float64Array]:
        """Stamps [N] and rows [N, 7]: position, quaternion w x y z."""
        path = self._mav0 / "state_groundtruth_estimate0" / "data.csv"
        if self._is_rendered:
            path = self.folder / POSES_NAME
        stamps, rows = [], []
        for number, row in _csv_rows(path):
            try:
                stamp, state = _state_of(row)
            except ValueError as err:
                raise _malformed(path, number, "a stamp, a position and a quaternion", row) from err
            stamps.append(stamp)
            rows.append(state)
        return np.array(stamps, dtype=np.int64), np.array(rows, dtype=np.float64).reshape(-1, 7)

    def camera_pose(self, timestamp_ns: int) -> Float64Array:
        """T_world_cam [4, 4] at a frame's stamp.

        Raises:
            DatasetError: ``ground_truth_missing`` when the stamp is not in the state ground truth.
        """
        stamps, rows = self._states
        index = int(np.searchsorted(stamps, timestamp_ns))
        if index == len(stamps) or stamps[index] != timestamp_ns:
            raise DatasetError(
                f"{self.folder}: expected a ground-truth pose at {timestamp_ns}, found none",
                code="ground_truth_missing",
            )
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = _rotation(rows[index, 3:]), rows[index, :3]
        return np.asarray(pose @ self._calibration[1])

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
        if not self._is_rendered:
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
        stamps = self._states[0].tolist() if self._is_rendered else self.source_stamps
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


def _recorded_camera(path: Path) -> PinholeCamera:
    try:
        return camera_from_mapping(json.loads(path.read_bytes())["camera"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError, InvalidInputError) as err:
        raise DatasetError(
            f"{path}: expected the record of rendered ground truth with its camera, found {err!r:.200}",
            code="ground_truth_malformed",
        ) from err


def _state_of(row: list[str]) -> tuple[int, list[float]]:
    if len(row) < 8:
        raise ValueError(f"{len(row)} columns")
    return int(row[0]), [float(value) for value in row[1:8]]


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
