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
from viflow_anomaly.geometry import Float32Array, so3_exp, solve_few
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
    return _flow_px(_points(rays, inverse_depth), motion, focal_px)


def _points(rays: Float32Array, inverse_depth: Float32Array) -> Float32Array:
    """[4, ...]: x, y, 1 and the inverse depth, in which a motion is linear."""
    points = np.empty((4, *inverse_depth.shape), dtype=np.float32)
    points[0], points[1] = rays[..., 0], rays[..., 1]
    points[2] = 1
    points[3] = inverse_depth
    return points


def _flow_px(points: Float32Array, motion: RigidMotion, focal_px: float) -> Float32Array:
    """``rigid_flow_px`` of points [4, ...]."""
    moved = _moved(points, motion)
    moved[:2] -= points[:2]
    moved[:2] *= np.float32(focal_px)
    flow = np.empty((*points.shape[1:], 2), dtype=np.float32)
    flow[..., 0], flow[..., 1] = moved[0], moved[1]
    return flow


def _moved(points: Float32Array, motion: RigidMotion) -> Float32Array:
    """[3, ...]: x and y of every point after the motion, and its inverse depth there."""
    matrix = np.empty((3, 4), dtype=np.float32)
    matrix[:, :3], matrix[:, 3] = motion.rotation, motion.translation
    moved: Float32Array = (matrix @ points.reshape(4, -1)).reshape(3, *points.shape[1:])
    nearness = moved[2]
    np.maximum(nearness, np.float32(MIN_DEPTH_RATIO), out=nearness)
    np.divide(np.float32(1), nearness, out=nearness)
    moved[:2] *= nearness
    nearness *= points[3]
    return moved


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
    cells = _points(rays, inverse_depth)
    points = cells[:, *thin].reshape(4, -1)
    goal = measured.flow_px[thin].reshape(-1, 2).T / np.float32(focal_px) + points[:2]  # 2, N
    confidence = measured.confidence[thin].reshape(-1)
    prior = _prior(config)
    motion, turned = start, np.zeros(3)
    turn: MeasuredTurn | None = None
    jacobian = np.zeros((6, *goal.shape), dtype=np.float32)
    for round_ in range(config.rounds):
        moved = _moved(points, motion)
        error = goal - moved[:2]
        weights = robust_weights(error, confidence, _tolerance(config, round_) / focal_px)
        _fill_jacobian(jacobian, *moved)
        equations = _normal_equations(jacobian, error, weights)
        if round_ == config.rounds - 1:
            turn = _measured_turn(equations, prior, turned)
        step = _solved(equations, prior, _pull(prior, turned))
        turned = turned + step[:3]
        motion = RigidMotion(so3_exp(step[:3]) @ motion.rotation, motion.translation + step[3:])
    before, after = (_flow_px(cells, one, focal_px) for one in (start, motion))
    corrected = _accepted(before, after, measured, config, start, motion)
    corrected = corrected._replace(
        inverse_depth=inverse_depth,
        log_depth_ratio=np.zeros_like(inverse_depth),
        turn=turn if corrected.converged else None,
        turned_rad=float(np.linalg.norm(turned)) if corrected.converged else 0.0,
    )
    if not corrected.converged or not config.depth_rounds:
        return corrected
    log_ratio = _log_depth_ratio(cells, motion, measured, focal_px, config)
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
    moved = _moved(_points(rays, inverse_depth), motion)
    return MovedCells(moved[0], moved[1], moved[2], np.stack(list(_slope(moved, motion)), axis=-1))


def _slope(moved: Float32Array, motion: RigidMotion) -> Float32Array:
    """[2, ...], of ``MovedCells``."""
    t = motion.translation.astype(np.float32)
    slope: Float32Array = moved[:2] * -t[2]
    slope[0] += t[0]
    slope[1] += t[1]
    slope *= moved[2]
    return slope


def _log_depth_ratio(
    cells: Float32Array, motion: RigidMotion, measured: MeasuredFlow, focal_px: float, config: CorrectionConfig
) -> Float32Array:
    """[h, w] what the inverse depth's logarithm changes by to explain the parallax, see ``depth_refinement``.

    ``cells`` are ``_points``.
    """
    goal = measured.flow_px.transpose(2, 0, 1) / np.float32(focal_px) + cells[:2]
    points = cells.copy()
    log_ratio: Float32Array = np.zeros_like(cells[3])
    for _ in range(config.depth_rounds):
        np.multiply(cells[3], np.exp(log_ratio), out=points[3])
        moved = _moved(points, motion)
        parallax = Parallax(goal - moved[:2], _slope(moved, motion))
        log_ratio = log_depth_step(parallax, measured, log_ratio, config.tolerance_px / focal_px)
    return log_ratio


def _fill_jacobian(jacobian: Float32Array, x: Float32Array, y: Float32Array, nearness: Float32Array) -> None:
    """[6, 2, N]: how (x, y) after the motion follow a further rotation and translation of the camera."""
    xy = x * y
    np.negative(xy, out=jacobian[0, 0])
    np.add(x * x, 1, out=jacobian[1, 0])
    np.negative(y, out=jacobian[2, 0])
    jacobian[3, 0] = nearness
    np.multiply(nearness, -x, out=jacobian[5, 0])
    np.subtract(-1, y * y, out=jacobian[0, 1])
    jacobian[1, 1] = xy
    jacobian[2, 1] = x
    jacobian[4, 1] = nearness
    np.multiply(nearness, -y, out=jacobian[5, 1])


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
    basis = np.stack([*turns, *others]).astype(np.float32)  # 3 + K - 1, 2, h, w
    prior = np.full(len(basis), 1 / BLEND_SIGMA**2)
    prior[:3] = 1 / config.rotation_sigma_rad**2
    thin = _lattice(measured, config)
    jacobian = basis[:, :, *thin].reshape(len(prior), 2, -1)
    goal = ((measured.flow_px - start)[thin] / np.float32(focal_px)).reshape(-1, 2).T
    confidence = measured.confidence[thin].reshape(-1)
    solution = np.zeros(len(prior))
    for round_ in range(config.rounds):
        error = goal - np.tensordot(solution.astype(np.float32), jacobian, 1)
        weights = robust_weights(error, confidence, _tolerance(config, round_) / focal_px)
        solution = _weighted_step(jacobian, goal, weights, prior, np.zeros(len(prior)))
    shift = np.tensordot(solution.astype(np.float32), basis, 1).transpose(1, 2, 0)
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
    """Solve the normal equations of jacobian [P, 2, N] and error [2, N], both in focal lengths."""
    return _solved(_normal_equations(jacobian, error, weights), prior, pull)


def _normal_equations(jacobian: Float32Array, error: Float32Array, weights: Float32Array) -> _NormalEquations:
    rows = jacobian.reshape(len(jacobian), -1)
    weighted = (jacobian * (weights * np.float32(1 / NOISE_RAY**2))).reshape(rows.shape)
    normal, gradient = weighted @ rows.T, weighted @ error.reshape(-1)
    return _NormalEquations(normal.astype(np.float64), gradient.astype(np.float64))


def _solved(equations: _NormalEquations, prior: Float64Array, pull: Float64Array) -> Float64Array:
    return solve_few(equations.normal + np.diag(prior), equations.gradient + pull)


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
