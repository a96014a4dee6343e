"""Every refusal of the values, one operand at a time."""

from __future__ import annotations

import math
from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest

from viflow_anomaly.errors import InvalidInputError, ViflowError
from viflow_anomaly.sensor_data import Frame, FramePair, ImuSamples, PinholeCamera

GRAY = np.zeros((40, 50), dtype=np.uint8)
ROWS = np.arange(9.0).reshape(3, 3)
STAMPS = np.array([10, 20, 30], dtype=np.int64)
CAMERA = PinholeCamera(fx=60.0, fy=61.0, cx=24.5, cy=19.5, width=50, height=40)
IMU = ImuSamples(STAMPS, ROWS, ROWS)


def code_of(error: pytest.ExceptionInfo[InvalidInputError]) -> tuple[str, str | None]:
    return error.value.code, error.value.field


# -- IMU samples


def test_imu_is_copied_and_read_only() -> None:
    stamps, gyro = STAMPS.copy(), ROWS.copy()
    imu = ImuSamples(stamps, gyro, gyro)
    stamps[0], gyro[0, 0] = 99, 99.0
    assert imu.timestamps_ns[0] == 10
    assert imu.gyro_rad_s[0, 0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        imu.gyro_rad_s[0, 0] = 1.0
    with pytest.raises(FrozenInstanceError):
        imu.timestamps_ns = stamps  # type: ignore[misc]


def test_imu_takes_lists_and_whole_numbers() -> None:
    imu = ImuSamples([1, 2], [[1, 2, 3], [4, 5, 6]])  # type: ignore[arg-type]
    assert len(imu) == 2
    assert imu.timestamps_ns.dtype == np.int64
    assert imu.gyro_rad_s.dtype == np.float64
    assert imu.accel_m_s2 is None


def test_imu_takes_unsigned_stamps_that_fit() -> None:
    top = 2**62
    assert ImuSamples(np.array([1, top], dtype=np.uint64), ROWS[:2]).timestamps_ns[1] == top


def test_imu_may_have_run_before_the_clocks_zero() -> None:
    assert ImuSamples(np.array([-(2**61), -1, 5]), ROWS).timestamps_ns[0] == -(2**61)


def test_no_difference_of_stamps_in_range_wraps() -> None:
    camera = replace(CAMERA, time_offset_s=3600.0)
    imu = ImuSamples(np.array([-(2**61), 2**62]), ROWS[:2])
    source_ns = Frame(2**62, GRAY).timestamp_ns + round(camera.time_offset_s * 1e9)
    assert (imu.timestamps_ns - source_ns).tolist() == [-(2**61) - source_ns, 2**62 - source_ns]
    assert int(np.diff(imu.timestamps_ns)[0]) == 2**62 + 2**61


@pytest.mark.parametrize(
    ("stamps", "code"),
    [
        pytest.param([], "imu_empty", id="empty list"),
        pytest.param(np.zeros(0, np.int64), "imu_empty", id="empty array"),
        pytest.param(np.zeros((3, 1), np.int64), "imu_wrong_shape", id="two dimensions"),
        pytest.param(7, "imu_wrong_shape", id="a number"),
        pytest.param([10.0, 20.0, 30.0], "imu_wrong_shape", id="floats"),
        pytest.param(["1", "2", "3"], "imu_wrong_shape", id="strings"),
        pytest.param([True, False, True], "imu_wrong_shape", id="booleans"),
        pytest.param(np.array([1, 2, 2**63], dtype=np.uint64), "timestamp_out_of_range", id="beyond int64"),
        pytest.param(np.array([1, 2, 2**62 + 1]), "timestamp_out_of_range", id="beyond 2^62"),
        pytest.param(np.array([-(2**61) - 1, 2, 3]), "timestamp_out_of_range", id="before -2^61"),
        pytest.param(np.array([-(2**63), 2, 3]), "timestamp_out_of_range", id="the least of int64"),
        pytest.param([10, 30, 20], "imu_unsorted", id="unsorted"),
        pytest.param([10, 20, 20], "imu_duplicate_timestamps", id="duplicate"),
    ],
)
def test_imu_stamps_refused(stamps: object, code: str) -> None:
    with pytest.raises(InvalidInputError) as caught:
        ImuSamples(stamps, ROWS)  # type: ignore[arg-type]
    assert code_of(caught) == (code, "imu" if code == "imu_empty" else "imu.timestamps_ns")


@pytest.mark.parametrize(("stamps", "found"), [([-(2**63), 0, 2**62 + 1], -(2**63)), ([-1, 0, 2**62 + 1], 2**62 + 1)])
def test_an_imu_stamp_out_of_range_is_named(stamps: list[int], found: int) -> None:
    with pytest.raises(InvalidInputError, match=f"expected -2\\^61 to 2\\^62 nanoseconds, found {found}$"):
        ImuSamples(np.array(stamps), ROWS)


def test_imu_disorder_names_the_index() -> None:
    with pytest.raises(InvalidInputError, match="found 5 after 20 at index 2"):
        ImuSamples([10, 20, 5], ROWS)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["gyro_rad_s", "accel_m_s2"])
@pytest.mark.parametrize(
    ("rows", "code"),
    [
        pytest.param(ROWS[:2], "imu_wrong_shape", id="too few rows"),
        pytest.param(np.zeros((3, 4)), "imu_wrong_shape", id="four columns"),
        pytest.param(np.zeros(9), "imu_wrong_shape", id="one dimension"),
        pytest.param(np.zeros((3, 3), dtype=complex), "imu_wrong_shape", id="complex"),
        pytest.param([["a", "b", "c"]] * 3, "imu_wrong_shape", id="strings"),
        pytest.param(np.full((3, 3), np.nan), "imu_not_finite", id="NaN"),
        pytest.param([[0, 0, 0], [0, math.inf, 0], [0, 0, 0]], "imu_not_finite", id="infinite"),
    ],
)
def test_imu_vectors_refused(name: str, rows: object, code: str) -> None:
    with pytest.raises(InvalidInputError) as caught:
        ImuSamples(STAMPS, **({"gyro_rad_s": ROWS} | {name: rows}))  # type: ignore[arg-type]
    assert code_of(caught) == (code, f"imu.{name}")


def test_imu_not_finite_names_the_row() -> None:
    with pytest.raises(InvalidInputError, match="in row 1"):
        ImuSamples(STAMPS, [[0, 0, 0], [0, math.nan, 0], [math.nan, 0, 0]])  # type: ignore[arg-type]


# -- camera


@pytest.mark.parametrize("name", ["fx", "fy", "width", "height"])
@pytest.mark.parametrize("value", [0, -1, math.nan, math.inf])
def test_camera_needs_positive_numbers(name: str, value: float) -> None:
    with pytest.raises(InvalidInputError) as caught:
        replace(CAMERA, **{name: value})
    assert code_of(caught) == ("camera_invalid", f"camera.{name}")


@pytest.mark.parametrize("name", ["cx", "cy", "time_offset_s"])
@pytest.mark.parametrize("value", [math.nan, -math.inf])
def test_camera_needs_finite_numbers(name: str, value: float) -> None:
    with pytest.raises(InvalidInputError) as caught:
        replace(CAMERA, **{name: value})
    assert code_of(caught) == ("camera_invalid", f"camera.{name}")


def test_camera_distortion_model_unknown() -> None:
    with pytest.raises(InvalidInputError, match="none, radtan, equidistant") as caught:
        replace(CAMERA, distortion_model="fov")  # type: ignore[arg-type]
    assert code_of(caught) == ("camera_invalid", "camera.distortion_model")


@pytest.mark.parametrize(
    ("model", "count", "good"),
    [(model, count, count in counts) for model, counts in
     {"none": (0,), "radtan": (4, 5), "equidistant": (4,)}.items() for count in range(7)],
)  # fmt: skip
def test_camera_coefficient_counts(model: str, count: int, good: bool) -> None:
    if good:
        camera = replace(CAMERA, distortion_model=model, distortion_coeffs=[0.1] * count)  # type: ignore[arg-type]
        assert camera.distortion_coeffs == (0.1,) * count
        assert camera.is_distorted == (count > 0)
        return
    with pytest.raises(InvalidInputError) as caught:
        replace(CAMERA, distortion_model=model, distortion_coeffs=(0.1,) * count)  # type: ignore[arg-type]
    assert code_of(caught) == ("camera_invalid", "camera.distortion_coeffs")


def test_camera_coefficients_must_be_finite() -> None:
    with pytest.raises(InvalidInputError) as caught:
        replace(CAMERA, distortion_model="radtan", distortion_coeffs=(0.1, math.nan, 0.0, 0.0))
    assert code_of(caught) == ("camera_invalid", "camera.distortion_coeffs")


def test_camera_with_zero_coefficients_is_not_distorted() -> None:
    assert not replace(CAMERA, distortion_model="radtan", distortion_coeffs=(0.0,) * 4).is_distorted


def bad_transforms() -> list[object]:
    scaled, mirrored, row, empty = np.eye(4), np.diag((-1.0, 1, 1, 1)), np.eye(4), np.eye(4)
    scaled[0, 0], row[3, 0], empty[0, 3] = 1.1, 0.1, np.nan
    return [np.eye(3), np.zeros((2, 4, 4)), scaled, mirrored, row, empty]


@pytest.mark.parametrize(
    "matrix", bad_transforms(), ids=["3x3", "three dimensions", "scaled", "mirrored", "last row", "NaN"]
)
def test_camera_transform_refused(matrix: np.ndarray) -> None:
    with pytest.raises(InvalidInputError) as caught:
        replace(CAMERA, T_cam_imu=matrix)
    assert code_of(caught) == ("camera_invalid", "camera.T_cam_imu")


def test_camera_rotation() -> None:
    T = np.array([[0, -1.0, 0, 1], [0, 0, -1.0, 2], [1.0, 0, 0, 3], [0, 0, 0, 1]])
    camera = replace(CAMERA, T_cam_imu=T)
    assert CAMERA.R_cam_imu is None
    assert camera.R_cam_imu is not None
    np.testing.assert_array_equal(camera.R_cam_imu, T[:3, :3])
    T[0, 0] = 5.0
    assert camera.T_cam_imu is not None
    assert camera.T_cam_imu[0, 0] == 0.0


def test_camera_scaled_keeps_what_is_not_pixels() -> None:
    full = replace(
        CAMERA,
        distortion_model="radtan",
        distortion_coeffs=(0.1, 0, 0, 0),
        T_cam_imu=np.eye(4),
        time_offset_s=0.02,
    )
    half = full.scaled_to(25, 20)
    assert (half.fx, half.fy, half.width, half.height) == (30.0, 30.5, 25, 20)
    assert (half.cx, half.cy) == (12.0, 9.5)  # the middle of the pixel grid stays the middle
    assert half.distortion_coeffs == full.distortion_coeffs
    assert half.time_offset_s == 0.02
    assert half.T_cam_imu is not None


# -- frames and pairs


@pytest.mark.parametrize(
    "image", [GRAY.astype(np.float32), np.zeros((40, 50, 3), np.uint8), np.zeros(2000, np.uint8)], ids=str
)
def test_frame_needs_gray_bytes(image: np.ndarray) -> None:
    with pytest.raises(InvalidInputError) as caught:
        Frame(1, image)
    assert code_of(caught) == ("image_wrong_type", "image")


@pytest.mark.parametrize("shape", [(31, 40), (40, 31), (1, 1), (0, 0)])
def test_frame_too_small(shape: tuple[int, int]) -> None:
    with pytest.raises(InvalidInputError) as caught:
        Frame(1, np.zeros(shape, np.uint8))
    assert code_of(caught) == ("image_too_small", "image")
    Frame(1, np.zeros((32, 32), np.uint8))


@pytest.mark.parametrize("stamp", [-1, 2**62 + 1, 2**63])
def test_frame_stamp_out_of_range(stamp: int) -> None:
    with pytest.raises(InvalidInputError) as caught:
        Frame(stamp, GRAY)
    assert code_of(caught) == ("timestamp_out_of_range", "timestamp_ns")
    Frame(0, GRAY)
    Frame(2**62, GRAY)


def pair(**changes: object) -> FramePair:
    values: dict[str, object] = {"source": Frame(10, GRAY), "target": Frame(20, GRAY), "imu": IMU}
    return FramePair(**(values | changes))  # type: ignore[arg-type]


def test_pair() -> None:
    good = pair(camera=CAMERA, motor_command=[1, 2.5])
    assert good.interval_ns == 10
    assert good.motor_command is not None
    assert good.motor_command.tolist() == [1.0, 2.5]


@pytest.mark.parametrize("shape", [(41, 50), (40, 51)])
def test_pair_sizes_differ(shape: tuple[int, int]) -> None:
    with pytest.raises(InvalidInputError) as caught:
        pair(target=Frame(20, np.zeros(shape, np.uint8)))
    assert code_of(caught) == ("image_sizes_differ", "target")


@pytest.mark.parametrize("stamp", [10, 9])
def test_pair_target_not_later(stamp: int) -> None:
    with pytest.raises(InvalidInputError) as caught:
        pair(target=Frame(stamp, GRAY))
    assert code_of(caught) == ("target_not_later", "target.timestamp_ns")


@pytest.mark.parametrize("change", [{"width": 51}, {"height": 41}])
def test_pair_camera_of_another_size(change: dict[str, int]) -> None:
    with pytest.raises(InvalidInputError) as caught:
        pair(camera=replace(CAMERA, **change))
    assert code_of(caught) == ("camera_size_mismatch", "camera")


@pytest.mark.parametrize("command", [[], 3.0, [[1.0]], [math.nan], [1.0, math.inf]])
def test_pair_motor_command_invalid(command: object) -> None:
    with pytest.raises(InvalidInputError) as caught:
        pair(motor_command=command)
    assert code_of(caught) == ("motor_command_invalid", "motor_command")


def test_errors_carry_message_and_code() -> None:
    error = ViflowError("what was wrong", code="some_code")
    assert (error.message, str(error), error.code, error.field) == (
        "what was wrong",
        "what was wrong",
        "some_code",
        None,
    )
