"""The motion of the camera at the image's resolution: what it leaves is found, what moves by itself stays."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from viflow_anomaly.correction import RigidMotion, moved_cells, rigid_flow_px
from viflow_anomaly.geometry import Float32Array, so3_exp
from viflow_anomaly.motion_refinement import Line, MovedPoints, common_motion_px

ROWS, COLUMNS, FOCAL_PX = 48, 64, 700.0


def scene(translation: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> tuple[Float32Array, Float32Array, RigidMotion]:
    """Rays and inverse depths of a sloping ground, and a motion of the camera."""
    v, u = np.mgrid[0:ROWS, 0:COLUMNS].astype(np.float32)
    rays = np.stack([(u - COLUMNS / 2) / COLUMNS, (v - ROWS / 2) / COLUMNS], axis=-1)
    depth = np.asarray(0.5 + v / ROWS, dtype=np.float32)
    return rays, depth, RigidMotion(np.eye(3), np.array(translation))


def lines(rays: Float32Array, depth: Float32Array, motion: RigidMotion) -> tuple[MovedPoints, Line]:
    moved = moved_cells(rays, depth, motion)
    slope = moved.slope * np.float32(FOCAL_PX)
    length = np.linalg.norm(slope, axis=-1)
    direction = np.where(length[..., None] > 1e-6, slope / np.maximum(length[..., None], 1e-6), (1.0, 0.0))
    x, y = (np.asarray(direction[..., axis], dtype=np.float32) for axis in (0, 1))
    return MovedPoints(moved.x, moved.y, moved.nearness), Line(x, y, length.astype(np.float32))


def remaining(
    rays: Float32Array,
    depth: Float32Array,
    motion: RigidMotion,
    turn: tuple[float, float, float],
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Float32Array:
    """What a further motion adds to the flow."""
    true = RigidMotion(so3_exp(np.array(turn)) @ motion.rotation, motion.translation + shift)
    return np.asarray(
        rigid_flow_px(rays, depth, true, FOCAL_PX) - rigid_flow_px(rays, depth, motion, FOCAL_PX), np.float32
    )


def trust() -> Float32Array:
    return np.ones((ROWS, COLUMNS), np.float32)


ANGLE = st.floats(-0.004, 0.004)


@given(ANGLE, ANGLE, ANGLE)
def test_a_turn_is_found_where_nothing_has_parallax(x: float, y: float, z: float) -> None:
    rays, depth, motion = scene()
    flow = remaining(rays, depth, motion, (x, y, z))
    points, line = lines(rays, depth, motion)
    found = common_motion_px(flow, trust(), points, line, (FOCAL_PX, FOCAL_PX))
    assert np.abs(found - flow).max() < 0.05 + 0.08 * np.abs(flow).max()


def test_a_turn_and_a_shift_under_parallax_leave_nothing_across() -> None:
    rays, depth, motion = scene((0.05, 0.0, 0.3))
    flow = remaining(rays, depth, motion, (0.002, -0.003, 0.001), (0.0, 0.01, 0.0))
    points, line = lines(rays, depth, motion)
    left = flow - common_motion_px(flow, trust(), points, line, (FOCAL_PX, FOCAL_PX))
    across = left[..., 1] * line.x - left[..., 0] * line.y
    before = flow[..., 1] * line.x - flow[..., 0] * line.y
    assert np.abs(across).mean() < 0.1 * np.abs(before).mean()


def test_what_moves_by_itself_stays() -> None:
    rays, depth, motion = scene((0.05, 0.0, 0.3))
    flow = remaining(rays, depth, motion, (0.002, -0.003, 0.001))
    mover = (slice(10, 22), slice(30, 48))
    flow[mover] += (3.0, 4.0)
    points, line = lines(rays, depth, motion)
    left = flow - common_motion_px(flow, trust(), points, line, (FOCAL_PX, FOCAL_PX))
    assert np.linalg.norm(left[mover], axis=-1).mean() == pytest.approx(5.0, abs=0.8)
    elsewhere = np.ones((ROWS, COLUMNS), np.bool_)
    elsewhere[mover] = False
    across = left[..., 1] * line.x - left[..., 0] * line.y
    assert np.abs(across[elsewhere]).mean() < 0.3


def test_without_trust_or_flow_nothing_is_taken_off() -> None:
    rays, depth, motion = scene((0.0, 0.0, 0.3))
    points, line = lines(rays, depth, motion)
    still = np.zeros((ROWS, COLUMNS, 2), np.float32)
    assert np.abs(common_motion_px(still, trust(), points, line, (FOCAL_PX, FOCAL_PX))).max() == 0.0
    wild = np.random.default_rng(0).normal(0, 5, still.shape).astype(np.float32)
    assert np.abs(common_motion_px(wild, trust() * 0, points, line, (FOCAL_PX, FOCAL_PX))).max() == 0.0
