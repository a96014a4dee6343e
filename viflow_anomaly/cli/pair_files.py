"""Two images, an IMU file and perhaps a camera file -> one ``FramePair``."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import ConfigDict, Field, ValidationError

from viflow_anomaly.config import FrozenConfig, ImageLimits, fault_text
from viflow_anomaly.datasets.plain import read_camera, read_imu
from viflow_anomaly.errors import DatasetError, InvalidInputError
from viflow_anomaly.images import read_image
from viflow_anomaly.sensor_data import Frame, FramePair, ImuSamples, PinholeCamera

# As much as `batch` takes around a pair (datasets.pairing): the same pair gives the same answer.
_MARGIN_NS = 250_000_000
_Vector = tuple[float, float, float]
_Stamp = Annotated[int, Field(ge=-(2**63), le=2**63 - 1)]


class ImuDocument(FrozenConfig):
    """``imu.json``, the ``imu`` part of the HTTP contract."""

    model_config = ConfigDict(strict=True)

    timestamps_ns: list[_Stamp]
    gyro_rad_s: list[_Vector]
    accel_m_s2: list[_Vector] | None = None
    source_timestamp_ns: _Stamp | None = None
    target_timestamp_ns: _Stamp | None = None


@dataclass(frozen=True)
class PairFiles:
    """The files of one pair; stamps given here win over those in ``imu.json``."""

    source: Path
    target: Path
    imu: Path
    camera: Path | None = None
    source_timestamp_ns: int | None = None
    target_timestamp_ns: int | None = None
    motor_command: tuple[float, ...] | None = None


def load_pair(files: PairFiles, *, limits: ImageLimits) -> tuple[FramePair, float]:
    """The pair and how long reading its images took, in milliseconds.

    Raises:
        ViflowError: any file that cannot be read or contradicts the others; ``imu_unreadable``,
            ``imu_document_invalid``, ``timestamp_missing``, and the codes of what it reads.
    """
    document = None if files.imu.suffix.lower() == ".csv" else _read_document(files.imu)
    source_ns = _stamp(files, document, "source_timestamp_ns")
    target_ns = _stamp(files, document, "target_timestamp_ns")
    camera = None if files.camera is None else _read_camera(files.camera)
    started = time.perf_counter()
    source = _read_frame(files.source, source_ns, limits=limits, field="source")
    target = _read_frame(files.target, target_ns, limits=limits, field="target")
    decode_ms = (time.perf_counter() - started) * 1e3
    imu = _samples(document) if document is not None else _samples_around(files.imu, source_ns, target_ns, camera)
    command = None if files.motor_command is None else np.array(files.motor_command)
    return FramePair(source=source, target=target, imu=imu, camera=camera, motor_command=command), decode_ms


def _stamp(files: PairFiles, document: ImuDocument | None, name: str) -> int:
    given = getattr(files, name)
    found = given if given is not None else getattr(document, name, None)
    if found is None:
        option = "--" + name.replace("_", "-")
        raise InvalidInputError(
            f"{name}: expected it in {option} or in an imu.json, found neither", code="timestamp_missing", field=name
        )
    return int(found)


def _read_frame(path: Path, timestamp_ns: int, *, limits: ImageLimits, field: str) -> Frame:
    image = read_image(path, limits=limits, field=field)
    try:
        return Frame(timestamp_ns, image)
    except InvalidInputError as err:
        raise type(err)(f"{path}: {field}: {err.message}", code=err.code, field=f"{field}.{err.field}") from err


def _samples(document: ImuDocument) -> ImuSamples:
    accel = None if document.accel_m_s2 is None else np.array(document.accel_m_s2).reshape(-1, 3)
    stamps = np.array(document.timestamps_ns, dtype=np.int64)
    return ImuSamples(stamps, np.array(document.gyro_rad_s).reshape(-1, 3), accel)


def _samples_around(path: Path, source_ns: int, target_ns: int, camera: PinholeCamera | None) -> ImuSamples:
    offset_ns = 0 if camera is None else round(camera.time_offset_s * 1e9)
    first, last = min(source_ns, target_ns), max(source_ns, target_ns)
    return read_imu(path).between(first + offset_ns - _MARGIN_NS, last + offset_ns + _MARGIN_NS)


def _read_camera(path: Path) -> PinholeCamera:
    camera = read_camera(path)
    if camera is None:
        raise DatasetError(f"{path}: expected a camera.json, found no such file", code="file_missing", field="camera")
    return camera


def _read_document(path: Path) -> ImuDocument:
    try:
        return ImuDocument.model_validate_json(path.read_bytes())
    except OSError as err:
        raise InvalidInputError(
            f"{path}: expected an imu.json or imu.csv, found: {err.strerror}", code="imu_unreadable", field="imu"
        ) from err
    except ValidationError as err:
        problems = err.errors()
        place = ".".join(["imu", *map(str, problems[0]["loc"])])
        found = "" if problems[0]["type"] in ("json_invalid", "missing") else f", found {problems[0]['input']!r:.80}"
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        raise InvalidInputError(
            f"{path}: {place}: {fault_text(problems[0]['type'], problems[0]['msg'])}{found}{more}",
            code="imu_document_invalid",
            field=place,
        ) from err
