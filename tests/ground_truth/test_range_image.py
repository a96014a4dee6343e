"""Depth images of point clouds against the closed form of the room they were sampled from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from room import ROOM, camera_pose, room_depth, sample_box, sample_room
from worlds import EUROC

from viflow_anomaly.ground_truth.point_cloud import PointCloud, make_point_cloud
from viflow_anomaly.ground_truth.range_image import render_depth
from viflow_anomaly.sensor_data import PinholeCamera

# EuRoC's lens at half its size: its field of view and distortion are the same.
CAMERA = EUROC.scaled_to(376, 240)
PINHOLE = PinholeCamera(fx=100.0, fy=100.0, cx=59.5, cy=39.5, width=120, height=80)
POSES = {
    "pillar ahead": camera_pose((0.1, -1.5, 1.2), 0.05, -0.1, 0.1),
    "pillar near": camera_pose((-0.9, -0.3, 1.6), -0.6, -0.3, 0.2),
    "corner of the room": camera_pose((3.0, 3.5, 1.5), 2.2, 0.3),
    "floor": camera_pose((-1.0, -2.0, 1.4), 0.4, -1.2),
}


@pytest.fixture(scope="module")
def cloud() -> PointCloud:
    return make_point_cloud(sample_room(2500))


@pytest.mark.parametrize("name", POSES)
def test_depth_is_that_of_the_room(cloud: PointCloud, name: str) -> None:
    depth, exact = render_depth(CAMERA, cloud, POSES[name]), room_depth(CAMERA, POSES[name])
    known = np.isfinite(depth)
    assert known.mean() > 0.995
    error = np.abs(depth - exact)[known] / exact[known]
    assert np.median(error) < 1e-4
    assert np.percentile(error, 95) < 0.01
    # What is wrong by more is the outline of the pillar, one pixel wide.
    assert (error > 0.05).mean() < 0.005


def test_a_noisy_scan_gives_the_room_too() -> None:
    noisy = make_point_cloud(sample_room(2500, noise_m=0.005))
    pose = POSES["pillar ahead"]
    depth, exact = render_depth(CAMERA, noisy, pose), room_depth(CAMERA, pose)
    error = (np.abs(depth - exact) / exact)[np.isfinite(depth)]
    assert np.median(error) < 0.002
    assert np.percentile(error, 95) < 0.02


def wall(z: float, half_side: float, per_m2: float, *, seed: int = 0) -> NDArray[np.float32]:
    """A square before a camera at the origin."""
    count = round(4 * half_side**2 * per_m2)
    xy = np.random.default_rng(seed).uniform(-half_side, half_side, (count, 2))
    return np.column_stack([xy, np.full(count, z)]).astype(np.float32)


@pytest.mark.parametrize("per_m2", [300, 2000, 20_000])
def test_nothing_shines_through_a_wall(per_m2: float) -> None:
    """Points are 6, 2 and 0.7 px apart on a wall at 1 m; the wall behind is seen by far more of them."""
    both = np.concatenate([wall(1.0, 1.0, per_m2), wall(4.0, 5.0, 2000, seed=1)])
    depth = render_depth(PINHOLE, make_point_cloud(both), np.eye(4))
    np.testing.assert_allclose(depth, 1.0, rtol=1e-3)


def test_an_outline_neither_grows_nor_shrinks_by_much() -> None:
    both = np.concatenate([wall(2.0, 0.5, 3000), wall(4.0, 5.0, 2000, seed=1)])
    depth = render_depth(PINHOLE, make_point_cloud(both), np.eye(4))
    edge = 0.5 * 100.0 / 2.0
    u, v = np.meshgrid(np.arange(120) - 59.5, np.arange(80) - 39.5)
    inside = np.maximum(np.abs(u), np.abs(v))
    np.testing.assert_allclose(depth[inside < edge - 2], 2.0, rtol=1e-3)
    np.testing.assert_allclose(depth[inside > edge + 2], 4.0, rtol=1e-3)


def test_only_what_is_surrounded_is_filled() -> None:
    """A wall ends in the picture: beyond its edge nothing is known; a small gap in it is closed, a wide one not."""
    points = wall(2.0, 0.5, 3000)
    in_gap = (np.abs(points[:, 0] + 0.25) < 0.02) & (np.abs(points[:, 1]) < 0.02)
    in_hole = (np.abs(points[:, 0] - 0.2) < 0.15) & (np.abs(points[:, 1]) < 0.15)
    depth = render_depth(PINHOLE, make_point_cloud(points[~in_gap & ~in_hole]), np.eye(4))
    known = np.isfinite(depth)
    u, v = np.meshgrid(np.arange(120) - 59.5, np.arange(80) - 39.5)
    far_out = np.maximum(np.abs(u), np.abs(v)) > 25 + 1
    assert not known[far_out].any()
    assert known[(np.abs(u + 12.5) < 1) & (np.abs(v) < 1)].all()
    assert not known[(np.abs(u - 10) < 4) & (np.abs(v) < 4)].any()


def test_what_lies_behind_or_far_off_the_axis_is_not_seen() -> None:
    """This lens folds at 45 degrees: k1 = -0.33 turns rays beyond back into the picture."""
    folding = replace(PINHOLE, distortion_model="radtan", distortion_coeffs=(-0.3334, 0.0, 0.0, 0.0))
    rng = np.random.default_rng(0)
    aside = np.column_stack([rng.uniform(1.1, 3.0, 20_000), rng.uniform(-1, 1, 20_000), np.ones(20_000)])
    behind = wall(-2.0, 1.0, 3000)
    depth = render_depth(folding, make_point_cloud(np.concatenate([aside, behind]).astype(np.float32)), np.eye(4))
    assert not np.isfinite(depth).any()


def test_the_border_of_the_picture_is_known(cloud: PointCloud) -> None:
    depth = render_depth(CAMERA, cloud, POSES["corner of the room"])
    for border in (depth[0], depth[-1], depth[:, 0], depth[:, -1]):
        assert np.isfinite(border).all()


def test_stray_points_are_left_out() -> None:
    stray = np.random.default_rng(3).uniform((-1, -1, 0.5), (1, 1, 2.5), (40, 3))
    room = sample_box(ROOM, 2500, np.random.default_rng(0))
    cloud = make_point_cloud(np.concatenate([room, stray.astype(np.float32)]))
    assert len(cloud) <= len(room)
    assert len(cloud) > 0.999 * len(room)


def test_spacing_is_what_the_density_says() -> None:
    cloud = make_point_cloud(wall(1.0, 2.0, 2500))
    assert np.median(cloud.spacing_m) == pytest.approx(0.02, rel=0.2)


def test_a_cloud_in_its_own_frame_is_moved_to_the_world() -> None:
    T_world_cloud = camera_pose((1.0, 2.0, 3.0), 0.5)
    moved = make_point_cloud(wall(2.0, 2.0, 1000), T_world_cloud)
    np.testing.assert_allclose(render_depth(PINHOLE, moved, T_world_cloud), 2.0, rtol=1e-3)
