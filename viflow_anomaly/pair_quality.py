"""May a pair be judged, and what lowers trust in the answer? Each finding is a reason with a stable code.

The IMU's own faults come from ``motion_input``. Here the two images are looked at (is there texture, did the exposure
jump, is one of them blurred, are they the same picture although the camera turned), and afterwards what the correction
of the motion found (do the images confirm any motion of the camera, and is it the gyro's).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from viflow_anomaly.config import CorrectionConfig, DetectorConfig, QualityConfig
from viflow_anomaly.correction import Correction
from viflow_anomaly.detection import Reason
from viflow_anomaly.measured_flow import MeasuredFlow
from viflow_anomaly.motion_input import MotionWindow
from viflow_anomaly.sensor_data import Uint8Array

SHARPNESS_SIDE_PX = 400
"""Sharpness is judged on the image shrunk to about this many pixels along its longer side: blur that is gone there
leaves little residual, and the sensor's noise is averaged."""
MIN_SMALL_SIDE_PX = 32
FINE_PX, COARSE_PX = 1, 8
"""Distances of the pixels whose differences are compared."""
NOISE_GRAY2 = 0.25
"""Added to both mean squares, so that what is below half a gray level decides nothing."""
CLIPPED_GRAY = (2, 253)
"""Up to the first and from the second on, a gray level counts as clipped; noise spreads what was cut off."""
CLIPPING_STRIDE = 4
MAX_COMMON_TURN_RAD = 0.3
"""A camera that turned further sees another part of the scene, which need not be as rich in detail."""
MIN_TURN_INTERVAL_S = 0.08
"""Between frames that are closer, the measurement's own error (half a view pixel) outweighs the gyro's."""


class Finding(NamedTuple):
    """A reason, and whether it forbids to judge the pair."""

    reason: Reason
    abstain: bool


class Sharpness(NamedTuple):
    """Along x and y: mean square of the difference of neighbours over that of pixels a few places apart.

    An exposure's gain and bias cancel. Defocus lowers both, motion blur the one along the motion.
    """

    x: float
    y: float


def judge_images(
    source: Uint8Array, target: Uint8Array, window: MotionWindow, config: DetectorConfig
) -> tuple[Finding, ...]:
    """What the two images say before anything is predicted.

    Args:
        source, target: [H, W].
        window: says how far the camera turned between them.
        config: limits.
    """
    (source_mean, source_contrast), (target_mean, target_contrast) = (
        (float(value[0, 0]) for value in cv2.meanStdDev(image)) for image in (source, target)
    )
    contrast = min(source_contrast, target_contrast)
    if contrast < config.min_texture_gray:
        # On a uniform image the other questions have no meaning.
        return (_no_texture(contrast, config.min_texture_gray),)
    quality = config.quality
    if window.turn_rate_rad_s > quality.frozen_turn_rate_rad_s and np.array_equal(source, target):
        return (_frozen_image(window.turn_rate_rad_s),)
    findings = []
    jump = abs(source_mean - target_mean)
    if jump > config.max_exposure_jump_gray:
        contrasts = max(source_contrast, target_contrast) / max(contrast, 1e-6)
        clipped = max(clipped_share(source), clipped_share(target))
        findings.append(_exposure_jump(jump, contrasts, clipped, config))
    alike = window.turn_rate_rad_s * window.interval_s <= MAX_COMMON_TURN_RAD
    if alike and not any(one.abstain for one in findings):
        sharper, ratio = sharpness_ratio(sharpness(source), sharpness(target))
        if ratio > quality.max_blur_ratio:
            findings.append(_blur(sharper, ratio, quality))
    return tuple(findings)


def judge_window(window: MotionWindow) -> tuple[Finding, ...]:
    """The faults of the IMU's samples."""
    return tuple(Finding(Reason(one.code, one.message), one.severity == "abstain") for one in window.faults)


def judge_correction(
    correction: Correction, measured: MeasuredFlow, interval_s: float, config: DetectorConfig
) -> tuple[Finding, ...]:
    """What the attempt to correct the motion on the target image says against the answer.

    Args:
        correction: of the predicted motion.
        measured: what it was made with.
        interval_s: between the frames.
        config: limits.
    """
    findings = []
    if correction.inlier_share < config.correction.min_inlier_share:
        findings.append(_motion_unconfirmed(correction.inlier_share, config.correction))
    # Where the network gives flow only, what disagrees may as well be the network.
    if correction.motion is not None:
        confidence = float(measured.confidence.mean())
        findings += _imu_contradicts_image(correction, confidence, interval_s, config)
    return tuple(findings)


def reasons_in_order(findings: Sequence[Finding]) -> tuple[Reason, ...]:
    """What forbids to judge the pair ahead of what is only remarked, so that an abstained pair's first reason decided;
    both in the order in which they were found."""
    return tuple(one.reason for one in sorted(findings, key=lambda one: not one.abstain))


def sharpness(image: Uint8Array) -> Sharpness:
    """See ``Sharpness``; sides of at least ``COARSE_PX`` + 1."""
    height, width = image.shape
    block = max(1, min(round(max(height, width) / SHARPNESS_SIDE_PX), min(height, width) // MIN_SMALL_SIDE_PX))
    rows, columns = height // block, width // block
    small = image
    if block > 1:
        whole = image[: rows * block, : columns * block]
        small = np.asarray(cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA), dtype=np.uint8)
    along_x, along_y = (
        [
            cv2.norm(far, near, cv2.NORM_L2SQR) / far.size + NOISE_GRAY2
            for far, near in (_shifted(small, axis, lag) for lag in (FINE_PX, COARSE_PX))
        ]
        for axis in (1, 0)
    )
    return Sharpness(along_x[0] / along_x[1], along_y[0] / along_y[1])


def _shifted(image: Uint8Array, axis: int, lag: int) -> tuple[Uint8Array, Uint8Array]:
    """All pairs of pixels that are ``lag`` apart, as two views."""
    if axis == 1:
        return image[:, lag:], image[:, :-lag]
    return image[lag:], image[:-lag]


def sharpness_ratio(source: Sharpness, target: Sharpness) -> tuple[str, float]:
    """Which image is sharper, ``source`` or ``target``, and by which factor (at least 1), along the axis that differs
    more."""
    ratio = max((ours / theirs for ours, theirs in zip(source, target, strict=True)), key=lambda one: max(one, 1 / one))
    return ("source", ratio) if ratio >= 1 else ("target", 1 / ratio)


def clipped_share(image: Uint8Array) -> float:
    """Share of the pixels that are black or white, 0..1; on every fourth row and column."""
    thin = image[::CLIPPING_STRIDE, ::CLIPPING_STRIDE]
    dark, bright = CLIPPED_GRAY
    return float(np.count_nonzero((thin <= dark) | (thin >= bright))) / thin.size


def _no_texture(contrast: float, wanted: float) -> Finding:
    message = (
        f"expected a deviation of at least {wanted} gray levels in both images, found {contrast:.1f}: "
        "a uniform image shows no motion"
    )
    return Finding(Reason("no_texture", message), abstain=True)


def _frozen_image(turn_rate_rad_s: float) -> Finding:
    message = (
        f"expected the image to change, for the gyro turned at {turn_rate_rad_s:.2f} rad/s, found the same picture "
        "twice: the camera has frozen, or a frame was sent again"
    )
    return Finding(Reason("frozen_image", message), abstain=True)


def _exposure_jump(jump: float, contrasts: float, clipped: float, config: DetectorConfig) -> Finding:
    quality = config.quality
    told = f"the mean brightness changed by {jump:.0f} gray levels between the frames"
    beyond = []
    if jump > quality.abstain_exposure_jump_gray:
        beyond.append(f"the jump is more than {quality.abstain_exposure_jump_gray:.0f}")
    if clipped > quality.max_clipped_share:
        beyond.append(f"{100 * clipped:.0f} % of an image are black or white")
    if contrasts > quality.max_contrast_ratio:
        beyond.append(f"the contrast changed {contrasts:.1f} times")
    if beyond:
        message = f"{told}, and no gain and bias make up for it: {', '.join(beyond)}"
    else:
        message = f"{told}, more than {config.max_exposure_jump_gray:.0f}: the residual is not motion alone"
    return Finding(Reason("exposure_jump", message), abstain=bool(beyond))


def _blur(sharper: str, ratio: float, quality: QualityConfig) -> Finding:
    message = (
        f"expected two images that are equally sharp, found the {sharper} {ratio:.1f} times as sharp as the other "
        f"(at most {quality.max_blur_ratio:g}): the residual is not motion alone"
    )
    return Finding(Reason("blur", message), abstain=ratio > quality.abstain_blur_ratio)


def _motion_unconfirmed(inlier_share: float, config: CorrectionConfig) -> Finding:
    if inlier_share:
        found = f"found that {100 * inlier_share:.0f} % agree with any motion of the camera"
    else:
        found = "found too little texture in common; the prediction stands as it was"
    wanted = f"expected at least {100 * config.min_inlier_share:.0f} % of what can be measured between the images"
    return Finding(Reason("motion_unconfirmed", f"{wanted} to confirm the camera's motion, {found}"), abstain=False)


def _imu_contradicts_image(
    correction: Correction, confidence: float, interval_s: float, config: DetectorConfig
) -> list[Finding]:
    """Either the images show another rotation than the gyro, or they are well measured and show none near the gyro's.

    The search for the flow starts at the prediction, so a gyro that is far off shows in the second way.
    """
    quality = config.quality
    measurable = confidence >= quality.min_confidence
    error_rad_s = correction.turned_rad / max(interval_s, MIN_TURN_INTERVAL_S)
    lost = measurable and correction.inlier_share < config.correction.min_inlier_share
    parts = []
    if error_rad_s > quality.max_turn_error_rad_s:
        parts.append(f"show a rotation that is {error_rad_s:.2f} rad/s from the gyro's")
    if lost:
        parts.append(
            f"agree with no motion near the gyro's ({100 * correction.inlier_share:.0f} % of what is measured)"
        )
    if not parts:
        return []
    message = (
        f"the images {' and '.join(parts)}: the IMU's axes, signs or clock may be wrong, or most of the picture moves"
    )
    extreme = correction.inlier_share < quality.abstain_inlier_share or error_rad_s > quality.abstain_turn_error_rad_s
    return [Finding(Reason("imu_contradicts_image", message), abstain=measurable and extreme)]
