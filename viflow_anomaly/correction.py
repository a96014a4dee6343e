"""Online correction (the paper's second limit): the predicted motion, refined on the target image itself.

A few rounds of iteratively reweighted least squares bring the network's prediction to the measured flow of the view.
What moves by itself, and what was measured wrongly, is outvoted by robust weights; a prior keeps the rotation near the
gyro's. The parameters are few (six, or a dozen), so independent motion cannot be explained away by them. The depth that
follows (``depth_refinement``) has one number a cell: it takes up a part of a motion along the epipolar line.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from viflow_anomaly.config import CorrectionConfig
from viflow_anomaly.depth_refinement import Parallax, log_depth_step
from viflow_anomaly.geometry import Float32Array, so3_exp
from viflow_anomaly.measured_flow import MeasuredFlow
from viflow_anomaly.sensor_data import Float64Array

MIN_DEPTH_RATIO = 0.1
"""Points that come closer to the camera than this share of their depth are not followed further."""


NOISE_RAY = 0.01
"""Deviation of a cell's measurement as the prior sees it, in focal lengths. Neighbours err alike: each counts as less
than its own precision of a few thousandths."""
BLEND_SIGMA = 0.5
"""How far the weights of the other hypotheses go from the winner's 1 and their 0."""


class RigidMotion(NamedTuple):
    """X_target = rotation X_source + translation: [3, 3] and [3] in the unit whose inverse the depth is in."""

    rotation: Float64Array
    translation: Float64Array


class MeasuredTurn(NamedTuple):
    """How the camera turned beside the rotation a correction began with; the images' word alone, without the prior.

    Attributes:
        turned_rad: [3] rotation vector in target-camera axes: rotation = exp(turned_rad) start.rotation.
        covariance_rad2: [3, 3], the translation left open; as if each cell erred by ``NOISE_RAY`` on its own.
    """

    turned_rad: Float64Array
    covariance_rad2: Float64Array


class Correction(NamedTuple):
    """A corrected prediction.

    Attributes:
        flow_px: [h, w, 2] float32.
        motion: the corrected camera motion, None where the network gives flow only.
        inverse_depth: [h, w] as refined, None where the network gives flow only.
        log_depth_ratio: [h, w] logarithm of the refined over the predicted inverse depth, None likewise.
        inlier_share: confident cells that agree with ``flow_px``, 0..1; 0 where too little was confident.
        shift_px: how far the correction moved the prediction, |du| + |dv|, mean over cells.
        converged: False: nothing to measure, or the prediction was no worse; it stands as it was.
        turned_rad: angle between the rotation of ``motion`` and the gyro's; 0 where that stands, and where the network
            gives flow only: without depth a rotation would also stand for the camera's translation.
        turn: what the images say of the rotation beside ``start``'s, None likewise or where nothing converged.
    """

    flow_px: Float32Array
    motion: RigidMotion | None
    inlier_share: float
    shift_px: float
    converged: bool
    inverse_depth: Float32Array | None = None
    log_depth_ratio: Float32Array | None = None
    turned_rad: float = 0.0
    turn: MeasuredTurn | None = None


def rigid_flow_px(
    rays: Float32Array, inverse_depth: Float32Array, motion: RigidMotion, focal_px: float
) -> Float32Array:
    """Flow [..., 2] of a static world; rays [..., 2] in focal lengths, inverse_depth [...]."""
    x, y = rays[..., 0], rays[..., 1]
    moved_x, moved_y, _ = _moved(x, y, inverse_depth, motion)
    flow = np.empty_like(rays)
    np.subtract(moved_x, x, out=flow[..., 0])
    np.subtract(moved_y, y, out=flow[..., 1])
    flow *= np.float32(focal_px)
    return flow


def _moved(
    x: Float32Array, y: Float32Array, inverse_depth: Float32Array, motion: RigidMotion
) -> tuple[Float32Array, Float32Array, Float32Array]:
    """(x, y) of every ray after the motion, and its inverse depth there."""
    rotation, translation = motion.rotation.astype(np.float32), motion.translation.astype(np.float32)
    px, py, pz = (
        row[0] * x + row[1] * y + row[2] + inverse_depth * t for row, t in zip(rotation, translation, strict=True)
    )
    np.maximum(pz, np.float32(MIN_DEPTH_RATIO), out=pz)
    nearness = np.divide(1, pz, out=pz)
    px *= nearness
    py *= nearness
    nearness *= inverse_depth
    return px, py, nearness


class _NormalEquations(NamedTuple):
    """[P, P] and [P] of the measurement alone."""

    normal: Float64Array
    gradient: Float64Array


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
    x, y = (np.ascontiguousarray(rays[thin][..., axis]).reshape(-1) for axis in (0, 1))
    depth = np.ascontiguousarray(inverse_depth[thin]).reshape(-1)
    goal = measured.flow_px[thin].reshape(-1, 2).T / np.float32(focal_px) + (x, y)  # 2, N
    confidence = measured.confidence[thin].reshape(-1)
    prior = _prior(config)
    motion, turned = start, np.zeros(3)
    turn: MeasuredTurn | None = None
    jacobian = np.zeros((2, 6, x.size), dtype=np.float32)
    for round_ in range(config.rounds):
        moved_x, moved_y, nearness = _moved(x, y, depth, motion)
        error = goal - (moved_x, moved_y)
        weights = robust_weights(error, confidence, _tolerance(config, round_) / focal_px)
        _fill_jacobian(jacobian, moved_x, moved_y, nearness)
        equations = _normal_equations(jacobian, error, weights)
        if round_ == config.rounds - 1:
            turn = _measured_turn(equations, prior, turned)
        step = _solved(equations, prior, _pull(prior, turned))
        turned = turned + step[:3]
        motion = RigidMotion(so3_exp(step[:3]) @ motion.rotation, motion.translation + step[3:])
    before = rigid_flow_px(rays, inverse_depth, start, focal_px)
    after = rigid_flow_px(rays, inverse_depth, motion, focal_px)
    corrected = _accepted(before, after, measured, config, start, motion)
    corrected = corrected._replace(
        inverse_depth=inverse_depth,
        log_depth_ratio=np.zeros_like(inverse_depth),
        turn=turn if corrected.converged else None,
        turned_rad=float(np.linalg.norm(turned)) if corrected.converged else 0.0,
    )
    if not corrected.converged or not config.depth_rounds:
        return corrected
    log_ratio = _log_depth_ratio(rays, inverse_depth, motion, measured, focal_px, config)
    refined = np.asarray(inverse_depth * np.exp(log_ratio), dtype=np.float32)
    flow_px = rigid_flow_px(rays, refined, motion, focal_px)
    share, _ = _inlier_share(flow_px, measured, config)
    shift_px = _shift_px(before, flow_px, measured, config)
    return corrected._replace(
        flow_px=flow_px, inlier_share=share, shift_px=shift_px, inverse_depth=refined, log_depth_ratio=log_ratio
    )


class MovedCells(NamedTuple):
    """Every cell after the motion: x and y [h, w] in focal lengths, its inverse depth there, and ``slope`` [h, w, 2],
    the derivative of (x, y) by the logarithm of the inverse depth. The slope's direction is that of the epipolar line,
    its length the parallax that a point at this depth shows."""

    x: Float32Array
    y: Float32Array
    nearness: Float32Array
    slope: Float32Array


def moved_cells(rays: Float32Array, inverse_depth: Float32Array, motion: RigidMotion) -> MovedCells:
    """Where the cells of rays [h, w, 2] go."""
    moved = _moved(rays[..., 0], rays[..., 1], inverse_depth, motion)
    return MovedCells(*moved, _slope(moved, motion))


def _slope(moved: tuple[Float32Array, Float32Array, Float32Array], motion: RigidMotion) -> Float32Array:
    x, y, nearness = moved
    t = motion.translation.astype(np.float32)
    return np.stack([nearness * (t[0] - x * t[2]), nearness * (t[1] - y * t[2])], axis=-1)


def _log_depth_ratio(
    rays: Float32Array,
    inverse_depth: Float32Array,
    motion: RigidMotion,
    measured: MeasuredFlow,
    focal_px: float,
    config: CorrectionConfig,
) -> Float32Array:
    """[h, w] what the inverse depth's logarithm changes by to explain the parallax, see ``depth_refinement``."""
    x, y = np.ascontiguousarray(rays[..., 0]), np.ascontiguousarray(rays[..., 1])
    goal = measured.flow_px / np.float32(focal_px) + rays
    log_ratio = np.zeros_like(inverse_depth)
    for _ in range(config.depth_rounds):
        moved = _moved(x, y, inverse_depth * np.exp(log_ratio), motion)
        parallax = Parallax(goal - np.stack(moved[:2], axis=-1), _slope(moved, motion))
        log_ratio = log_depth_step(parallax, measured, log_ratio, config.tolerance_px / focal_px)
    return log_ratio


def _fill_jacobian(jacobian: Float32Array, x: Float32Array, y: Float32Array, nearness: Float32Array) -> None:
    """[2, 6, N]: how (x, y) after the motion follow a further rotation and translation of the camera."""
    xy = x * y
    np.negative(xy, out=jacobian[0, 0])
    np.add(x * x, 1, out=jacobian[0, 1])
    np.negative(y, out=jacobian[0, 2])
    jacobian[0, 3] = nearness
    np.multiply(nearness, -x, out=jacobian[0, 5])
    np.subtract(-1, y * y, out=jacobian[1, 0])
    jacobian[1, 1] = xy
    jacobian[1, 2] = x
    jacobian[1, 4] = nearness
    np.multiply(nearness, -y, out=jacobian[1, 5])


def _prior(config: CorrectionConfig) -> Float64Array:
    """[6] inverse variances of rotation and translation."""
    return np.repeat([1 / config.rotation_sigma_rad**2, 1 / config.translation_sigma**2], 3)


def _tolerance(config: CorrectionConfig, round_: int) -> float:
    """Wide in the first rounds: the start may be far off."""
    return config.tolerance_px * max(1.0, 3.0 - round_)


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
    turns = [np.stack(one) for one in ((-x * y, -1 - y * y), (1 + x * x, x * y), (-y, x))]
    others = [(one - start).transpose(2, 0, 1) / focal_px for k, one in enumerate(hypotheses_px) if k != winner]
    basis = np.stack([*turns, *others], axis=1).astype(np.float32)  # 2, 3 + K - 1, h, w
    prior = np.full(basis.shape[1], 1 / BLEND_SIGMA**2)
    prior[:3] = 1 / config.rotation_sigma_rad**2
    thin = _lattice(measured, config)
    jacobian = basis[:, :, *thin].reshape(2, len(prior), -1)
    goal = ((measured.flow_px - start)[thin] / np.float32(focal_px)).reshape(-1, 2).T
    confidence = measured.confidence[thin].reshape(-1)
    solution = np.zeros(len(prior))
    for round_ in range(config.rounds):
        error = goal - np.tensordot(solution.astype(np.float32), jacobian, (0, 1))
        weights = robust_weights(error, confidence, _tolerance(config, round_) / focal_px)
        solution = _weighted_step(jacobian, goal, weights, prior, np.zeros(len(prior)))
    shift = np.tensordot(solution.astype(np.float32), basis, (0, 1)).transpose(1, 2, 0)
    return _accepted(start, start + shift * np.float32(focal_px), measured, config, None, None)


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


def robust_weights(error: Float32Array, confidence: Float32Array, tolerance: float) -> Float32Array:
    """Cauchy weights [N] of errors [2, N]: half at ``tolerance``, in the errors' unit."""
    scaled = error * np.float32(1 / tolerance)
    return np.asarray(confidence / (1 + scaled[0] * scaled[0] + scaled[1] * scaled[1]), dtype=np.float32)


def _weighted_step(
    jacobian: Float32Array, error: Float32Array, weights: Float32Array, prior: Float64Array, pull: Float64Array
) -> Float64Array:
    """Solve the normal equations of jacobian [2, P, N] and error [2, N], both in focal lengths."""
    return _solved(_normal_equations(jacobian, error, weights), prior, pull)


def _normal_equations(jacobian: Float32Array, error: Float32Array, weights: Float32Array) -> _NormalEquations:
    weighted = jacobian * (weights * np.float32(1 / NOISE_RAY**2))
    normal = (weighted[0] @ jacobian[0].T + weighted[1] @ jacobian[1].T).astype(np.float64)
    gradient = (weighted[0] @ error[0] + weighted[1] @ error[1]).astype(np.float64)
    return _NormalEquations(normal, gradient)


def _solved(equations: _NormalEquations, prior: Float64Array, pull: Float64Array) -> Float64Array:
    return np.asarray(np.linalg.solve(equations.normal + np.diag(prior), equations.gradient + pull))


def _measured_turn(equations: _NormalEquations, prior: Float64Array, turned: Float64Array) -> MeasuredTurn:
    """The same step without the prior that holds the rotation near the gyro's; ``turned`` before it."""
    free = prior.copy()
    free[:3] = 1.0  # a radian: only what is not measured at all is left to it
    covariance: Float64Array = np.asarray(np.linalg.inv(equations.normal + np.diag(free)), dtype=np.float64)
    return MeasuredTurn(turned + (covariance @ equations.gradient)[:3], covariance[:3, :3])


def _accepted(
    before: Float32Array,
    after: Float32Array,
    measured: MeasuredFlow,
    config: CorrectionConfig,
    start: RigidMotion | None,
    motion: RigidMotion | None,
) -> Correction:
    """Take the correction where it explains the measurement better than the prediction did."""
    (share, enough), (share_before, _) = (_inlier_share(flow, measured, config) for flow in (after, before))
    converged = enough and share >= share_before and bool(np.isfinite(after[_lattice(measured, config)]).all())
    if not converged:
        return Correction(before, start, share_before, 0.0, converged=False)
    return Correction(after, motion, share, _shift_px(before, after, measured, config), converged=True)


def _inlier_share(flow_px: Float32Array, measured: MeasuredFlow, config: CorrectionConfig) -> tuple[float, bool]:
    """Which share of the measurement agrees with a flow, and whether enough was measured to say so."""
    thin = _lattice(measured, config)
    confidence = measured.confidence[thin]
    total = float(confidence.sum())
    if total <= config.min_confidence * confidence.size:
        return 0.0, False
    error = (measured.flow_px[thin] - flow_px[thin]).reshape(-1, 2).T
    return float(robust_weights(error, confidence.reshape(-1), config.tolerance_px).sum()) / total, True


def _shift_px(before: Float32Array, after: Float32Array, measured: MeasuredFlow, config: CorrectionConfig) -> float:
    thin = _lattice(measured, config)
    return float(np.abs(after[thin] - before[thin]).sum(axis=-1).mean())
