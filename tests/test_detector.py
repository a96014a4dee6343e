"""The inference path on worlds with a closed form: a turning camera, and a patch that moves on its own."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2
import jsonschema
import numpy as np
import pytest
import torch

from viflow_anomaly.checkpoint import load_checkpoint, save_checkpoint
from viflow_anomaly.config import CorrectionConfig, DetectorConfig, ModelConfig, ViewConfig
from viflow_anomaly.detection import load_detection_schema, to_json, to_json_dict
from viflow_anomaly.detector import AnomalyDetector
from viflow_anomaly.errors import ConfigError, InvalidInputError
from viflow_anomaly.geometry import so3_exp
from viflow_anomaly.model.builder import build_model
from viflow_anomaly.model.compact import CompactViflow
from viflow_anomaly.sensor_data import Frame, FramePair, ImuSamples, PinholeCamera, Uint8Array

WIDTH, HEIGHT, FOCAL_PX = 320, 256, 232.0
INTERVAL_NS = 50_000_000
SOURCE_NS = 1_000_000_000
COMPACT = ModelConfig(preset="compact")
PATCH = (slice(90, 140), slice(180, 230))  # rows, columns


def texture(seed: int, height: int = HEIGHT, width: int = WIDTH) -> Uint8Array:
    noise = np.random.default_rng(seed).random((height, width)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.5)
    return np.asarray(cv2.normalize(smooth, None, 20, 235, cv2.NORM_MINMAX), dtype=np.uint8)


def imu(rate_rad_s: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> ImuSamples:
    stamps = np.arange(SOURCE_NS - 150_000_000, SOURCE_NS + 200_000_001, 5_000_000)
    return ImuSamples(stamps, np.tile(rate_rad_s, (len(stamps), 1)), np.tile((0.0, -9.81, 0.0), (len(stamps), 1)))


def camera() -> PinholeCamera:
    center = ((WIDTH - 1) / 2, (HEIGHT - 1) / 2)
    return PinholeCamera(FOCAL_PX, FOCAL_PX, *center, WIDTH, HEIGHT, T_cam_imu=np.eye(4))


def pair(source: Uint8Array, target: Uint8Array, *, rate: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> FramePair:
    calibration = camera() if source.shape == (HEIGHT, WIDTH) else None
    return FramePair(Frame(SOURCE_NS, source), Frame(SOURCE_NS + INTERVAL_NS, target), imu(rate), calibration)


def turned(image: Uint8Array, rate: tuple[float, float, float]) -> Uint8Array:
    """What the camera sees after turning at ``rate`` for one frame interval (all of the world far away)."""
    rotation = so3_exp(np.array(rate) * INTERVAL_NS * 1e-9)
    matrix = np.array([[FOCAL_PX, 0, (WIDTH - 1) / 2], [0, FOCAL_PX, (HEIGHT - 1) / 2], [0, 0, 1]])
    homography = matrix @ rotation.T @ np.linalg.inv(matrix)
    return np.asarray(
        cv2.warpPerspective(image, homography, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REFLECT), dtype=np.uint8
    )


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A network that predicts the gyro's rotation and nothing else: its learned heads are zero."""
    network = build_model(COMPACT)
    assert isinstance(network, CompactViflow)
    with torch.no_grad():
        for head in (network.global_head, network.local_head):
            head.weight.zero_()
    path = tmp_path_factory.mktemp("weights") / "rotation.safetensors"
    return save_checkpoint(path, network, COMPACT, name="rotation", version="0")


@pytest.fixture(scope="module")
def detector(checkpoint: Path) -> AnomalyDetector:
    return AnomalyDetector.from_checkpoint(checkpoint)


def with_moved_patch(source: Uint8Array, target: Uint8Array) -> tuple[Uint8Array, Uint8Array]:
    """The patch shows another texture, eight pixels further to the right in the target."""
    source, target, patch = source.copy(), target.copy(), texture(99, 50, 58)
    source[PATCH] = patch[:, 8:]
    target[PATCH] = patch[:, :50]
    return source, target


def test_nothing_moves_and_nothing_is_found(detector: AnomalyDetector) -> None:
    still = texture(1)
    detection = detector.detect(pair(still, still))
    assert detection.status == "ok"
    assert detection.rois == ()
    assert detection.reasons == ()
    assert detection.residual is not None
    assert detection.residual.p95 < 1.0


@pytest.mark.parametrize("rate", [(0.0, 1.2, 0.0), (-0.9, 0.0, 0.0), (0.0, 0.0, 1.5), (0.5, -0.8, 0.7)])
def test_a_turning_camera_alone_is_no_motion(detector: AnomalyDetector, rate: tuple[float, float, float]) -> None:
    source = texture(2)
    still = detector.detect(pair(source, turned(source, rate), rate=rate))
    feed_forward = detector.with_config(DetectorConfig(correction=CorrectionConfig(enabled=False)))
    unaware = feed_forward.detect(pair(source, turned(source, rate)))
    assert still.residual is not None
    assert unaware.residual is not None
    assert still.residual.median < 3.0
    assert unaware.residual.median > 4 * still.residual.median
    assert not [roi for roi in still.rois if roi.label == "independent_motion"]


def test_what_the_gyro_missed_is_corrected_on_the_target_image(detector: AnomalyDetector) -> None:
    source = texture(2)
    missed = pair(source, turned(source, (0.0, 0.3, 0.1)))
    corrected = detector.detect(missed)
    believed = detector.with_config(DetectorConfig(correction=CorrectionConfig(enabled=False))).detect(missed)
    assert corrected.residual is not None
    assert believed.residual is not None
    assert corrected.residual.median < 0.3 * believed.residual.median
    assert not [roi for roi in corrected.rois if roi.label == "independent_motion"]


@pytest.mark.parametrize("rate", [(0.0, 0.0, 0.0), (0.3, 0.8, -0.5)])
def test_a_patch_that_moves_on_its_own_is_found_where_it_is(
    detector: AnomalyDetector, rate: tuple[float, float, float]
) -> None:
    source, target = with_moved_patch(texture(3), turned(texture(3), rate))
    rois = detector.detect(pair(source, target, rate=rate)).rois
    assert rois
    assert rois[0].label == "independent_motion"
    moving = [roi for roi in rois if roi.label == "independent_motion"]
    left = min(roi.bbox.x for roi in moving)
    right = max(roi.bbox.x + roi.bbox.width for roi in moving)
    top = min(roi.bbox.y for roi in moving)
    bottom = max(roi.bbox.y + roi.bbox.height for roi in moving)
    assert 150 <= left <= 200
    assert 210 <= right <= 260
    assert 60 <= top <= 110
    assert 120 <= bottom <= 170


def test_the_evidence_says_where_the_static_world_goes(detector: AnomalyDetector) -> None:
    rate = (0.3, 0.8, -0.5)
    source, target = with_moved_patch(texture(3), turned(texture(3), rate))
    analysis = detector.analyze(pair(source, target, rate=rate))
    (roi, *_) = analysis.detection.rois
    u, v = (int(middle) for middle in roi.bbox.middle_px)
    told = [roi.evidence["static_flow_u_px"], roi.evidence["static_flow_v_px"]]
    assert told == pytest.approx(analysis.flow_px[v, u].tolist(), abs=0.005)
    ray = so3_exp(np.array(rate) * INTERVAL_NS * 1e-9).T @ (
        (u - (WIDTH - 1) / 2) / FOCAL_PX,
        (v - (HEIGHT - 1) / 2) / FOCAL_PX,
        1.0,
    )
    landed = FOCAL_PX * ray[:2] / ray[2] + ((WIDTH - 1) / 2, (HEIGHT - 1) / 2)
    assert told == pytest.approx((landed - (u, v)).tolist(), abs=0.3)


def test_the_same_input_gives_the_same_bytes(detector: AnomalyDetector) -> None:
    source, target = with_moved_patch(texture(4), texture(4))
    first, second = (replace(detector.detect(pair(source, target)), timings_ms={}) for _ in range(2))
    assert to_json(first) == to_json(second)


def test_threads_share_a_detector_and_get_the_serial_answers(detector: AnomalyDetector) -> None:
    pairs = [pair(*with_moved_patch(texture(seed), texture(seed))) for seed in range(6)]
    serial = [to_json(replace(detector.detect(one), timings_ms={})) for one in pairs]
    with ThreadPoolExecutor(4) as pool:
        threaded = [to_json(replace(one, timings_ms={})) for one in pool.map(detector.detect, pairs * 2)]
    assert threaded == serial * 2


def test_every_answer_follows_the_shipped_schema(detector: AnomalyDetector) -> None:
    schema = load_detection_schema()
    still = texture(5)
    uniform = np.full_like(still, 128)
    for source, target in (with_moved_patch(still, still), (still, still), (uniform, uniform)):
        answer = to_json_dict(detector.detect(pair(source, target)))
        jsonschema.validate(json.loads(json.dumps(answer)), schema)


def test_a_uniform_image_cannot_be_judged(detector: AnomalyDetector) -> None:
    detection = detector.detect(pair(np.full((HEIGHT, WIDTH), 90, np.uint8), texture(6)))
    assert detection.status == "abstained"
    assert [reason.code for reason in detection.reasons] == ["no_texture"]
    assert detection.rois == ()


def test_a_jump_of_exposure_lowers_trust(detector: AnomalyDetector) -> None:
    source = (texture(7) // 3).astype(np.uint8)
    detection = detector.detect(pair(source, (source + 100).astype(np.uint8)))
    assert "exposure_jump" in [reason.code for reason in detection.reasons]
    assert detection.status == "ok"


def test_images_that_share_nothing_cannot_be_judged(detector: AnomalyDetector) -> None:
    detection = detector.detect(pair(texture(8), texture(9), rate=(0.0, 34.0, 0.0)))
    assert detection.status == "abstained"
    assert "no_overlap" in [reason.code for reason in detection.reasons]


def test_a_small_overlap_is_judged_only_where_it_is_allowed(detector: AnomalyDetector) -> None:
    """0.7 radians of turn leave about a third of the picture."""
    far = pair(texture(8), turned(texture(8), (0.0, 14.0, 0.0)), rate=(0.0, 14.0, 0.0))
    assert detector.detect(far).status == "ok"
    strict = detector.with_config(DetectorConfig(min_overlap=0.5)).detect(far)
    assert strict.status == "abstained"
    assert "no_overlap" in [reason.code for reason in strict.reasons]


def test_images_that_confirm_no_motion_lower_trust(detector: AnomalyDetector) -> None:
    """Two pictures that have nothing to do with each other, and a slope of gray on which nothing can be measured."""
    slope = np.tile(np.linspace(40, 200, WIDTH), (HEIGHT, 1)).astype(np.uint8)
    for source, target, found in ((texture(20), texture(21), "agree"), (slope, slope, "too little texture")):
        reasons = {reason.code: reason.message for reason in detector.detect(pair(source, target)).reasons}
        assert found in reasons["motion_unconfirmed"]
    feed_forward = detector.with_config(DetectorConfig(correction=CorrectionConfig(enabled=False)))
    assert feed_forward.detect(pair(texture(20), texture(21))).reasons == ()


@pytest.mark.parametrize(("height", "width"), [(65, 65), (225, 224), (33, 500), (376, 1241)])
def test_any_size_of_image_is_answered_in_its_own_pixels(detector: AnomalyDetector, height: int, width: int) -> None:
    image = texture(10, height, width)
    analysis = detector.analyze(pair(image, image))
    detection = analysis.detection
    assert (detection.image.width, detection.image.height) == (width, height)
    assert analysis.residual.shape == analysis.flow_px.shape[:2] == (height, width)
    assert detection.region_analyzed.width <= width
    assert "mounting_unknown" in [reason.code for reason in detection.reasons]


def test_masks_come_on_request_only(detector: AnomalyDetector) -> None:
    moved = pair(*with_moved_patch(texture(11), texture(11)))
    asked = detector.with_config(DetectorConfig(include_masks=True)).detect(moved)
    assert asked.rois[0].mask_rle is not None
    assert detector.detect(moved).rois[0].mask_rle is None


def test_the_papers_crop_is_an_option(tmp_path: Path) -> None:
    config = ModelConfig(view=ViewConfig(mode="center_crop"))
    path = save_checkpoint(tmp_path / "crop.safetensors", build_model(config), config, name="crop", version="0")
    cropped = AnomalyDetector.from_checkpoint(path)
    still = texture(12)
    region = cropped.detect(pair(still, still)).region_analyzed
    assert (region.x, region.y, region.width, region.height) == (48, 16, 224, 224)
    small = texture(13, 100, 100)
    with pytest.raises(InvalidInputError) as caught:
        cropped.detect(pair(small, small))
    assert caught.value.code == "image_smaller_than_crop"


def test_a_crop_is_corrected_at_the_cameras_focal_length(tmp_path: Path) -> None:
    """The crop is not resampled: its focal length is the camera's (232 px), not the view's of other models (116)."""
    config = ModelConfig(preset="compact", view=ViewConfig(mode="center_crop"))
    network = build_model(config)
    assert isinstance(network, CompactViflow)
    with torch.no_grad():
        for part in (network.global_head, network.local_head, network.mounting):
            part.weight.zero_()
    path = save_checkpoint(tmp_path / "crop.safetensors", network, config, name="crop", version="0")
    rate = (0.15, 0.25, -0.1)
    analysis = AnomalyDetector.from_checkpoint(path).analyze(pair(texture(2), turned(texture(2), rate)))
    correction = analysis.predicted.correction
    assert correction is not None
    assert correction.inlier_share > 0.8
    assert analysis.detection.residual is not None
    assert analysis.detection.residual.median < 2.0


def test_numbers_that_are_none_are_named_as_such(tmp_path: Path) -> None:
    network = build_model(COMPACT)
    assert isinstance(network, CompactViflow)
    with torch.no_grad():
        network.local_head.weight.fill_(float("nan"))
    path = save_checkpoint(tmp_path / "damaged.safetensors", network, COMPACT, name="damaged", version="0")
    detection = AnomalyDetector.from_checkpoint(path).detect(pair(texture(2), texture(2)))
    assert (detection.status, [one.code for one in detection.reasons]) == ("abstained", ["prediction_not_finite"])


def test_a_gyro_only_sensor_is_told_what_is_missing(detector: AnomalyDetector) -> None:
    still = texture(14)
    samples = imu()
    gyro_only = ImuSamples(samples.timestamps_ns, samples.gyro_rad_s)
    with pytest.raises(InvalidInputError) as caught:
        detector.detect(replace(pair(still, still), imu=gyro_only))
    assert caught.value.code == "imu_accel_missing"


def test_the_model_is_named_with_its_checksum(detector: AnomalyDetector, checkpoint: Path) -> None:
    assert detector.model_info.sha256 == load_checkpoint(checkpoint).record.sha256
    assert detector.model_info.name == "rotation"


def test_a_device_that_is_not_there_is_refused(checkpoint: Path) -> None:
    if torch.cuda.is_available():
        assert AnomalyDetector.from_checkpoint(checkpoint, device="cuda").runtime == "torch"
        return
    with pytest.raises(ConfigError) as caught:
        AnomalyDetector.from_checkpoint(checkpoint, device="cuda")
    assert caught.value.code == "device_unavailable"


def test_the_smallest_residual_over_hypotheses_and_a_compensated_exposure(tmp_path: Path) -> None:
    torch.manual_seed(0)
    config = ModelConfig(preset="compact", hypotheses=4)
    path = save_checkpoint(tmp_path / "four.safetensors", build_model(config), config, name="four", version="0")
    detector = AnomalyDetector.from_checkpoint(path, config=DetectorConfig(photometric_compensation=False))
    two = pair(texture(1), np.asarray(texture(1) * 0.8 + 10, dtype=np.uint8))
    plain = detector.analyze(two)
    least = detector.with_config(DetectorConfig(residual="minimum", photometric_compensation=False)).analyze(two)
    assert (least.residual <= plain.residual).all()
    assert least.residual.mean() < plain.residual.mean()
    np.testing.assert_array_equal(least.inside, plain.inside)
    for residual in ("winner", "minimum"):
        judged = detector.with_config(DetectorConfig(residual=residual, photometric_compensation=True)).analyze(two)
        assert judged.residual.mean() < 0.5 * plain.residual.mean()
