"""Online correction (the paper's second limit): the predicted motion, refined on the target image itself.

A few rounds of iteratively reweighted least squares bring the network's prediction to the measured flow of the view.
What moves by itself, and what was measured wrongly, is outvoted by robust weights; a prior keeps the rotation near the
gyro's. The parameters are few (six, or a dozen), so independent motion cannot be explained away.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from viflow_anomaly.config import CorrectionConfig
from viflow_anomaly.geometry import Float32Array, so3_exp
from viflow_anomaly.measured_flow import MeasuredFlow
from viflow_anomaly.sensor_data import Float64Array

MIN_DEPTH_RATIO = 0.1
"""Points that come closer to the camera than this share of their depth are not followed further."""


NOISE_RAY = 0.01
"""Deviation of a cell's measurement as the prior sees it, in focal lengths. Neighbouring cells err alike, so each counts
as less than its own precision of a few thousandths."""
BLEND_SIGMA = 0.5
"""How far the weights of the other hypotheses go from the winner's 1 and their 0."""


class RigidMotion(NamedTuple):
    """X_target = rotation X_source + translation: [3, 3] and [3] in the length unit of the inverse depth."""

    rotation: Float64Array
    translation_m: Float64Array


class Correction(NamedTuple):
    """A corrected prediction.

    Attributes:
        flow_px: [h, w, 2] float32.
        motion: the corrected camera motion, None where the network gives flow only.
        inlier_share: confident cells that agree with the corrected flow, 0..1; 0 where nothing was confident.
        shift_px: how far the correction moved the prediction, mean over cells.
        converged: False: the prediction stands as it was.
    """

    flow_px: Float32Array
    motion: RigidMotion | None
    inlier_share: float
    shift_px: float
    converged: bool


def rigid_flow_px(
    rays: Float32Array, inverse_depth: Float32Array, motion: RigidMotion, focal_px: float
) -> Float32Array:
    """Flow [h, w, 2] of a static world; rays [h, w, 2] in focal lengths, inverse_depth [h, w]."""
    moved_x, moved_y, _ = _moved(rays, inverse_depth, motion)
    return np.stack([moved_x - rays[..., 0], moved_y - rays[..., 1]], axis=-1) * np.float32(focal_px)


def _moved(
    rays: Float32Array, inverse_depth: Float32Array, motion: RigidMotion
) -> tuple[Float32Array, Float32Array, Float32Array]:
    """(x, y) of every ray after the motion, and its inverse depth there."""
    x, y = rays[..., 0], rays[..., 1]
    rotation, translation = motion.rotation.astype(np.float32), motion.translation_m.astype(np.float32)
    px, py, pz = (
        row[0] * x + row[1] * y + (row[2] + inverse_depth * t) for row, t in zip(rotation, translation, strict=True)
    )
    pz = np.maximum(pz, np.float32(MIN_DEPTH_RATIO))
    return px / pz, py / pz, inverse_depth / pz


def correct_motion(
    rays: Float32Array,
    inverse_depth: Float32Array,
    start: RigidMotion,
    measured: MeasuredFlow,
    focal_px: float,
    config: CorrectionConfig,
) -> Correction:
    """Refine a camera motion (preset ``calibrated``): six parameters.

    Args:
        rays: [h, w, 2] of each cell, in focal lengths.
        inverse_depth: [h, w].
        start: the IMU's rotation and the winning hypothesis' translation.
        measured: on the same cells.
        focal_px: of the view.
        config: how far and how hard.
    """
    thin = _lattice(measured, config)
    rays_thin, depth_thin = rays[thin], inverse_depth[thin]
    measured_thin, confidence = measured.flow_px[thin].reshape(-1, 2), measured.confidence[thin].reshape(-1)
    rotation, translation = start
    turned = np.zeros(3)
    prior = np.zeros(6)
    prior[:3] = 1 / config.rotation_sigma_rad**2
    prior[3:] = 1 / max(config.translation_sigma, 1e-9) ** 2
    for round_ in range(config.rounds):
        motion = RigidMotion(rotation, translation)
        x, y, q = (part.reshape(-1) for part in _moved(rays_thin, depth_thin, motion))
        flow = np.stack([x, y], axis=-1) - rays_thin.reshape(-1, 2)
        error_px = measured_thin - flow * np.float32(focal_px)
        weights = robust_weights(error_px, confidence, config.tolerance_px * max(1.0, 3.0 - round_))
        zero = np.zeros_like(x)
        du = np.stack([-x * y, 1 + x * x, -y, q, zero, -q * x], axis=-1)
        dv = np.stack([-1 - y * y, x * y, x, zero, q, -q * y], axis=-1)
        step = _weighted_step(du, dv, error_px / np.float32(focal_px), weights, prior, _pull(prior, turned))
        turned = turned + step[:3]
        rotation, translation = so3_exp(step[:3]) @ rotation, translation + step[3:]
    before = rigid_flow_px(rays, inverse_depth, start, focal_px)
    motion = RigidMotion(rotation, translation)
    after = rigid_flow_px(rays, inverse_depth, motion, focal_px)
    return _accepted(before, after, measured, config, start, motion)


def correct_flow(
    rays: Float32Array,
    hypotheses_px: Float32Array,
    winner: int,
    measured: MeasuredFlow,
    focal_px: float,
    config: CorrectionConfig,
) -> Correction:
    """Refine flow that came without depth: the best mixture of the hypotheses, and a rotation of the camera.

    Hypotheses differ in what two frames and an IMU leave open (speed, depth), so what is true lies between them.

    Args:
        rays: [h, w, 2] of each cell, in focal lengths.
        hypotheses_px: [K, h, w, 2].
        winner: where to start.
        measured, focal_px, config: as in ``correct_motion``.
    """
    start = hypotheses_px[winner]
    x, y = rays[..., 0], rays[..., 1]
    turns = [np.stack(one, axis=-1) for one in ((-x * y, -1 - y * y), (1 + x * x, x * y), (-y, x))]
    others = [(one - start) / np.float32(focal_px) for k, one in enumerate(hypotheses_px) if k != winner]
    basis = np.stack([*turns, *others], axis=-1)  # h, w, 2, 3 + K - 1
    prior = np.full(basis.shape[-1], 1 / BLEND_SIGMA**2)
    prior[:3] = 1 / config.rotation_sigma_rad**2
    thin = _lattice(measured, config)
    basis_thin = basis[thin].reshape(-1, 2, basis.shape[-1])
    error_px = (measured.flow_px - start)[thin].reshape(-1, 2)
    confidence = measured.confidence[thin].reshape(-1)
    solution = np.zeros(basis.shape[-1])
    for round_ in range(config.rounds):
        left_px = error_px - (basis_thin @ solution.astype(np.float32)) * np.float32(focal_px)
        weights = robust_weights(left_px, confidence, config.tolerance_px * max(1.0, 3.0 - round_))
        du, dv = basis_thin[:, 0], basis_thin[:, 1]
        solution = _weighted_step(du, dv, error_px / np.float32(focal_px), weights, prior, 0 * prior)
    after = start + (basis @ solution.astype(np.float32)) * np.float32(focal_px)
    return _accepted(start, after, measured, config, None, None)


def _lattice(measured: MeasuredFlow, config: CorrectionConfig) -> tuple[slice, slice]:
    """Every n-th cell: neighbours err alike, so the ones between add time and little else."""
    step = max(1, config.lattice_px // measured.stride)
    one = slice(step // 2, None, step)
    return one, one


def _pull(prior: Float64Array, turned: Float64Array) -> Float64Array:
    """Gradient of the prior: the rotation is drawn back to the gyro's, the translation is only damped."""
    pull = np.zeros(6)
    pull[:3] = -prior[:3] * turned
    return pull


def robust_weights(error_px: Float32Array, confidence: Float32Array, tolerance_px: float) -> Float32Array:
    """Cauchy weights [N] of errors [N, 2]: half at ``tolerance_px``."""
    squared = np.square(error_px).sum(axis=-1)
    return np.asarray(confidence / (1 + squared / np.float32(tolerance_px**2)), dtype=np.float32)


def _weighted_step(
    du: Float32Array,
    dv: Float32Array,
    error: Float32Array,
    weights: Float32Array,
    prior: Float64Array,
    pull: Float64Array,
) -> Float64Array:
    """Solve the normal equations; errors in focal lengths, information of one cell about (focal length)^2 / px^2."""
    information = 1.0 / NOISE_RAY**2
    weighted_u, weighted_v = du * weights[:, None], dv * weights[:, None]
    normal = (weighted_u.T @ du + weighted_v.T @ dv).astype(np.float64) * information
    gradient = (weighted_u.T @ error[:, 0] + weighted_v.T @ error[:, 1]).astype(np.float64) * information
    return np.asarray(np.linalg.solve(normal + np.diag(prior), gradient + pull))


def _accepted(
    before: Float32Array,
    after: Float32Array,
    measured: MeasuredFlow,
    config: CorrectionConfig,
    start: RigidMotion | None,
    motion: RigidMotion | None,
) -> Correction:
    """Take the correction where it explains the measurement better than the prediction did."""
    total = float(measured.confidence.sum())
    enough = config.min_confidence * measured.confidence.size

    def inliers(flow: Float32Array) -> float:
        weights = robust_weights(measured.flow_px - flow, measured.confidence, config.tolerance_px)
        return float(weights.sum()) / total if total > 0 else 0.0

    share, share_before = inliers(after), inliers(before)
    converged = bool(np.isfinite(after).all()) and share >= share_before and total > enough
    if not converged:
        return Correction(before, start, share_before, 0.0, converged=False)
    shift = float(np.linalg.norm(after - before, axis=-1).mean())
    return Correction(after, motion, share, shift, converged=True)
