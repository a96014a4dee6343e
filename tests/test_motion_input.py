"""The windows: exact integrals at any rate, the paper's raw rows, and every fault named."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from worlds import REAL_DATA

from viflow_anomaly.config import MotionWindowConfig
from viflow_anomaly.errors import InvalidInputError
from viflow_anomaly.motion_input import MotionWindow, build_motion_window
from viflow_anomaly.sensor_data import Frame, FramePair, ImuSamples, PinholeCamera

SOURCE_NS = 1_403_715_285_262_142_976
SENSOR = MotionWindowConfig(axes="sensor")
EUROC = MotionWindowConfig(axes="sensor", layout="paper_euroc")
KITTI = MotionWindowConfig(axes="sensor", layout="paper_kitti")
IMAGE = np.zeros((32, 32), dtype=np.uint8)

Signal = Callable[[np.ndarray], np.ndarray]


def at_rest(times_s: np.ndarray) -> np.ndarray:
    """[N, 6] constant gyro and gravity."""
    return np.tile([0.1, -0.2, 0.3, 0.5, 0.0, 9.8], (times_s.size, 1))


def swinging(times_s: np.ndarray) -> np.ndarray:
    phases = np.arange(6)
    return 0.5 * np.sin(30.0 * times_s[:, None] + phases) + np.array([0, 0, 0, 0, 0, 9.8])


def make_pair(
    times_s: np.ndarray, signal: Signal = at_rest, *, interval_s: float = 0.05, camera: PinholeCamera | None = None
) -> FramePair:
    """Samples at ``times_s`` after the source frame, on the IMU's clock."""
    stamps = SOURCE_NS + np.round(np.asarray(times_s) * 1e9).astype(np.int64)
    values = signal(np.asarray(times_s))
    return FramePair(
        source=Frame(SOURCE_NS, IMAGE),
        target=Frame(SOURCE_NS + round(interval_s * 1e9), IMAGE),
        imu=ImuSamples(stamps, values[:, :3], values[:, 3:]),
        camera=camera,
    )


def regular(rate_hz: float, start_s: float = -0.3, end_s: float = 0.4) -> np.ndarray:
    """Times on a lattice through the source frame."""
    first, last = round(start_s * rate_hz), round(end_s * rate_hz)
    return np.arange(first, last + 1) / rate_hz


def make_camera(*, T_cam_imu: np.ndarray | None = None, time_offset_s: float = 0.0) -> PinholeCamera:
    return PinholeCamera(30, 30, 16, 16, 32, 32, T_cam_imu=T_cam_imu, time_offset_s=time_offset_s)


def faults_of(window: MotionWindow) -> dict[str, str]:
    return {fault.code: fault.severity for fault in window.faults}


def trapezoid_integral(times_s: np.ndarray, values: np.ndarray, start_s: float, end_s: float) -> np.ndarray:
    """[6] integral of the samples joined by straight lines, with the ends interpolated."""
    inner = times_s[(times_s > start_s) & (times_s < end_s)]
    knots = np.concatenate([[start_s], inner, [end_s]])
    at_knots = np.stack([np.interp(knots, times_s, column) for column in values.T], axis=1)
    return 0.5 * np.diff(knots) @ (at_knots[1:] + at_knots[:-1])


class TestResampled:
    @pytest.mark.parametrize("rate_hz", [10, 20, 97, 200, 400, 1000])
    def test_constant_signal_gives_constant_rows(self, rate_hz: float) -> None:
        window = build_motion_window(make_pair(regular(rate_hz), interval_s=0.1), SENSOR)
        assert window.values.shape == (16, 6)
        assert window.values.dtype == np.float32
        np.testing.assert_allclose(window.values, np.tile(at_rest(np.zeros(1)), (16, 1)), rtol=1e-6)
        assert window.interval_s == pytest.approx(0.1)

    @pytest.mark.parametrize("rate_hz", [10, 33, 200, 1000])
    @pytest.mark.parametrize("interval_s", [0.05, 0.1, 0.2])
    def test_bins_keep_the_integral(self, rate_hz: float, interval_s: float) -> None:
        times_s = regular(rate_hz)
        window = build_motion_window(make_pair(times_s, swinging, interval_s=interval_s), SENSOR)
        before, between = window.values[:4].astype(np.float64), window.values[4:].astype(np.float64)
        expected_before = trapezoid_integral(times_s, swinging(times_s), -0.05, 0.0)
        expected_between = trapezoid_integral(times_s, swinging(times_s), 0.0, interval_s)
        np.testing.assert_allclose(before.sum(axis=0) * 0.05 / 4, expected_before, atol=1e-7)
        np.testing.assert_allclose(between.sum(axis=0) * interval_s / 12, expected_between, atol=1e-7)

    def test_irregular_stamps_keep_the_integral(self) -> None:
        times_s = np.sort(np.random.default_rng(3).uniform(-0.2, 0.3, 150))
        window = build_motion_window(make_pair(times_s, swinging), SENSOR)
        stamped_s = np.round(times_s * 1e9) * 1e-9
        expected = trapezoid_integral(stamped_s, swinging(times_s), 0.0, 0.05)
        np.testing.assert_allclose(window.values[4:].sum(axis=0) * 0.05 / 12, expected, atol=1e-7)

    def test_a_bin_is_the_mean_of_its_own_samples(self) -> None:
        config = MotionWindowConfig(axes="sensor", before_s=0.02, samples_before=1, samples_between=5)
        window = build_motion_window(make_pair(regular(100), lambda t: np.tile(t[:, None], (1, 6)) + 5.0), config)
        np.testing.assert_allclose(window.values[:, 0] - 5.0, [-0.01, 0.005, 0.015, 0.025, 0.035, 0.045], atol=1e-6)

    def test_the_turn_rate_is_the_norm_of_the_mean_rate_between_the_frames(self) -> None:
        times_s = regular(200)
        window = build_motion_window(make_pair(times_s, swinging), SENSOR)
        mean = trapezoid_integral(times_s, swinging(times_s), 0.0, 0.05)[:3] / 0.05
        assert window.turn_rate_rad_s == pytest.approx(float(np.linalg.norm(mean)), rel=1e-6)

    def test_samples_far_from_the_window_change_nothing(self) -> None:
        few = build_motion_window(make_pair(regular(200, -0.06, 0.06), swinging), SENSOR)
        many = build_motion_window(make_pair(regular(200, -5.0, 5.0), swinging), SENSOR)
        np.testing.assert_array_equal(few.values, many.values)

    def test_values_cannot_be_changed(self) -> None:
        window = build_motion_window(make_pair(regular(200)), SENSOR)
        with pytest.raises(ValueError, match="read-only"):
            window.values[0, 0] = 1.0


class TestClockAndAxes:
    def test_time_offset_moves_the_window_on_the_imu_clock(self) -> None:
        offset_s = 0.012
        delayed = build_motion_window(
            make_pair(regular(200) + offset_s, swinging, camera=make_camera(time_offset_s=offset_s)), SENSOR
        )
        plain = build_motion_window(make_pair(regular(200), lambda t: swinging(t + offset_s)), SENSOR)
        np.testing.assert_allclose(delayed.values, plain.values, atol=1e-6)

    def test_vectors_are_rotated_into_camera_axes(self) -> None:
        T_cam_imu = np.array([[0, -1.0, 0, 0.1], [0, 0, -1.0, 0], [1.0, 0, 0, 0], [0, 0, 0, 1.0]])
        pair = make_pair(regular(200), camera=make_camera(T_cam_imu=T_cam_imu))
        window = build_motion_window(pair, MotionWindowConfig(axes="camera"))
        np.testing.assert_allclose(window.values[7], [0.2, -0.3, 0.1, 0.0, -9.8, 0.5], rtol=1e-6)
        assert window.faults == ()

    @pytest.mark.parametrize("camera", [None, make_camera()])
    def test_unknown_mounting_leaves_the_axes_and_says_so(self, camera: PinholeCamera | None) -> None:
        window = build_motion_window(make_pair(regular(200), camera=camera), MotionWindowConfig(axes="camera"))
        assert faults_of(window) == {"mounting_unknown": "lowers_trust"}
        np.testing.assert_allclose(window.values[7], [0.1, -0.2, 0.3, 0.5, 0.0, 9.8], rtol=1e-6)

    def test_sensor_axes_need_no_mounting(self) -> None:
        assert build_motion_window(make_pair(regular(200)), SENSOR).faults == ()


class TestPaperLayouts:
    @pytest.mark.parametrize("look_ahead", [1, 2, 3, 4])
    def test_euroc_rows_are_the_raw_samples_and_zero_beyond(self, look_ahead: int) -> None:
        times_s = regular(200)
        window = build_motion_window(make_pair(times_s, swinging, interval_s=0.05 * look_ahead), EUROC)
        filled = 10 + 10 * look_ahead
        first = int(np.flatnonzero(np.isclose(times_s, -0.05))[0])
        assert window.values.shape == (50, 6)
        np.testing.assert_allclose(window.values[:filled], swinging(times_s)[first : first + filled], rtol=1e-6)
        assert not window.values[filled:].any()

    def test_the_sample_at_the_source_frame_opens_the_block_after_it(self) -> None:
        window = build_motion_window(make_pair(regular(200), lambda t: np.tile(t[:, None], (1, 6)) + 5.0), EUROC)
        assert window.values[9, 0] == pytest.approx(4.995)
        assert window.values[10, 0] == pytest.approx(5.0)

    def test_kitti_rows(self) -> None:
        times_s = regular(100)
        window = build_motion_window(make_pair(times_s, swinging, interval_s=0.1), KITTI)
        first = int(np.flatnonzero(np.isclose(times_s, -0.1))[0])
        assert window.values.shape == (20, 6)
        np.testing.assert_allclose(window.values, swinging(times_s)[first : first + 20], rtol=1e-6)

    @pytest.mark.parametrize("seed", range(5))
    @pytest.mark.parametrize(("config", "rate_hz", "interval_s"), [(EUROC, 200, 0.1), (KITTI, 100, 0.1)])
    def test_a_millisecond_of_jitter_changes_no_row(
        self, config: MotionWindowConfig, rate_hz: float, interval_s: float, seed: int
    ) -> None:
        times_s = regular(rate_hz)
        values = swinging(times_s)
        jitter_s = np.random.default_rng(seed).uniform(-0.00099, 0.00099, times_s.size)
        exact = build_motion_window(make_pair(times_s, lambda _: values, interval_s=interval_s), config)
        jittered = build_motion_window(make_pair(times_s + jitter_s, lambda _: values, interval_s=interval_s), config)
        np.testing.assert_array_equal(jittered.values, exact.values)

    @pytest.mark.parametrize("rate_hz", [93, 97, 102, 108])
    def test_an_imu_that_is_not_quite_as_fast_as_the_paper_says(self, rate_hz: float) -> None:
        times_s = regular(rate_hz)
        window = build_motion_window(make_pair(times_s, swinging, interval_s=10 / rate_hz), KITTI)
        first = int(np.flatnonzero(times_s > -1e-3)[0]) - 10
        np.testing.assert_allclose(window.values, swinging(times_s)[first : first + 20], rtol=1e-6)

    @pytest.mark.parametrize("missing_s", [-0.03, 0.0, 0.02])
    def test_a_missing_sample_is_named(self, missing_s: float) -> None:
        times_s = regular(200)
        times_s = times_s[~np.isclose(times_s, missing_s)]
        with pytest.raises(InvalidInputError, match=r"expected 10 samples in the 50 ms .* found 9") as caught:
            build_motion_window(make_pair(times_s), EUROC)
        assert (caught.value.code, caught.value.field) == ("imu_window_count", "imu.timestamps_ns")

    def test_an_extra_sample_is_named(self) -> None:
        times_s = np.sort(np.append(regular(200), 0.0225))
        with pytest.raises(InvalidInputError, match=r"begin \+0 ms .* found 11"):
            build_motion_window(make_pair(times_s), EUROC)

    def test_nothing_is_filled_at_the_start_of_a_recording(self) -> None:
        with pytest.raises(InvalidInputError, match=r"begin -50 ms .* found 0"):
            build_motion_window(make_pair(regular(200, start_s=0.0)), EUROC)

    @pytest.mark.parametrize(
        ("config", "interval_s"), [(EUROC, 0.02), (EUROC, 0.25), (EUROC, 0.075), (KITTI, 0.2), (KITTI, 0.06)]
    )
    def test_an_interval_the_layout_does_not_know(self, config: MotionWindowConfig, interval_s: float) -> None:
        with pytest.raises(InvalidInputError, match="ms apart") as caught:
            build_motion_window(make_pair(regular(200), interval_s=interval_s), config)
        assert (caught.value.code, caught.value.field) == ("imu_window_interval", "target.timestamp_ns")


class TestCoverage:
    @pytest.mark.parametrize(
        "times_s",
        [
            regular(200, start_s=0.02),
            regular(200, end_s=0.03),
            np.array([0.0]),
            np.array([0.02]),
            regular(200, -3.0, -1.0),
            regular(200, 1.0, 3.0),
        ],
        ids=["starts late", "ends early", "one sample", "one sample inside", "all before", "all after"],
    )
    def test_uncovered_interval(self, times_s: np.ndarray) -> None:
        with pytest.raises(InvalidInputError, match="expected samples from the source frame") as caught:
            build_motion_window(make_pair(times_s), SENSOR)
        assert (caught.value.code, caught.value.field) == ("imu_not_covering", "imu.timestamps_ns")

    def test_a_period_and_a_half_may_be_missing_at_each_end(self) -> None:
        window = build_motion_window(make_pair(regular(200, -0.06, 0.045)), SENSOR)
        assert window.faults == ()

    def test_one_sample_a_frame_at_the_frames_is_covered(self) -> None:
        window = build_motion_window(make_pair(regular(10, -0.5, 0.5), interval_s=0.1), SENSOR)
        assert faults_of(window) == {"imu_rate_low": "lowers_trust"}

    def test_two_samples_at_the_frames_are_covered_but_the_time_before_is_not(self) -> None:
        window = build_motion_window(make_pair(np.array([0.0, 0.1]), swinging, interval_s=0.1), SENSOR)
        assert faults_of(window) == {"imu_rate_low": "lowers_trust", "imu_window_incomplete": "lowers_trust"}
        np.testing.assert_allclose(window.values[:4], np.tile(swinging(np.zeros(1)), (4, 1)), rtol=1e-6)

    def test_a_partly_covered_window_before_is_reported(self) -> None:
        window = build_motion_window(make_pair(regular(200, start_s=-0.02)), SENSOR)
        assert faults_of(window) == {"imu_window_incomplete": "lowers_trust"}
        assert "first 30 ms" in window.faults[0].message

    def test_missing_accelerometer(self) -> None:
        pair = make_pair(regular(200))
        gyro_only = FramePair(pair.source, pair.target, ImuSamples(pair.imu.timestamps_ns, pair.imu.gyro_rad_s))
        with pytest.raises(InvalidInputError, match="accelerometer") as caught:
            build_motion_window(gyro_only, SENSOR)
        assert (caught.value.code, caught.value.field) == ("imu_accel_missing", "imu.accel_m_s2")


class TestFaults:
    @pytest.mark.parametrize(
        ("gap_s", "severity"),
        [((0.012, 0.033), "lowers_trust"), ((0.006, 0.044), "abstain"), ((-0.041, -0.009), "lowers_trust")],
        ids=["a third of the interval", "most of the interval", "before the source"],
    )
    def test_gap(self, gap_s: tuple[float, float], severity: str) -> None:
        times_s = regular(200)
        times_s = times_s[(times_s < gap_s[0]) | (times_s > gap_s[1])]
        assert faults_of(build_motion_window(make_pair(times_s), SENSOR))["imu_gap"] == severity

    def test_a_gap_outside_the_window_is_no_fault(self) -> None:
        times_s = regular(200)
        times_s = times_s[(times_s < 0.06) | (times_s > 0.2)]
        assert build_motion_window(make_pair(times_s), SENSOR).faults == ()

    def test_a_short_dropout_is_no_gap(self) -> None:
        times_s = regular(1000)
        times_s = times_s[(times_s < 0.011) | (times_s > 0.023)]
        assert build_motion_window(make_pair(times_s), SENSOR).faults == ()

    def test_two_samples_far_around_the_frames_observe_nothing(self) -> None:
        window = build_motion_window(make_pair(np.array([-1.0, 1.0])), SENSOR)
        assert faults_of(window) == {"imu_rate_low": "lowers_trust", "imu_gap": "abstain"}

    def test_low_rate(self) -> None:
        assert faults_of(build_motion_window(make_pair(regular(50)), SENSOR)) == {"imu_rate_low": "lowers_trust"}

    def test_long_interval(self) -> None:
        window = build_motion_window(make_pair(regular(200, -0.1, 1.3), interval_s=1.2), SENSOR)
        assert faults_of(window) == {"interval_too_long": "abstain"}
        assert "1.20 s apart" in window.faults[0].message

    def test_unit_faults_reach_the_window(self) -> None:
        window = build_motion_window(
            make_pair(regular(200), lambda t: np.tile([9.0, 0, 0, 0, 0, 0], (t.size, 1))), SENSOR
        )
        assert faults_of(window) == {"imu_gyro_maybe_deg_s": "lowers_trust", "imu_accel_zero": "abstain"}

    @pytest.mark.parametrize(("at_s", "column", "value"), [(0.02, 4, -400.0), (-0.03, 1, 38.0)])
    def test_a_spike_in_the_window_is_reported_and_left_in_it(self, at_s: float, column: int, value: float) -> None:
        def struck(times_s: np.ndarray) -> np.ndarray:
            values = at_rest(times_s)
            values[np.isclose(times_s, at_s), column] = value
            return values

        window = build_motion_window(make_pair(regular(200), struck), SENSOR)
        assert faults_of(window) == {"imu_spike": "lowers_trust"}
        assert np.abs(window.values[:, column]).max() > 0.1 * abs(value)

    def test_a_spike_outside_the_window_is_no_fault(self) -> None:
        def struck(times_s: np.ndarray) -> np.ndarray:
            values = at_rest(times_s)
            values[np.isclose(times_s, 0.1), 4] = -400.0
            return values

        assert build_motion_window(make_pair(regular(200), struck), SENSOR).faults == ()

    @pytest.mark.parametrize(
        ("row", "code"),
        [([0, 0, 0, 0, 0, 1.0], "imu_accel_in_g"), ([50.0, 0, 0, 0, 0, 9.8], "imu_gyro_in_deg_s")],
    )
    def test_unit_errors_reach_the_caller(self, row: list[float], code: str) -> None:
        with pytest.raises(InvalidInputError) as caught:
            build_motion_window(make_pair(regular(200), lambda t: np.tile(row, (t.size, 1))), SENSOR)
        assert caught.value.code == code


@pytest.mark.skipif(not (REAL_DATA / "euroc").is_dir(), reason="no real recordings: set VIFLOW_REAL_DATA")
@pytest.mark.parametrize("look_ahead", [1, 4])
@pytest.mark.parametrize("config", [SENSOR, EUROC])
def test_every_euroc_pair_fills_its_window(config: MotionWindowConfig, look_ahead: int) -> None:
    mav = REAL_DATA / "euroc" / "V1_01_easy" / "mav0"
    lines = (mav / "imu0" / "data.csv").read_text().splitlines()[1:]
    stamps = np.array([int(line.split(",")[0]) for line in lines])
    values = np.array([[float(cell) for cell in line.split(",")[1:7]] for line in lines])
    frames = [int(line.split(",")[0]) for line in (mav / "cam0" / "data.csv").read_text().splitlines()[1:]]
    imu = ImuSamples(stamps, values[:, :3], values[:, 3:])
    for source_ns, target_ns in zip(frames, frames[look_ahead:], strict=False):
        window = build_motion_window(FramePair(Frame(source_ns, IMAGE), Frame(target_ns, IMAGE), imu), config)
        assert window.faults == ()
        expected_rows = 10 + 10 * look_ahead if config is EUROC else config.rows
        assert np.count_nonzero(window.values.any(axis=1)) == expected_rows


def test_a_gyro_alone_is_taken_where_it_may_be() -> None:
    whole = make_pair(regular(200.0))
    alone = replace(whole, imu=ImuSamples(whole.imu.timestamps_ns, whole.imu.gyro_rad_s))
    config = MotionWindowConfig()
    window, known = build_motion_window(alone, config, gyro_alone=True), build_motion_window(whole, config)
    np.testing.assert_array_equal(window.values[:, :3], known.values[:, :3])
    np.testing.assert_array_equal(window.values[:, 3:], np.tile(np.float32([0, -9.81, 0]), (config.rows, 1)))
    assert [fault.code for fault in window.faults if fault not in known.faults] == ["no_accelerometer"]
    np.testing.assert_array_equal(build_motion_window(whole, config, gyro_alone=True).values, known.values)
    for refused in (config, config.model_copy(update={"axes": "sensor"})):
        with pytest.raises(InvalidInputError) as caught:
            build_motion_window(alone, refused, gyro_alone=refused.axes == "sensor")
        assert caught.value.code == "imu_accel_missing"
