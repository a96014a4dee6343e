"""KITTI's calibration files -> PinholeCamera with ``T_cam_imu``."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np

from viflow_anomaly.datasets.kitti_files import read_calibration
from viflow_anomaly.datasets.tables import read_lines
from viflow_anomaly.errors import DatasetError, InvalidInputError
from viflow_anomaly.sensor_data import Float64Array, PinholeCamera

# Reduced images keep their shape only up to a rounded pixel: 1242x375 (3.312) became 400x120 (3.333).
ASPECT_TOLERANCE = 0.02
OFFICIAL_RECT_SIZE = (1242.0, 375.0)

# Where an odometry sequence has no calib_imu_to_velo.txt: KITTI's published sensor plan, good to about a degree and
# 5 cm. IMU x front, y left, z top; camera x right, y down, z front; seen from image_0 the IMU lies 0.32 m to the left,
# 0.72 m below and 1.08 m behind.
NOMINAL_T_CAM0_IMU = np.array(
    [[0.0, -1.0, 0.0, -0.32], [0.0, 0.0, -1.0, 0.72], [1.0, 0.0, 0.0, -1.08], [0.0, 0.0, 0.0, 1.0]]
)


@dataclass(frozen=True)
class CalibrationFiles:
    """The raw data's three calibration files, where they may or may not be."""

    cam_to_cam: Path
    velo_to_cam: Path
    imu_to_velo: Path

    @classmethod
    def of_date(cls, folder: Path) -> Self:
        """Those of all drives of one day."""
        return cls(*(folder / f"calib_{name}.txt" for name in ("cam_to_cam", "velo_to_cam", "imu_to_velo")))


def read_raw_camera(files: CalibrationFiles, number: str, size: tuple[int, int]) -> PinholeCamera | None:
    """The camera ``image_<number>`` of the raw data.

    ``T_cam_imu = T_cam_cam0 T_cam0_velo T_velo_imu``. For rectified images T_cam_cam0 is R_rect_00 and the camera's
    place in the rectified frame, inv(K) P_rect[:, 3]; for unrectified ones it is R_0x, T_0x.

    Args:
        files: where the calibration is.
        number: ``"00"`` to ``"03"``.
        size: (width, height) of the images as stored; tells rectified from unrectified and finds reduced images.

    Returns:
        None without ``cam_to_cam``; ``T_cam_imu`` None without the other two.

    Raises:
        DatasetError: ``calibration_malformed``.
    """
    path = files.cam_to_cam
    if not path.is_file():
        return None
    counts = {"S": 2, "K": 9, "D": 5, "R": 9, "T": 3, "S_rect": 2, "P_rect": 12}
    values = read_calibration(path, {f"{key}_{number}": count for key, count in counts.items()} | {"R_rect_00": 9})
    calibration = _Calibration(path, values, number)
    try:
        camera, T_cam_cam0 = calibration.camera_for(size)
        T_cam0_imu = _read_imu_to_cam0(files)
        if T_cam0_imu is not None:
            camera = replace(camera, T_cam_imu=T_cam_cam0 @ T_cam0_imu)
        return camera.scaled_to(*size)
    except InvalidInputError as err:
        raise _malformed(path, err.message) from err


def read_odometry_camera(
    folder: Path, number: str, size: tuple[int, int], *, imu_to_velo: Path | None = None
) -> PinholeCamera | None:
    """The camera ``image_<number>`` of an odometry sequence, from ``calib*.txt``.

    With ``Tr`` (velodyne to image_0) and the IMU's place ``T_cam_imu`` is exact, otherwise the nominal mounting is
    taken.

    Args:
        folder: the sequence.
        number: ``"0"`` to ``"3"``.
        size: (width, height) of the images as stored; must be those that the calibration describes.
        imu_to_velo: the IMU's place on the velodyne; None: ``calib_imu_to_velo.txt`` in the sequence's folder.

    Returns:
        None without a calibration file.

    Raises:
        DatasetError: ``calibration_malformed``.
    """
    found = _odometry_projection(folder, number)
    if found is None:
        return None
    path, values, projection = found
    imu_to_velo = imu_to_velo or folder / "calib_imu_to_velo.txt"
    T_cam0_imu = NOMINAL_T_CAM0_IMU
    if "Tr" in values and imu_to_velo.is_file():
        T_cam0_velo = np.vstack([values["Tr"].reshape(3, 4), (0.0, 0.0, 0.0, 1.0)])
        T_cam0_imu = T_cam0_velo @ _read_rigid(imu_to_velo)
    try:
        camera, T_cam_cam0 = _pinhole(path, projection, size)
        camera = replace(camera, T_cam_imu=T_cam_cam0 @ T_cam0_imu)
    except InvalidInputError as err:
        raise _malformed(path, err.message) from err
    width, height = size
    if not (0 < camera.cx < width and 0 < camera.cy < height):
        raise _malformed(
            path,
            f"expected images whose centre is near ({camera.cx:.0f}, {camera.cy:.0f}), found {width}x{height} px; "
            "have they been resized?",
        )
    return camera


def read_odometry_shift(folder: Path, number: str) -> Float64Array | None:
    """T_cam_cam0 [4, 4], from image_0 to the rectified camera ``image_<number>``: a shift by inv(K) P[:, 3].

    Returns:
        None without a calibration file, except for image_0 itself.

    Raises:
        DatasetError: ``calibration_malformed``.
    """
    found = _odometry_projection(folder, number)
    T_cam_cam0 = np.eye(4)
    if found is not None:
        path, _, projection = found
        T_cam_cam0[:3, 3] = _place(path, projection)
    return None if found is None and number != "0" else T_cam_cam0


def _odometry_projection(folder: Path, number: str) -> tuple[Path, dict[str, Float64Array], Float64Array] | None:
    """The calibration file, its keys, and P [3, 4] of one camera. Lines are ``P0: ...`` to ``P3:`` and ``Tr:``, or
    unnamed in that order."""
    path = odometry_calibration_file(folder)
    if path is None:
        return None
    named = {f"P{k}": 12 for k in range(4)} | {"Tr": 12}
    unnamed = not any(":" in line.text for line in read_lines(path))
    values = read_calibration(path, named, names=tuple(named) if unnamed else None)
    return path, values, _required(path, values, f"P{number}").reshape(3, 4)


def odometry_calibration_file(folder: Path) -> Path | None:
    """``calib.txt`` or the first other ``calib*.txt`` that is not about the IMU."""
    files = [file for file in sorted(folder.glob("calib*.txt")) if file.name != "calib_imu_to_velo.txt"]
    preferred = folder / "calib.txt"
    return preferred if preferred in files else next(iter(files), None)


class _Calibration:
    """The keys of one camera in ``calib_cam_to_cam.txt``."""

    def __init__(self, path: Path, values: dict[str, Float64Array], number: str) -> None:
        self.path = path
        self.values = values
        self.number = number

    def camera_for(self, size: tuple[int, int]) -> tuple[PinholeCamera, Float64Array]:
        """The camera at its calibrated size and T_cam_cam0, of the kind whose shape the images have."""
        rect_size = self.values.get(f"S_rect_{self.number}", np.array(OFFICIAL_RECT_SIZE))
        raw_size = self.values.get(f"S_{self.number}")
        misfits = {"rectified": _aspect_misfit(size, rect_size)}
        if raw_size is not None:
            misfits["unrectified"] = _aspect_misfit(size, raw_size)
        kind = min(misfits, key=lambda name: misfits[name])
        if misfits[kind] > ASPECT_TOLERANCE:
            raise _malformed(
                self.path,
                f"expected images of the shape of {rect_size[0]:.0f}x{rect_size[1]:.0f} (rectified) or 1392x512 "
                f"(unrectified), found {size[0]}x{size[1]}",
            )
        if kind == "rectified":
            return self._rectified((int(rect_size[0]), int(rect_size[1])))
        assert raw_size is not None
        return self._unrectified((int(raw_size[0]), int(raw_size[1])))

    def _rectified(self, size: tuple[int, int]) -> tuple[PinholeCamera, Float64Array]:
        projection = _required(self.path, self.values, f"P_rect_{self.number}").reshape(3, 4)
        camera, T_cam_rect = _pinhole(self.path, projection, size)
        T_rect_cam0 = np.eye(4)
        T_rect_cam0[:3, :3] = _required(self.path, self.values, "R_rect_00").reshape(3, 3)
        return camera, T_cam_rect @ T_rect_cam0

    def _unrectified(self, size: tuple[int, int]) -> tuple[PinholeCamera, Float64Array]:
        K = _required(self.path, self.values, f"K_{self.number}")
        camera = PinholeCamera(
            fx=float(K[0]),
            fy=float(K[4]),
            cx=float(K[2]),
            cy=float(K[5]),
            width=size[0],
            height=size[1],
            distortion_model="radtan",
            distortion_coeffs=tuple(_required(self.path, self.values, f"D_{self.number}").tolist()),
        )
        T_cam_cam0 = np.eye(4)
        T_cam_cam0[:3, :3] = _required(self.path, self.values, f"R_{self.number}").reshape(3, 3)
        T_cam_cam0[:3, 3] = _required(self.path, self.values, f"T_{self.number}")
        return camera, T_cam_cam0


def _aspect_misfit(size: tuple[int, int], calibrated: Float64Array) -> float:
    if not (calibrated > 0).all():
        return math.inf
    return float(abs(math.log((size[0] / size[1]) / (calibrated[0] / calibrated[1]))))


def _pinhole(path: Path, projection: Float64Array, size: tuple[int, int]) -> tuple[PinholeCamera, Float64Array]:
    """P = K [I | t] -> the camera and T_cam_rect, the translation t in metres."""
    K = projection[:, :3]
    camera = PinholeCamera(
        fx=float(K[0, 0]), fy=float(K[1, 1]), cx=float(K[0, 2]), cy=float(K[1, 2]), width=size[0], height=size[1]
    )
    T_cam_rect = np.eye(4)
    T_cam_rect[:3, 3] = _place(path, projection)
    return camera, T_cam_rect


def _place(path: Path, projection: Float64Array) -> Float64Array:
    """P = K [I | t] -> t [3]."""
    K = projection[:, :3]
    expected = np.array([[K[0, 0], 0.0, K[0, 2]], [0.0, K[1, 1], K[1, 2]], [0.0, 0.0, 1.0]])
    if not np.allclose(K, expected):
        raise _malformed(path, f"expected a projection matrix fx 0 cx, 0 fy cy, 0 0 1, found {K.tolist()}")
    return np.asarray(np.linalg.solve(K, projection[:, 3]))


def _read_imu_to_cam0(files: CalibrationFiles) -> Float64Array | None:
    if not files.velo_to_cam.is_file() or not files.imu_to_velo.is_file():
        return None
    return np.asarray(_read_rigid(files.velo_to_cam) @ _read_rigid(files.imu_to_velo))


def _read_rigid(path: Path) -> Float64Array:
    """``R`` and ``T`` -> [4, 4]."""
    values = read_calibration(path, {"R": 9, "T": 3})
    matrix = np.eye(4)
    matrix[:3, :3] = _required(path, values, "R").reshape(3, 3)
    matrix[:3, 3] = _required(path, values, "T")
    return matrix


def _required(path: Path, values: dict[str, Float64Array], key: str) -> Float64Array:
    if key not in values:
        raise _malformed(path, f"expected the key {key}, found only {', '.join(sorted(values)) or 'other keys'}")
    return values[key]


def _malformed(path: Path, problem: str) -> DatasetError:
    return DatasetError(f"{path}: {problem}", code="calibration_malformed")
