"""Ground truth beside a simulated sequence (``mav0/groundtruth0``): depth, flow, instances, moving objects.

Flow PNGs are KITTI's: 16 bit, three channels, value = 64 * flow + 2^15, third channel 1 where valid. Depth PNGs are
16 bit, 256 steps a metre, 0 where nothing is hit. See docs/simulator.md. Needs neither mujoco nor torch.
"""

from __future__ import annotations

import csv
import itertools
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from viflow_anomaly.errors import DatasetError, InvalidInputError
from viflow_anomaly.geometry import rigid_motion_flow
from viflow_anomaly.sensor_data import Float64Array, PinholeCamera, Uint8Array

Float32Array = NDArray[np.float32]
BoolArray = NDArray[np.bool_]

FLOW_STEPS_PER_PX = 64.0
FLOW_ZERO = 2**15
DEPTH_STEPS_PER_M = 256.0
UINT16_MAX = 65535
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


def _write_png(path: Path, image: NDArray[Any]) -> None:
    encoded, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    assert encoded
    partial = path.with_name(path.name + ".partial")
    partial.write_bytes(data.tobytes())
    partial.replace(path)


def _read_png(path: Path, channels: int, kind: str, dtype: type[np.unsignedinteger[Any]]) -> NDArray[Any]:
    try:
        data = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError as err:
        raise DatasetError(
            f"{path}: expected a {kind} PNG, cannot read it: {err.strerror}", code="ground_truth_missing"
        ) from err
    image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    if image is None:
        raise DatasetError(
            f"{path}: expected a {kind} PNG, found {data.size} bytes that are none", code="ground_truth_malformed"
        )
    shape = image.shape[2] if image.ndim == 3 else 1
    if shape != channels or image.dtype != dtype:
        raise DatasetError(
            f"{path}: expected a {kind} PNG of {channels} channel(s) of {np.dtype(dtype)}, "
            f"found {shape} of {image.dtype}",
            code="ground_truth_malformed",
        )
    return np.asarray(image)


def write_flow_png(path: Path, flow: Float32Array, valid: BoolArray) -> None:
    """Store flow [H, W, 2] (px) and validity [H, W]; flow that does not fit (beyond +-512 px) becomes invalid."""
    steps = np.rint(np.where(np.isfinite(flow), flow, 1e9).astype(np.float64) * FLOW_STEPS_PER_PX + FLOW_ZERO)
    stored = valid & ((steps >= 0) & (steps <= UINT16_MAX)).all(axis=-1)
    steps = np.where(stored[..., None], steps, 0)
    # OpenCV writes channels in the order B, G, R: valid, v, u.
    channels = np.stack([stored.astype(np.float64), steps[..., 1], steps[..., 0]], axis=-1)
    _write_png(path, channels.astype(np.uint16))


def read_flow_png(path: Path) -> tuple[Float32Array, BoolArray]:
    """Flow [H, W, 2] float32 in px (0 where invalid) and validity [H, W].

    Raises:
        DatasetError: ``ground_truth_missing``, ``ground_truth_malformed``.
    """
    image = _read_png(path, 3, "KITTI flow", np.uint16)
    valid = image[..., 0] > 0
    flow = (image[..., :0:-1].astype(np.float32) - FLOW_ZERO) / FLOW_STEPS_PER_PX
    return np.where(valid[..., None], flow, np.float32(0)), valid


def write_depth_png(path: Path, depth_m: Float32Array) -> None:
    """Store depth [H, W] in metres; what is not finite or does not fit (256 m) is stored as 0."""
    steps = np.rint(np.where(np.isfinite(depth_m), depth_m, 0.0).astype(np.float64) * DEPTH_STEPS_PER_M)
    _write_png(path, np.where((steps >= 1) & (steps <= UINT16_MAX), steps, 0).astype(np.uint16))


def read_depth_png(path: Path) -> Float32Array:
    """Depth [H, W] float32 in metres along the optical axis, inf where nothing was hit.

    Raises:
        DatasetError: ``ground_truth_missing``, ``ground_truth_malformed``.
    """
    image = _read_png(path, 1, "depth", np.uint16)
    return np.where(image > 0, image.astype(np.float32) / np.float32(DEPTH_STEPS_PER_M), np.float32(np.inf))


def write_instances_png(path: Path, instances: Uint8Array) -> None:
    """Store instance numbers [H, W] uint8 (0 static, 1.. movers)."""
    _write_png(path, instances)


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
    """Ground truth of one simulated sequence.

    Args:
        root: the sequence, its ``mav0`` folder, or anything ``find`` accepts.

    Raises:
        DatasetError: ``ground_truth_missing`` when there is none.
    """

    def __init__(self, root: Path) -> None:
        mav0 = root / "mav0" if (root / "mav0").is_dir() else root
        self.folder = mav0 / "groundtruth0"
        self._mav0 = mav0
        if not self.folder.is_dir():
            raise DatasetError(
                f"{root}: expected mav0/groundtruth0 of a simulated sequence, found none", code="ground_truth_missing"
            )

    @classmethod
    def find(cls, root: Path) -> Self | None:
        """The ground truth beside a sequence (its root or its ``mav0``), or None."""
        places = (root / "mav0" / "groundtruth0", root / "groundtruth0")
        return cls(root) if any(place.is_dir() for place in places) else None

    @cached_property
    def camera(self) -> PinholeCamera:
        """Intrinsics of the (undistorted) images."""
        return self._calibration[0]

    @cached_property
    def _calibration(self) -> tuple[PinholeCamera, Float64Array]:
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
                f"{self._mav0}: expected a ground-truth state at {timestamp_ns}, found none",
                code="ground_truth_missing",
            )
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = _rotation(rows[index, 3:]), rows[index, :3]
        return np.asarray(pose @ self._calibration[1])

    def depth(self, source_ns: int) -> Float32Array:
        """[H, W] metres, inf where nothing was hit."""
        return read_depth_png(self.folder / "depth" / f"{source_ns}.png")

    def static_flow(self, source_ns: int, target_ns: int) -> tuple[Float32Array, BoolArray]:
        """Flow of the static world [H, W, 2] and validity [H, W] between any two frames.

        The stored PNG for the next frame, else from depth (to 2 mm) and poses. Occluded pixels count as valid.

        Raises:
            DatasetError: ``ground_truth_missing``, ``ground_truth_malformed``.
        """
        stored = self.folder / "static_flow" / f"{source_ns}.png"
        if target_ns == self._next_stamps.get(source_ns) and stored.is_file():
            return read_flow_png(stored)
        T_target_source = np.linalg.inv(self.camera_pose(target_ns)) @ self.camera_pose(source_ns)
        return rigid_motion_flow(self.camera, self.depth(source_ns), T_target_source)

    @cached_property
    def _next_stamps(self) -> dict[int, int]:
        stamps = sorted(int(path.stem) for path in (self.folder / "depth").glob("*.png"))
        return dict(itertools.pairwise(stamps))

    def flow(self, source_ns: int) -> tuple[Float32Array, BoolArray]:
        """Flow of everything, movers included, to the next frame: [H, W, 2] and validity [H, W]."""
        return read_flow_png(self.folder / "flow" / f"{source_ns}.png")

    def instances(self, source_ns: int) -> Uint8Array:
        """[H, W] uint8: 0 the static world, 1.. movers."""
        image = _read_png(self.folder / "instances" / f"{source_ns}.png", 1, "instance", np.uint8)
        return np.asarray(image, dtype=np.uint8)

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
