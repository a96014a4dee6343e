"""The folder ``groundtruth0`` that is written for a recording; ``GroundTruthFolder`` reads it.

```
groundtruth0/
  ground_truth.json       the camera, and what the rest was made from (the poses' checksum too); written first
  poses.csv               T_world_cam of every frame that has a pose
  static_flow/<ns>.png    to the next frame, only where that has a pose
  occluded/<ns>.png       255: hidden in the next frame; only where both frames have dense depth
  depth/<ns>.png          written last: a frame with depth, and flow where it is to have that, is done
```
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.checkpoint_record import write_atomically
from viflow_anomaly.datasets.camera_json import camera_to_mapping
from viflow_anomaly.datasets.ground_truth_folder import POSES_NAME, RECORD_NAME
from viflow_anomaly.datasets.ground_truth_png import write_depth_png, write_flow_png, write_mask_png
from viflow_anomaly.datasets.recording import FileRecording
from viflow_anomaly.errors import DatasetError
from viflow_anomaly.ground_truth.frame_poses import quaternion_of
from viflow_anomaly.sensor_data import Float64Array, PinholeCamera

Float32Array = NDArray[np.float32]
BoolArray = NDArray[np.bool_]

FOLDER_NAME = "groundtruth0"
PICTURES = ("depth", "static_flow", "occluded")
RENDERING_VERSION = 2
"""Raised when the same files give other pictures."""


@dataclass(frozen=True, eq=False)
class FrameTruth:
    """What one frame gets. Flow [H, W, 2] and validity [H, W] are None where the next frame has no pose, ``occluded``
    [H, W] where nothing tells."""

    depth_m: Float32Array
    flow: Float32Array | None = None
    valid: BoolArray | None = None
    occluded: BoolArray | None = None


class TruthFolder:
    """Writes ``out/groundtruth0``.

    Args:
        out: is made where it does not exist.
        record: what the ground truth is made from, beside the poses. A later run goes on where this one ends only if
            both are the same.
        poses: {stamp: T_world_cam}.
        overwrite: remove what an earlier run wrote and begin anew.

    Raises:
        DatasetError: ``ground_truth_foreign``: a ``groundtruth0`` of other origin is there (never written over);
            ``ground_truth_differs``: one made from other files, poses or settings.
    """

    def __init__(
        self, out: Path, record: Mapping[str, Any], poses: Mapping[int, Float64Array], *, overwrite: bool
    ) -> None:
        self.folder = out / FOLDER_NAME
        poses_csv = _poses_text(poses).encode()
        whole = {**record, "poses": {"file": POSES_NAME, "sha256": hashlib.sha256(poses_csv).hexdigest()}}
        text = json.dumps(whole, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
        self._check(text, overwrite=overwrite)
        for name in PICTURES[:2]:
            (self.folder / name).mkdir(parents=True, exist_ok=True)
        write_atomically(self.folder / RECORD_NAME, text.encode())
        write_atomically(self.folder / POSES_NAME, poses_csv)

    def _check(self, text: str, *, overwrite: bool) -> None:
        record = self.folder / RECORD_NAME
        if not self.folder.is_dir() or not any(self.folder.iterdir()):
            return
        if not record.is_file():
            raise DatasetError(
                f"{self.folder}: expected nothing there or ground truth of this command, found other files; "
                "choose another place with --out",
                code="ground_truth_foreign",
            )
        if overwrite:
            for name in PICTURES:
                for picture in (self.folder / name).glob("*.png*"):
                    picture.unlink()
        elif record.read_bytes() != text.encode():
            raise DatasetError(
                f"{record}: expected the record of this run (to go on with it), found one of other files, poses, "
                "settings or version; --overwrite begins anew, --out chooses another place",
                code="ground_truth_differs",
            )

    def has(self, stamp_ns: int, *, flow: bool) -> bool:
        """Whether the frame is done, with flow to the next one where it is to have that."""
        return (self.folder / "depth" / f"{stamp_ns}.png").is_file() and (not flow or self.has_flow(stamp_ns))

    def has_flow(self, stamp_ns: int) -> bool:
        return (self.folder / "static_flow" / f"{stamp_ns}.png").is_file()

    def write(self, stamp_ns: int, truth: FrameTruth) -> None:
        """Store one frame; its depth last."""
        name = f"{stamp_ns}.png"
        if truth.flow is not None and truth.valid is not None:
            write_flow_png(self.folder / "static_flow" / name, truth.flow, truth.valid)
        if truth.occluded is not None:
            (self.folder / "occluded").mkdir(exist_ok=True)
            write_mask_png(self.folder / "occluded" / name, truth.occluded)
        write_depth_png(self.folder / "depth" / name, truth.depth_m)


def _poses_text(poses: Mapping[int, Float64Array]) -> str:
    lines = ["#timestamp_ns,p_x,p_y,p_z,q_w,q_x,q_y,q_z (T_world_cam)"]
    for stamp in sorted(poses):
        pose = poses[stamp]
        numbers = [*pose[:3, 3], *quaternion_of(pose[:3, :3])]
        lines.append(",".join([str(stamp), *(repr(float(number)) for number in numbers)]))
    return "\n".join(lines) + "\n"


def require_camera(recording: FileRecording) -> PinholeCamera:
    """The recording's camera.

    Raises:
        DatasetError: ``camera_missing``.
    """
    if recording.camera is None:
        raise DatasetError(
            f"{recording.root}: expected a calibrated camera, found no calibration", code="camera_missing"
        )
    return recording.camera


def record_head(recording: FileRecording, camera: PinholeCamera) -> dict[str, Any]:
    """The beginning of every ``ground_truth.json``."""
    return {
        "made_by": f"viflow-anomaly {version('viflow-anomaly')}, rendering {RENDERING_VERSION}",
        "recording": recording.name,
        "camera_name": recording.camera_name,
        "camera": camera_to_mapping(camera),
    }


def fingerprint(path: Path) -> dict[str, str]:
    """A file's name and checksum."""
    with path.open("rb") as file:
        return {"file": path.name, "sha256": hashlib.file_digest(file, "sha256").hexdigest()}


def fingerprint_of_files(paths: Iterable[Path]) -> dict[str, int | str]:
    """How many, and a checksum of their names and contents."""
    lines = ["{file} {sha256}".format(**fingerprint(path)) for path in paths]
    return {"files": len(lines), "sha256": _sha256(lines)}


def fingerprint_of_sizes(paths: Iterable[Path]) -> dict[str, int | str]:
    """How many, and a checksum of their names and sizes: for files that are too many to be read twice."""
    lines = [f"{path.name} {path.stat().st_size}" for path in paths]
    return {"files": len(lines), "sha256_of_names_and_sizes": _sha256(lines)}


def _sha256(lines: list[str]) -> str:
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()
