"""Are wrong units caught where they are certain, and questioned where they are only likely?"""

from __future__ import annotations

import numpy as np
import pytest

from viflow_anomaly.errors import InvalidInputError
from viflow_anomaly.imu_units import check_accelerometer, check_gyroscope, check_spikes


def rows(x: float, y: float, z: float, *, count: int = 11) -> np.ndarray:
    return np.tile([x, y, z], (count, 1)).astype(np.float64)


@pytest.mark.parametrize("accel", [(0, 0, 9.81), (0, 4.0, 0), (157.0, 0, 0), (0, 0, -9.81)])
def test_plausible_accelerometer_has_no_fault(accel: tuple[float, float, float]) -> None:
    assert check_accelerometer(rows(*accel)) == []


@pytest.mark.parametrize("gyro", [(0, 0, 0), (7.9, 0, 0), (-4.0, 4.0, 4.0)])
def test_plausible_gyroscope_has_no_fault(gyro: tuple[float, float, float]) -> None:
    assert check_gyroscope(rows(*gyro)) == []


@pytest.mark.parametrize("sign", [1, -1])
def test_one_impossible_rate_is_deg_s(sign: int) -> None:
    gyro = rows(0, 0, 0.1)
    gyro[4, 1] = sign * 40.5
    with pytest.raises(InvalidInputError, match="deg/s") as caught:
        check_gyroscope(gyro)
    assert (caught.value.code, caught.value.field) == ("imu_gyro_in_deg_s", "imu.gyro_rad_s")


def test_fast_median_rate_is_questioned() -> None:
    (fault,) = check_gyroscope(rows(0, 0, 9.0))
    assert (fault.code, fault.severity) == ("imu_gyro_maybe_deg_s", "lowers_trust")
    assert "9.0 rad/s" in fault.message


def test_one_fast_sample_is_not_questioned() -> None:
    gyro = rows(0, 0, 0.1)
    gyro[0, 0] = 30.0
    assert check_gyroscope(gyro) == []


@pytest.mark.parametrize("norm", [0.71, 1.0, 1.29])
def test_accelerometer_in_g(norm: float) -> None:
    with pytest.raises(InvalidInputError, match="looks like g") as caught:
        check_accelerometer(rows(0, norm, 0))
    assert (caught.value.code, caught.value.field) == ("imu_accel_in_g", "imu.accel_m_s2")


@pytest.mark.parametrize("accel", [(0, 0, 161.0), (981.0, 0, 0)])
def test_accelerometer_out_of_range(accel: tuple[float, float, float]) -> None:
    with pytest.raises(InvalidInputError, match="expected m/s") as caught:
        check_accelerometer(rows(*accel))
    assert caught.value.code == "imu_accel_out_of_range"


def test_zero_accelerometer_cannot_be_judged() -> None:
    (fault,) = check_accelerometer(rows(0, 0, 0))
    assert (fault.code, fault.severity) == ("imu_accel_zero", "abstain")


@pytest.mark.parametrize("norm", [0.3, 2.0])
def test_missing_gravity_lowers_trust(norm: float) -> None:
    (fault,) = check_accelerometer(rows(norm, 0, 0))
    assert (fault.code, fault.severity) == ("imu_no_gravity", "lowers_trust")


@pytest.mark.parametrize("sign", [1, -1])
def test_a_blow_is_counted_and_its_largest_value_named(sign: int) -> None:
    accel = rows(0, 0, 9.81)
    accel[2, 0], accel[7, 1] = sign * 412.0, sign * 158.0
    assert check_accelerometer(accel) == []
    (fault,) = check_spikes(rows(0, 0, 0.1), accel)
    assert (fault.code, fault.severity) == ("imu_spike", "lowers_trust")
    assert "2 of 11 IMU samples" in fault.message
    assert "the accelerometer up to 412 m/s^2" in fault.message
    assert "gyroscope" not in fault.message


@pytest.mark.parametrize("sign", [1, -1])
def test_a_rate_no_gyroscope_measures_is_a_spike(sign: int) -> None:
    gyro = rows(0, 0, 0.1)
    gyro[4, 1] = sign * 36.2
    assert check_gyroscope(gyro) == []
    (fault,) = check_spikes(gyro, rows(0, 0, 9.81))
    assert (fault.code, fault.severity) == ("imu_spike", "lowers_trust")
    assert "1 of 11 IMU samples" in fault.message
    assert "the gyroscope up to 36.2 rad/s" in fault.message
    assert "accelerometer" not in fault.message


def test_spikes_of_both_sensors_are_one_fault() -> None:
    gyro, accel = rows(0, 0, 0.1), rows(0, 0, 9.81)
    gyro[4, 1], accel[4, 2], accel[5, 2] = 36.0, 200.0, 201.0
    (fault,) = check_spikes(gyro, accel)
    assert "2 of 11 IMU samples" in fault.message
    assert "accelerometer up to 201 m/s^2 (16 g are 157), the gyroscope up to 36.0 rad/s" in fault.message


def test_full_scale_is_no_spike() -> None:
    assert check_spikes(rows(35.0, -35.0, 35.0), rows(0, -157.0, 0)) == []
