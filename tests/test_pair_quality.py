"""What forbids to judge a pair, and what lowers trust: images and corrections with a known fault."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from viflow_anomaly.checkpoint_record import CheckpointRecord
from viflow_anomaly.config import CorrectionConfig, DetectorConfig, ModelConfig, QualityConfig
from viflow_anomaly.correction import Correction, RigidMotion
from viflow_anomaly.detection import Detection, Reason
from viflow_anomaly.detector import AnomalyDetector
from viflow_anomaly.geometry import Float32Array, so3_exp
from viflow_anomaly.imu_units import ImuFault
from viflow_anomaly.measured_flow import MeasuredFlow
from viflow_anomaly.model_input import ModelInput
from viflow_anomaly.motion_input import MotionWindow
from viflow_anomaly.pair_quality import (
    Finding,
    Sharpness,
    clipped_share,
    judge_correction,
    judge_images,
    judge_window,
    reasons_in_order,
    sharpness,
    sharpness_ratio,
)
from viflow_anomaly.prediction import view_rays
from viflow_anomaly.runtime.interface import Hypotheses, Scene
from viflow_anomaly.sensor_data import Frame, FramePair, ImuSamples, PinholeCamera, Uint8Array

HEIGHT, WIDTH, FOCAL_PX = 256, 320, 232.0
SOURCE_NS, INTERVAL_NS = 1_000_000_000, 50_000_000
DEFAULT = DetectorConfig()


def texture(seed: int, *, low: int = 30, high: int = 190) -> Uint8Array:
    """Alike on all scales, as scenes are: enough to measure a flow by, and blur of any size takes something."""
    rng = np.random.default_rng(seed)
    scene = np.zeros((HEIGHT, WIDTH), np.float32)
    for sigma in (0.8, 2, 5, 12):
        layer = cv2.GaussianBlur(rng.random((HEIGHT, WIDTH)).astype(np.float32), (0, 0), sigma)
        scene += (layer - layer.mean()) / layer.std()
    return np.asarray(np.clip((low + high) / 2 + scene / 2 * (high - low) / 4, low, high), dtype=np.uint8)


def developed(image: Uint8Array, gain: float, bias: float = 0.0) -> Uint8Array:
    return np.clip(np.rint(image * float(gain) + float(bias)), 0, 255).astype(np.uint8)


def defocused(image: Uint8Array, sigma: float) -> Uint8Array:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), dtype=np.uint8)


def smeared(image: Uint8Array, *, columns: int = 1, rows: int = 1) -> Uint8Array:
    return np.asarray(cv2.blur(image, (columns, rows)), dtype=np.uint8)


def told(findings: tuple[Finding, ...]) -> dict[str, bool]:
    """code -> whether it abstains."""
    return {finding.reason.code: finding.abstain for finding in findings}


def turning(rate_rad_s: float, interval_s: float = 0.05) -> MotionWindow:
    return MotionWindow(np.zeros((16, 6), np.float32), interval_s, turn_rate_rad_s=rate_rad_s)


def of_images(
    source: Uint8Array, target: Uint8Array, rate: float = 0.5, config: DetectorConfig = DEFAULT
) -> dict[str, bool]:
    return told(judge_images(source, target, turning(rate), config))


class TestSharpness:
    def test_a_ramp_is_the_square_of_the_distances(self) -> None:
        """Neighbours of a ramp differ by 3, pixels eight apart by 24; half a gray level squared is added to both."""
        ramp = np.tile(np.arange(0, 40 * 3, 3, dtype=np.uint8), (40, 1))
        assert sharpness(ramp).x == pytest.approx((9 + 0.25) / (24**2 + 0.25))
        assert sharpness(ramp).y == 1.0
        assert sharpness(ramp.T.copy()) == Sharpness(x=1.0, y=sharpness(ramp).x)

    def test_white_noise_is_as_rough_near_as_far(self) -> None:
        noise = np.random.default_rng(0).integers(0, 256, (256, 256), dtype=np.uint8)
        assert sharpness(noise) == pytest.approx((1.0, 1.0), abs=0.02)

    @pytest.mark.parametrize("factor", [2, 3])
    def test_a_larger_image_of_the_same_is_as_sharp(self, factor: int) -> None:
        image = np.random.default_rng(2).integers(0, 256, (100, 400), dtype=np.uint8)
        enlarged = np.kron(image, np.ones((factor, factor), np.uint8))
        assert sharpness(enlarged) == sharpness(image)

    @pytest.mark.parametrize("shape", [(32, 32), (32, 4000), (4000, 33), (65, 801)])
    def test_any_shape_that_a_frame_may_have(self, shape: tuple[int, int]) -> None:
        noise = np.random.default_rng(1).integers(0, 256, shape, dtype=np.uint8)
        assert 0.5 < sharpness(noise).x < 2
        assert 0.5 < sharpness(noise).y < 2

    @settings(max_examples=25, deadline=None)
    @given(seed=st.integers(0, 1000), gain=st.floats(0.5, 1.4), bias=st.floats(-20, 3))
    def test_a_gain_and_a_bias_change_next_to_nothing(self, seed: int, gain: float, bias: float) -> None:
        image = texture(seed)
        _, ratio = sharpness_ratio(sharpness(image), sharpness(developed(image, gain, bias)))
        assert ratio < 1.1

    @settings(max_examples=25, deadline=None)
    @given(seed=st.integers(0, 1000), less=st.floats(0.5, 2), more=st.floats(0.3, 2))
    def test_the_more_blur_the_less_sharp(self, seed: int, less: float, more: float) -> None:
        image = texture(seed)
        sharp, soft, softer = (sharpness(one) for one in (image, defocused(image, less), defocused(image, less + more)))
        assert sharp.x > soft.x > softer.x
        assert sharp.y > soft.y > softer.y

    def test_motion_blur_takes_its_own_axis(self) -> None:
        image = texture(0)
        along_x, along_y = sharpness(smeared(image, columns=7)), sharpness(smeared(image, rows=7))
        assert along_x.x < 0.5 * along_x.y
        assert along_y.y < 0.5 * along_y.x

    @settings(deadline=None)
    @given(values=st.lists(st.floats(1e-3, 10), min_size=4, max_size=4))
    def test_the_ratio_is_of_the_axis_that_differs_more_and_knows_no_order(self, values: list[float]) -> None:
        one, other = Sharpness(*values[:2]), Sharpness(*values[2:])
        (_, ratio), (_, swapped) = sharpness_ratio(one, other), sharpness_ratio(other, one)
        expected = math.exp(max(abs(math.log(a / b)) for a, b in zip(one, other, strict=True)))
        assert ratio == pytest.approx(expected)
        assert swapped == pytest.approx(expected)

    def test_the_sharper_one_is_named(self) -> None:
        assert sharpness_ratio(Sharpness(0.2, 0.4), Sharpness(0.2, 0.1)) == ("source", pytest.approx(4))
        assert sharpness_ratio(Sharpness(0.2, 0.1), Sharpness(0.6, 0.1)) == ("target", pytest.approx(3))


class TestClippedShare:
    @pytest.mark.parametrize(("level", "share"), [(0, 0.25), (2, 0.25), (3, 0.0), (252, 0.0), (253, 0.25), (255, 0.25)])
    def test_a_quarter_that_is_black_or_white(self, level: int, share: float) -> None:
        image = np.full((64, 64), 128, np.uint8)
        image[:32, :32] = level
        assert clipped_share(image) == share


class TestImages:
    def test_nothing_is_said_of_images_in_order(self) -> None:
        assert of_images(texture(0), np.roll(texture(0), 5, axis=1)) == {}
        assert of_images(texture(0), texture(1)) == {}

    @pytest.mark.parametrize("which", [0, 1])
    def test_a_uniform_image_abstains_and_nothing_else_is_asked(self, which: int) -> None:
        images = [texture(0), np.full((HEIGHT, WIDTH), 250, np.uint8)]
        assert of_images(images[which], images[1 - which]) == {"no_texture": True}

    def test_identical_images_contradict_a_gyro_that_turned(self) -> None:
        image = texture(0)
        assert of_images(image, image.copy(), rate=0.2) == {"frozen_image": True}
        assert of_images(image, image.copy(), rate=0.1) == {}  # at the limit: a bias
        different = image.copy()
        different[0, 0] += 1
        assert of_images(image, different, rate=0.2) == {}

    @pytest.mark.parametrize("bias", [-30, 30])
    def test_a_jump_that_a_bias_explains_is_judged(self, bias: int) -> None:
        assert of_images(texture(0), developed(texture(0), 1, bias)) == {"exposure_jump": False}
        assert of_images(texture(0), developed(texture(0), 1, bias * 0.6)) == {}

    def test_a_jump_that_a_gain_explains_is_judged(self) -> None:
        assert of_images(texture(0), developed(texture(0), 0.6)) == {"exposure_jump": False}

    def test_a_very_large_jump_abstains(self) -> None:
        dark = texture(0, low=10, high=60)
        assert of_images(dark, developed(dark, 1, 115)) == {"exposure_jump": True}
        assert of_images(dark, developed(dark, 1, 105)) == {"exposure_jump": False}

    @pytest.mark.parametrize("swapped", [False, True])
    def test_a_gain_beyond_compensation_abstains(self, swapped: bool) -> None:
        pair = [texture(0), developed(texture(0), 0.35)]
        source, target = pair[::-1] if swapped else pair
        (finding,) = judge_images(source, target, turning(0.5), DEFAULT)
        assert finding.abstain
        assert "contrast changed 2.9 times" in finding.reason.message

    @pytest.mark.parametrize("swapped", [False, True])
    def test_a_jump_into_saturation_abstains(self, swapped: bool) -> None:
        pair = [texture(0), developed(texture(0), 1.3, 110)]
        source, target = pair[::-1] if swapped else pair
        (finding, *_) = judge_images(source, target, turning(0.5), DEFAULT)
        assert (finding.reason.code, finding.abstain) == ("exposure_jump", True)
        assert "black or white" in finding.reason.message

    def test_saturation_without_a_jump_is_how_the_scene_looks(self) -> None:
        burnt = developed(texture(0), 5.0, -420)
        assert clipped_share(burnt) > DEFAULT.quality.max_clipped_share
        assert of_images(burnt, np.roll(burnt, 3, axis=0)) == {}

    @pytest.mark.parametrize("swapped", [False, True])
    def test_blur_of_one_image(self, swapped: bool) -> None:
        for blurred, abstains in ((defocused(texture(0), 1.2), False), (defocused(texture(0), 6.0), True)):
            pair = [texture(0), blurred]
            source, target = pair[::-1] if swapped else pair
            (finding,) = judge_images(source, target, turning(0.5), DEFAULT)
            assert (finding.reason.code, finding.abstain) == ("blur", abstains)
            assert f"found the {'target' if swapped else 'source'} " in finding.reason.message

    def test_motion_blur_of_one_image(self) -> None:
        assert of_images(texture(0), smeared(texture(0), columns=5))["blur"] is False
        assert of_images(texture(0), smeared(texture(0), rows=15)) == {"blur": True}

    def test_a_soft_lens_blurs_both(self) -> None:
        assert of_images(defocused(texture(0), 4), defocused(texture(1), 4)) == {}

    def test_a_camera_that_turned_far_sees_something_else(self) -> None:
        blurred = defocused(texture(0), 6.0)
        assert of_images(texture(0), blurred, rate=5.9) == {"blur": True}
        assert of_images(texture(0), blurred, rate=6.1) == {}

    def test_a_jump_and_blur_are_both_told(self) -> None:
        assert of_images(texture(0), developed(defocused(texture(0), 1.2), 1, 30)) == {
            "exposure_jump": False,
            "blur": False,
        }

    def test_limits_are_settings(self) -> None:
        two = texture(0), developed(defocused(texture(0), 1.2), 1, 30)
        lenient = DetectorConfig(max_exposure_jump_gray=31, quality=QualityConfig(max_blur_ratio=100))
        assert of_images(*two, config=lenient) == {}
        strict = DetectorConfig(quality=QualityConfig(abstain_blur_ratio=1))
        assert of_images(*two, config=strict) == {"exposure_jump": False, "blur": True}
        uniform = np.full((HEIGHT, WIDTH), 9, np.uint8)
        any_texture = DetectorConfig(min_texture_gray=0, max_exposure_jump_gray=5)
        assert of_images(uniform, texture(0), config=any_texture)["exposure_jump"] is True


def test_faults_of_the_window_keep_their_severity() -> None:
    faults = (ImuFault("imu_gap", "a gap", "abstain"), ImuFault("imu_spike", "a spike", "lowers_trust"))
    window = MotionWindow(np.zeros((16, 6), np.float32), 0.05, faults)
    findings = judge_window(window)
    assert told(findings) == {"imu_gap": True, "imu_spike": False}
    assert [finding.reason.message for finding in findings] == ["a gap", "a spike"]


def of_correction(
    *,
    share: float = 0.8,
    turned_rad: float = 0.0,
    confidence: float = 0.4,
    interval_s: float = 0.1,
    flow_only: bool = False,
    config: DetectorConfig = DEFAULT,
) -> dict[str, bool]:
    flow: Float32Array = np.zeros((4, 6, 2), np.float32)
    motion = None if flow_only else RigidMotion(np.eye(3), np.zeros(3))
    correction = Correction(flow, motion, share, 0.0, converged=True, turned_rad=turned_rad)
    measured = MeasuredFlow(flow, np.full((4, 6), confidence, np.float32), 4)
    return told(judge_correction(correction, measured, interval_s, config))


class TestCorrection:
    def test_nothing_is_said_of_a_motion_that_the_images_confirm(self) -> None:
        assert of_correction() == {}
        assert of_correction(turned_rad=0.008, interval_s=0.1) == {}  # EuRoC's bias

    def test_images_that_show_nothing_confirm_nothing(self) -> None:
        assert of_correction(share=0.0, confidence=0.0) == {"motion_unconfirmed": False}
        assert of_correction(share=0.14, confidence=0.19) == {"motion_unconfirmed": False}
        assert of_correction(share=0.15, confidence=0.19) == {}

    def test_well_measured_images_that_agree_with_no_motion_contradict_the_imu(self) -> None:
        assert of_correction(share=0.14) == {"motion_unconfirmed": False, "imu_contradicts_image": False}
        assert of_correction(share=0.09) == {"motion_unconfirmed": False, "imu_contradicts_image": True}

    def test_a_rotation_far_from_the_gyros(self) -> None:
        assert of_correction(turned_rad=0.016) == {"imu_contradicts_image": False}
        assert of_correction(turned_rad=0.049) == {"imu_contradicts_image": False}
        assert of_correction(turned_rad=0.051) == {"imu_contradicts_image": True}

    def test_little_texture_is_not_enough_to_abstain(self) -> None:
        assert of_correction(turned_rad=0.051, confidence=0.19) == {"imu_contradicts_image": False}

    def test_what_counts_is_a_rate(self) -> None:
        assert of_correction(turned_rad=0.016, interval_s=0.2) == {}
        assert of_correction(turned_rad=0.011, interval_s=0.01) == {}  # half a view pixel or so, whatever the rate
        assert of_correction(turned_rad=0.013, interval_s=0.01) == {"imu_contradicts_image": False}

    def test_a_network_without_depth_may_be_wrong_itself(self) -> None:
        assert of_correction(share=0.05, flow_only=True) == {"motion_unconfirmed": False}

    def test_limits_are_settings(self) -> None:
        lenient = QualityConfig(max_turn_error_rad_s=1.0, min_confidence=0.5)
        config = DetectorConfig(quality=lenient, correction=CorrectionConfig(min_inlier_share=0.02))
        assert of_correction(share=0.03, turned_rad=0.09, config=config) == {}


class GyroRuntime:
    """A network that believes the gyro and takes the world for a distant wall."""

    name = "gyro"

    def predict(self, model_input: ModelInput) -> Hypotheses:
        height, width = model_input.source.shape
        rows, columns = height // 4, width // 4
        rate = model_input.window.values[4:, :3].mean(axis=0).astype(np.float64)
        rotation = so3_exp(-rate * model_input.window.interval_s)  # source coordinates -> target coordinates
        x, y = np.moveaxis(view_rays(rows, columns, 4, height, width, 116.0), -1, 0)
        moved = np.stack([x, y, np.ones_like(x)], axis=-1) @ rotation.T
        flow = 116.0 * (moved[..., :2] / moved[..., 2:] - np.stack([x, y], axis=-1))
        scene = Scene(np.ones((rows, columns), np.float32), rotation, np.zeros((1, 3)))
        return Hypotheses(flow[None].astype(np.float32), 4, scene)


def judged(
    source: Uint8Array, target: Uint8Array, gyro: tuple[float, float, float], *, correct: bool = True
) -> Detection:
    stamps = np.arange(SOURCE_NS - 150_000_000, SOURCE_NS + 200_000_001, 5_000_000)
    imu = ImuSamples(stamps, np.tile(gyro, (len(stamps), 1)), np.tile((0.0, -9.81, 0.0), (len(stamps), 1)))
    middle = ((WIDTH - 1) / 2, (HEIGHT - 1) / 2)
    camera = PinholeCamera(FOCAL_PX, FOCAL_PX, *middle, WIDTH, HEIGHT, T_cam_imu=np.eye(4))
    pair = FramePair(Frame(SOURCE_NS, source), Frame(SOURCE_NS + INTERVAL_NS, target), imu, camera)
    record = CheckpointRecord(name="gyro", version="0", sha256="ab" * 32, model=ModelConfig())
    config = DetectorConfig(correction=CorrectionConfig(enabled=correct))
    return AnomalyDetector(GyroRuntime(), record, config=config).detect(pair)


def turned(image: Uint8Array, rate: tuple[float, float, float]) -> Uint8Array:
    rotation = so3_exp(np.array(rate) * INTERVAL_NS * 1e-9)
    matrix = np.array([[FOCAL_PX, 0, (WIDTH - 1) / 2], [0, FOCAL_PX, (HEIGHT - 1) / 2], [0, 0, 1]])
    homography = matrix @ rotation.T @ np.linalg.inv(matrix)
    return np.asarray(
        cv2.warpPerspective(image, homography, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REFLECT), dtype=np.uint8
    )


class TestDetector:
    def codes(self, detection: Detection) -> list[str]:
        return [reason.code for reason in detection.reasons]

    def test_a_gyro_that_is_right_is_not_contradicted(self) -> None:
        rate = (0.2, 0.6, -0.2)
        detection = judged(texture(0), turned(texture(0), rate), rate)
        assert (detection.status, detection.reasons) == ("ok", ())

    def test_a_gyro_of_the_wrong_sign_is(self) -> None:
        """About the optical axis, where no translation looks alike: a little is told, more forbids to judge."""
        for speed, status in ((0.25, "ok"), (0.6, "abstained")):
            detection = judged(texture(0), turned(texture(0), (0.0, 0.0, speed)), (0.0, 0.0, -speed))
            assert (detection.status, self.codes(detection)) == (status, ["imu_contradicts_image"])
            assert not (detection.rois and status == "abstained")

    def test_without_the_correction_nothing_is_known_of_it(self) -> None:
        detection = judged(texture(0), turned(texture(0), (0.0, 0.0, 0.6)), (0.0, 0.0, -0.6), correct=False)
        assert (detection.status, detection.reasons) == ("ok", ())

    def test_a_frozen_camera_is_told_once(self) -> None:
        detection = judged(texture(0), texture(0), (0.0, 0.8, 0.0))
        assert (detection.status, self.codes(detection)) == ("abstained", ["frozen_image"])
        assert judged(texture(0), texture(0), (0.0, 0.05, 0.0)).status == "ok"

    def test_blur_lowers_trust_or_abstains(self) -> None:
        for sigma, status in ((1.8, "ok"), (8.0, "abstained")):
            detection = judged(texture(0), defocused(texture(0), sigma), (0.0, 0.0, 0.0))
            assert (detection.status, self.codes(detection)) == (status, ["blur"])

    def test_a_jump_beyond_compensation_abstains(self) -> None:
        detection = judged(texture(0), developed(texture(0), 0.35), (0.0, 0.0, 0.0))
        assert (detection.status, self.codes(detection)) == ("abstained", ["exposure_jump"])

    def test_what_forbids_to_judge_a_pair_is_told_first(self) -> None:
        brighter = developed(defocused(texture(0), 5.0), 1.1, 30)
        assert of_images(texture(0), brighter) == {"exposure_jump": False, "blur": True}
        detection = judged(texture(0), brighter, (0.0, 0.0, 0.0))
        assert (detection.status, self.codes(detection)) == ("abstained", ["blur", "exposure_jump"])


def test_reasons_keep_their_order_but_for_those_that_decide() -> None:
    decides = (False, True, False, True)
    findings = [Finding(Reason(f"r{k}", "..."), abstain) for k, abstain in enumerate(decides)]
    assert [one.code for one in reasons_in_order(findings)] == ["r1", "r3", "r0", "r2"]
    assert reasons_in_order(()) == ()
