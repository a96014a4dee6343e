"""Online correction against closed forms: a known camera motion, wrong starts, movers, nothing to see."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from viflow_anomaly.config import CorrectionConfig
from viflow_anomaly.correction import (
    RigidMotion,
    correct_flow,
    correct_motion,
    rigid_flow_px,
)
from viflow_anomaly.geometry import Float32Array, rigid_motion_flow, so3_exp, so3_log
from viflow_anomaly.measured_flow import MeasuredFlow
from viflow_anomaly.prediction import view_rays
from viflow_anomaly.sensor_data import PinholeCamera

FOCAL_PX, ROWS, COLUMNS, STRIDE = 116.0, 32, 48, 4
RAYS = view_rays(ROWS, COLUMNS, STRIDE, ROWS * STRIDE, COLUMNS * STRIDE, FOCAL_PX)
ROTATION, TRANSLATION_M = (0.01, -0.02, 0.015), (0.05, -0.02, 0.08)


class Sight(NamedTuple):
    """A world, a camera motion and what would be measured of it."""

    inverse_depth: Float32Array
    true: RigidMotion
    measured: MeasuredFlow


def sight(seed: int = 0) -> Sight:
    rng = np.random.default_rng(seed)
    inverse_depth = rng.uniform(0.1, 0.6, (ROWS, COLUMNS)).astype(np.float32)
    true = RigidMotion(so3_exp(np.array(ROTATION)), np.array(TRANSLATION_M))
    flow = rigid_flow_px(RAYS, inverse_depth, true, FOCAL_PX)
    return Sight(inverse_depth, true, MeasuredFlow(flow, np.ones((ROWS, COLUMNS), np.float32), STRIDE))


def still() -> RigidMotion:
    return RigidMotion(np.eye(3), np.zeros(3))


def error_px(flow: Float32Array, seen: Sight) -> float:
    return float(np.linalg.norm(flow - rigid_flow_px(RAYS, seen.inverse_depth, seen.true, FOCAL_PX), axis=-1).mean())


def test_the_flow_is_the_rigid_motion_field_of_the_geometry_module() -> None:
    width, height = COLUMNS * STRIDE, ROWS * STRIDE
    camera = PinholeCamera(FOCAL_PX, FOCAL_PX, (width - 1) / 2, (height - 1) / 2, width, height)
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = so3_exp(np.array(ROTATION)), TRANSLATION_M
    depth_m = np.random.default_rng(1).uniform(2, 9, (height, width))
    expected, valid = rigid_motion_flow(camera, depth_m, motion)
    rays = view_rays(height, width, 1, height, width, FOCAL_PX)
    found = rigid_flow_px(rays, (1 / depth_m).astype(np.float32), RigidMotion(motion[:3, :3], motion[:3, 3]), FOCAL_PX)
    assert valid.all()
    np.testing.assert_allclose(found, expected, atol=2e-3)


def test_a_motion_within_the_priors_reach_is_found() -> None:
    seen = sight()
    near = RigidMotion(so3_exp(np.add(ROTATION, (0.002, -0.001, 0.001))), np.zeros(3))
    corrected = correct_motion(RAYS, seen.inverse_depth, near, seen.measured, FOCAL_PX, CorrectionConfig(rounds=10))
    assert corrected.converged
    assert corrected.motion is not None
    np.testing.assert_allclose(corrected.motion.translation, TRANSLATION_M, atol=2e-3)
    assert np.linalg.norm(so3_log(corrected.motion.rotation @ seen.true.rotation.T)) < 2e-4
    assert error_px(corrected.flow_px, seen) < 0.05
    assert corrected.inlier_share > 0.95
    assert corrected.shift_px > 0.5
    assert abs(corrected.turned_rad - np.linalg.norm((0.002, -0.001, 0.001))) < 2e-4


def test_the_measured_turn_is_the_images_word_without_the_prior() -> None:
    """However hard the prior pulls the correction back to the gyro's rotation."""
    seen, off = sight(), np.array((0.004, -0.003, 0.002))
    start = RigidMotion(so3_exp(-off) @ seen.true.rotation, seen.true.translation)
    for sigma_rad in (1e-2, 1e-4):
        config = CorrectionConfig(rounds=10, rotation_sigma_rad=sigma_rad)
        turn = correct_motion(RAYS, seen.inverse_depth, start, seen.measured, FOCAL_PX, config).turn
        assert turn is not None
        np.testing.assert_allclose(turn.turned_rad, off, atol=3e-4)
        assert np.linalg.eigvalsh(turn.covariance_rad2).min() > 0
        assert np.sqrt(np.diag(turn.covariance_rad2)).max() < 5e-3


def test_no_turn_is_told_where_nothing_converged_or_no_motion_is_known() -> None:
    seen = sight()
    nothing = seen.measured._replace(confidence=np.zeros((ROWS, COLUMNS), np.float32))
    assert correct_motion(RAYS, seen.inverse_depth, still(), nothing, FOCAL_PX, CorrectionConfig()).turn is None
    flows = np.stack([seen.measured.flow_px, 0.9 * seen.measured.flow_px])
    assert correct_flow(RAYS, flows, 1, seen.measured, FOCAL_PX, CorrectionConfig()).turn is None


def test_the_true_start_stays() -> None:
    seen = sight()
    corrected = correct_motion(RAYS, seen.inverse_depth, seen.true, seen.measured, FOCAL_PX, CorrectionConfig())
    assert error_px(corrected.flow_px, seen) < 1e-3
    assert corrected.shift_px < 1e-2


def test_a_mover_is_outvoted_and_not_explained_away() -> None:
    seen = sight()
    flow = seen.measured.flow_px.copy()
    flow[5:17, 10:26] += np.array((6.0, 3.0), dtype=np.float32)  # an eighth of the view
    measured = seen.measured._replace(flow_px=flow)
    start = RigidMotion(seen.true.rotation, np.zeros(3))
    config = CorrectionConfig(rounds=10, depth_rounds=0)
    corrected = correct_motion(RAYS, seen.inverse_depth, start, measured, FOCAL_PX, config)
    assert error_px(corrected.flow_px, seen) < 0.1
    assert 0.8 < corrected.inlier_share < 0.9


def test_a_mover_is_no_nearer_wall() -> None:
    """Refining the depth leaves most of a motion that no depth explains, and the static world as it is."""
    seen = sight()
    flow = seen.measured.flow_px.copy()
    flow[5:17, 10:26] += np.array((6.0, 3.0), dtype=np.float32)
    measured = seen.measured._replace(flow_px=flow)
    refined = correct_motion(RAYS, seen.inverse_depth, seen.true, measured, FOCAL_PX, CorrectionConfig())
    left = np.linalg.norm(flow - refined.flow_px, axis=-1)
    assert left[5:17, 10:26].mean() > 0.5 * np.hypot(6, 3)
    still_world = np.ones((ROWS, COLUMNS), bool)
    still_world[2:20, 7:29] = False
    assert left[still_world].mean() < 0.05


def test_a_depth_that_the_network_misread_is_found_in_the_parallax() -> None:
    seen = sight()
    misread = seen.inverse_depth.copy()
    misread[:, COLUMNS // 2 :] *= 0.7
    config = CorrectionConfig(rounds=1)
    before, after = (
        correct_motion(RAYS, misread, seen.true, seen.measured, FOCAL_PX, config.model_copy(update={"depth_rounds": n}))
        for n in (0, 4)
    )
    assert before.motion is not None
    assert error_px(after.flow_px, seen) < 0.3 * error_px(before.flow_px, seen)
    assert after.inlier_share > before.inlier_share


def test_without_translation_there_is_no_parallax_to_learn_a_depth_from() -> None:
    seen = sight()
    turned = RigidMotion(seen.true.rotation, np.zeros(3))
    flow = rigid_flow_px(RAYS, seen.inverse_depth, turned, FOCAL_PX)
    measured = seen.measured._replace(flow_px=flow + np.float32(0.3))
    corrected = correct_motion(RAYS, seen.inverse_depth, turned, measured, FOCAL_PX, CorrectionConfig(rounds=1))
    assert np.isfinite(corrected.flow_px).all()
    assert np.abs(corrected.flow_px - flow).max() < 0.5


def test_the_prior_holds_where_the_measurement_says_nothing() -> None:
    seen = sight()
    nothing = seen.measured._replace(confidence=np.zeros((ROWS, COLUMNS), np.float32))
    corrected = correct_motion(RAYS, seen.inverse_depth, still(), nothing, FOCAL_PX, CorrectionConfig())
    assert not corrected.converged
    assert (corrected.inlier_share, corrected.shift_px) == (0.0, 0.0)
    np.testing.assert_array_equal(corrected.flow_px, 0.0)
    assert corrected.motion is not None
    np.testing.assert_array_equal(corrected.motion.rotation, np.eye(3))


def test_a_correction_that_explains_less_than_the_prediction_is_not_taken() -> None:
    """Noise agrees with no camera motion: the prediction that fits a corner of it exactly stays."""
    seen = sight()
    noise = np.random.default_rng(3).normal(0, 40, (ROWS, COLUMNS, 2)).astype(np.float32)
    flow = np.where(np.arange(COLUMNS)[:, None] < 8, seen.measured.flow_px, noise)
    measured = seen.measured._replace(flow_px=flow)
    corrected = correct_motion(RAYS, seen.inverse_depth, seen.true, measured, FOCAL_PX, CorrectionConfig(rounds=1))
    assert not corrected.converged
    assert corrected.inlier_share > 0.15
    np.testing.assert_array_equal(corrected.flow_px, rigid_flow_px(RAYS, seen.inverse_depth, seen.true, FOCAL_PX))


def test_hypotheses_are_mixed_where_no_depth_is_known() -> None:
    seen = sight()
    unit = [
        rigid_flow_px(RAYS, seen.inverse_depth, RigidMotion(seen.true.rotation, t), FOCAL_PX) for t in 0.1 * np.eye(3)
    ]
    hypotheses = np.stack(
        [rigid_flow_px(RAYS, seen.inverse_depth, RigidMotion(seen.true.rotation, np.zeros(3)), 116), *unit]
    )
    corrected = correct_flow(RAYS, hypotheses, 0, seen.measured, FOCAL_PX, CorrectionConfig(rounds=10))
    assert corrected.converged
    assert corrected.motion is None
    assert error_px(corrected.flow_px, seen) < 0.1 < error_px(hypotheses[0], seen)


def test_a_rotation_the_hypotheses_lack_is_found() -> None:
    flow = rigid_flow_px(
        RAYS,
        np.zeros((ROWS, COLUMNS), np.float32),
        RigidMotion(so3_exp(np.array((0, 0.004, 0))), np.zeros(3)),
        FOCAL_PX,
    )
    measured = MeasuredFlow(flow, np.ones((ROWS, COLUMNS), np.float32), STRIDE)
    corrected = correct_flow(
        RAYS, np.zeros((1, ROWS, COLUMNS, 2), np.float32), 0, measured, FOCAL_PX, CorrectionConfig()
    )
    assert np.linalg.norm(corrected.flow_px - flow, axis=-1).mean() < 0.15 * np.linalg.norm(flow, axis=-1).mean()


def test_the_same_input_gives_the_same_bytes() -> None:
    seen = sight()
    first, second = (
        correct_motion(RAYS, seen.inverse_depth, still(), seen.measured, FOCAL_PX, CorrectionConfig()) for _ in range(2)
    )
    assert first.flow_px.tobytes() == second.flow_px.tobytes()
