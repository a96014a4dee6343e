"""Values a detection is made from: IMU samples, camera, frames. Numpy only; each validates itself once.

Units are in the names. Time is integer nanoseconds. Images are row-major, (u, v) = (right, down).
``T_a_b`` maps coordinates in frame b to frame a (Kalibr's ``T_cam_imu`` maps IMU to camera).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.errors import InvalidInputError

Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]
Uint8Array = NDArray[np.uint8]

DistortionModel = Literal["none", "radtan", "equidistant"]
DISTORTION_COEFF_COUNTS: dict[str, tuple[int, ...]] = {"none": (0,), "radtan": (4, 5), "equidistant": (4,)}
MIN_IMAGE_SIDE_PX = 32
# Far beyond any real calibration; what is farther only overflows the arithmetic that follows.
MAX_CAMERA_NUMBER = {"fx": 1e6, "fy": 1e6, "cx": 1e6, "cy": 1e6, "time_offset_s": 3600.0, "distortion_coeffs": 1e6}
MIN_FOCAL_LENGTH_PX = 1.0
MAX_IMU_NUMBER = 1e9
# Any two stamps in range differ by less than 2^63, also on the other clock (a time offset is at most an hour). An IMU
# may have run before the clock's zero (odometry counts from its first frame).
MAX_TIMESTAMP_NS = 2**62
MIN_IMU_TIMESTAMP_NS = -(2**61)


def _frozen(array: NDArray[Any]) -> NDArray[Any]:
    """A read-only copy, so that a value cannot change after its validation."""
    copy = np.array(array, copy=True, order="C")
    copy.setflags(write=False)
    return copy


def _vectors(name: str, values: object, count: int) -> Float64Array:
    array = np.asarray(values)
    if array.dtype.kind not in "fiu" or array.ndim != 2 or array.shape != (count, 3):
        raise InvalidInputError(
            f"{name}: expected {count} rows of 3 numbers (one per timestamp), found an array of shape "
            f"{array.shape} and type {array.dtype}",
            code="imu_wrong_shape",
            field=f"imu.{name}",
        )
    if not np.isfinite(array).all():
        row = int(np.flatnonzero(~np.isfinite(array).all(axis=1))[0])
        raise InvalidInputError(
            f"{name}: expected finite numbers, found {array[row].tolist()} in row {row}",
            code="imu_not_finite",
            field=f"imu.{name}",
        )
    if array.size and np.abs(array).max() > MAX_IMU_NUMBER:
        raise InvalidInputError(
            f"{name}: expected SI units, found {np.abs(array).max():g}, which no sensor measures",
            code="imu_out_of_range",
            field=f"imu.{name}",
        )
    return _frozen(array.astype(np.float64))


def _integer_stamps(name: str, values: object) -> Int64Array:
    stamps = np.asarray(values)
    if stamps.ndim != 1 or (stamps.size and stamps.dtype.kind not in "iu"):
        raise InvalidInputError(
            f"{name}: expected a list of integers (nanoseconds), found shape {stamps.shape} of type {stamps.dtype}",
            code="imu_wrong_shape",
            field=f"imu.{name}",
        )
    if not stamps.size:
        raise InvalidInputError(f"{name}: expected at least one IMU sample, found none", code="imu_empty", field="imu")
    lowest, highest = int(stamps.min()), int(stamps.max())
    if lowest < MIN_IMU_TIMESTAMP_NS or highest > MAX_TIMESTAMP_NS:
        raise InvalidInputError(
            f"{name}: expected -2^61 to 2^62 nanoseconds, found {lowest if lowest < MIN_IMU_TIMESTAMP_NS else highest}",
            code="timestamp_out_of_range",
            field=f"imu.{name}",
        )
    return _frozen(stamps.astype(np.int64))


@dataclass(frozen=True, eq=False)
class ImuSamples:
    """Inertial samples in time order.

    Args:
        timestamps_ns: [N] int64, strictly increasing, from -2^61 to 2^62.
        gyro_rad_s: [N, 3] angular rate in the IMU frame.
        accel_m_s2: [N, 3] specific force in the IMU frame (at rest about +9.81 against gravity), or None for
            gyro-only sensors.

    Raises:
        InvalidInputError: ``imu_empty``, ``imu_wrong_shape``, ``imu_not_finite``, ``imu_out_of_range``,
            ``imu_unsorted``, ``imu_duplicate_timestamps``, ``timestamp_out_of_range``.
    """

    timestamps_ns: Int64Array
    gyro_rad_s: Float64Array
    accel_m_s2: Float64Array | None = None

    def __post_init__(self) -> None:
        stamps = _integer_stamps("timestamps_ns", self.timestamps_ns)
        object.__setattr__(self, "timestamps_ns", stamps)
        object.__setattr__(self, "gyro_rad_s", _vectors("gyro_rad_s", self.gyro_rad_s, stamps.size))
        if self.accel_m_s2 is not None:
            object.__setattr__(self, "accel_m_s2", _vectors("accel_m_s2", self.accel_m_s2, stamps.size))
        later = stamps[1:] > stamps[:-1]
        if not later.all():
            index = int(np.flatnonzero(~later)[0])
            earlier, after = int(stamps[index]), int(stamps[index + 1])
            duplicate = earlier == after
            raise InvalidInputError(
                f"timestamps_ns: expected strictly increasing stamps, found {after} after {earlier} "
                f"at index {index + 1}",
                code="imu_duplicate_timestamps" if duplicate else "imu_unsorted",
                field="imu.timestamps_ns",
            )

    def __len__(self) -> int:
        return int(self.timestamps_ns.size)


def _rigid_transform(values: object) -> Float64Array:
    matrix = np.asarray(values, dtype=np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise InvalidInputError(
            f"T_cam_imu: expected a finite 4x4 matrix, found shape {matrix.shape}",
            code="camera_invalid",
            field="camera.T_cam_imu",
        )
    rotation = matrix[:3, :3]
    orthonormal = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3)
    if not orthonormal or np.linalg.det(rotation) < 0 or not np.allclose(matrix[3], (0, 0, 0, 1), atol=1e-9):
        raise InvalidInputError(
            "T_cam_imu: expected a rigid transform (rotation of determinant +1, last row 0 0 0 1), "
            f"found {matrix.tolist()}",
            code="camera_invalid",
            field="camera.T_cam_imu",
        )
    return _frozen(matrix)


@dataclass(frozen=True, eq=False)
class PinholeCamera:
    """Intrinsics, distortion and mounting of one camera.

    Args:
        fx, fy, cx, cy: pixels; pixel centres lie at integer coordinates.
        width, height: image size in pixels.
        distortion_model: ``none``, ``radtan`` (k1 k2 p1 p2 [k3]) or ``equidistant`` (k1..k4).
        distortion_coeffs: as many as the model takes.
        T_cam_imu: [4, 4], maps IMU coordinates to camera coordinates, or None when unknown.
        time_offset_s: t_imu = t_cam + time_offset_s (Kalibr's convention).

    Raises:
        InvalidInputError: ``camera_invalid`` with the field at fault.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion_model: DistortionModel = "none"
    distortion_coeffs: tuple[float, ...] = ()
    T_cam_imu: Float64Array | None = None
    time_offset_s: float = 0.0

    def __post_init__(self) -> None:
        for name in ("fx", "fy", "width", "height"):
            value = getattr(self, name)
            if not math.isfinite(value) or value <= 0:
                raise self._invalid(name, f"expected a positive number, found {value}")
        for name in ("cx", "cy", "time_offset_s"):
            value = getattr(self, name)
            if not math.isfinite(value):
                raise self._invalid(name, f"expected a finite number, found {value}")
        counts = DISTORTION_COEFF_COUNTS.get(self.distortion_model)
        if counts is None:
            known = ", ".join(DISTORTION_COEFF_COUNTS)
            raise self._invalid("distortion_model", f"expected one of {known}, found {self.distortion_model!r}")
        object.__setattr__(self, "distortion_coeffs", tuple(float(c) for c in self.distortion_coeffs))
        finite = all(math.isfinite(c) for c in self.distortion_coeffs)
        if len(self.distortion_coeffs) not in counts or not finite:
            wanted = " or ".join(str(count) for count in counts)
            raise self._invalid(
                "distortion_coeffs",
                f"expected {wanted} finite numbers for {self.distortion_model}, found {self.distortion_coeffs}",
            )
        self._check_plausible()
        if self.T_cam_imu is not None:
            object.__setattr__(self, "T_cam_imu", _rigid_transform(self.T_cam_imu))

    def _check_plausible(self) -> None:
        for name, limit in MAX_CAMERA_NUMBER.items():
            values = self.distortion_coeffs if name == "distortion_coeffs" else (getattr(self, name),)
            if any(abs(value) > limit for value in values):
                raise self._invalid(name, f"expected at most {limit:g} in size, found {getattr(self, name)}")
        for name in ("fx", "fy"):
            if getattr(self, name) < MIN_FOCAL_LENGTH_PX:
                raise self._invalid(
                    name,
                    f"expected a focal length in pixels, at least {MIN_FOCAL_LENGTH_PX:g}, found {getattr(self, name)}",
                )

    @staticmethod
    def _invalid(name: str, problem: str) -> InvalidInputError:
        return InvalidInputError(f"{name}: {problem}", code="camera_invalid", field=f"camera.{name}")

    @property
    def is_distorted(self) -> bool:
        return any(coefficient != 0.0 for coefficient in self.distortion_coeffs)

    @property
    def R_cam_imu(self) -> Float64Array | None:
        """[3, 3] rotation from IMU to camera axes, or None when the mounting is unknown."""
        return None if self.T_cam_imu is None else self.T_cam_imu[:3, :3]

    def scaled_to(self, width: int, height: int) -> PinholeCamera:
        """The same camera after resizing its image to width x height (pixel centres at integer coordinates)."""
        sx, sy = width / self.width, height / self.height
        return PinholeCamera(
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=(self.cx + 0.5) * sx - 0.5,
            cy=(self.cy + 0.5) * sy - 0.5,
            width=width,
            height=height,
            distortion_model=self.distortion_model,
            distortion_coeffs=self.distortion_coeffs,
            T_cam_imu=self.T_cam_imu,
            time_offset_s=self.time_offset_s,
        )


@dataclass(frozen=True, eq=False)
class Frame:
    """One grayscale image: [H, W] uint8, both sides at least 32 px, and its stamp, 0 to 2^62 nanoseconds.

    Raises:
        InvalidInputError: ``image_wrong_type``, ``image_too_small``, ``timestamp_out_of_range``.
    """

    timestamp_ns: int
    image: Uint8Array

    def __post_init__(self) -> None:
        if self.image.dtype != np.uint8 or self.image.ndim != 2:
            raise InvalidInputError(
                f"image: expected a grayscale array [H, W] of uint8, found shape {self.image.shape} "
                f"of {self.image.dtype}",
                code="image_wrong_type",
                field="image",
            )
        height, width = self.image.shape
        if height < MIN_IMAGE_SIDE_PX or width < MIN_IMAGE_SIDE_PX:
            raise InvalidInputError(
                f"image: expected at least {MIN_IMAGE_SIDE_PX}x{MIN_IMAGE_SIDE_PX} px, found {width}x{height}",
                code="image_too_small",
                field="image",
            )
        if not 0 <= self.timestamp_ns <= MAX_TIMESTAMP_NS:
            raise InvalidInputError(
                f"timestamp_ns: expected 0 to 2^62 nanoseconds, found {self.timestamp_ns}",
                code="timestamp_out_of_range",
                field="timestamp_ns",
            )


@dataclass(frozen=True, eq=False)
class FramePair:
    """What one detection needs: source I_i, target I_i+1, the IMU around them and what is known of the camera.

    Args:
        source, target: frames of the same size; the target is later.
        imu: samples around the interval (a model's window may want more than the interval itself).
        camera: calibration of the images as they are here, or None.
        motor_command: [M] the platform's own command or speed, or None.

    Raises:
        InvalidInputError: ``image_sizes_differ``, ``target_not_later``, ``camera_size_mismatch``,
            ``motor_command_invalid``.
    """

    source: Frame
    target: Frame
    imu: ImuSamples
    camera: PinholeCamera | None = None
    motor_command: Float64Array | None = field(default=None)

    def __post_init__(self) -> None:
        if self.source.image.shape != self.target.image.shape:
            (sh, sw), (th, tw) = self.source.image.shape, self.target.image.shape
            raise InvalidInputError(
                f"target: expected the source's size {sw}x{sh}, found {tw}x{th}",
                code="image_sizes_differ",
                field="target",
            )
        if self.target.timestamp_ns <= self.source.timestamp_ns:
            raise InvalidInputError(
                f"target timestamp_ns: expected later than the source's {self.source.timestamp_ns}, "
                f"found {self.target.timestamp_ns}",
                code="target_not_later",
                field="target.timestamp_ns",
            )
        self._check_camera()
        if self.motor_command is not None:
            command = np.asarray(self.motor_command, dtype=np.float64)
            if command.ndim != 1 or not command.size or not np.isfinite(command).all():
                raise InvalidInputError(
                    f"motor_command: expected a list of finite numbers, found {self.motor_command!r}",
                    code="motor_command_invalid",
                    field="motor_command",
                )
            object.__setattr__(self, "motor_command", _frozen(command))

    def _check_camera(self) -> None:
        height, width = self.source.image.shape
        if self.camera is not None and (self.camera.width, self.camera.height) != (width, height):
            raise InvalidInputError(
                f"camera: expected the size of the images, {width}x{height}, "
                f"found {self.camera.width}x{self.camera.height}",
                code="camera_size_mismatch",
                field="camera",
            )

    @property
    def interval_ns(self) -> int:
        return self.target.timestamp_ns - self.source.timestamp_ns
