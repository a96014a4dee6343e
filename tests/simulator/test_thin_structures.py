"""Thin structures are thin, clear of the camera, in view, and change nothing else."""

from __future__ import annotations

import numpy as np
import pytest
from small_sequences import small

from viflow_anomaly.errors import ConfigError
from viflow_anomaly.simulator.scene import Solid
from viflow_anomaly.simulator.sequence import build_world
from viflow_anomaly.simulator.thin_structures import KINDS


def same(first: Solid, second: Solid) -> bool:
    places = np.array_equal(first.position_m, second.position_m) and np.array_equal(first.rotation, second.rotation)
    return places and (first.shape, first.size_m, first.material) == (second.shape, second.size_m, second.material)


@pytest.mark.parametrize("kind", KINDS)
def test_every_part_is_a_thin_bar(kind: object) -> None:
    assert callable(kind)
    for seed in range(5):
        parts = kind(np.random.default_rng(seed), "bark")
        assert len(parts) >= 2
        for part in parts:
            thinnest, middle, longest = np.sort(part.half_extents_m())
            assert thinnest <= middle <= 0.15
            assert longest >= 2.5 * middle
            np.testing.assert_allclose(part.rotation @ part.rotation.T, np.eye(3), atol=1e-12)
            assert np.linalg.det(part.rotation) == pytest.approx(1.0)


@pytest.mark.parametrize(("rig", "clearance_m"), [("drone", 0.49), ("car", 2.1)])
@pytest.mark.parametrize("seed", range(2))
def test_they_are_added_clear_of_the_camera_to_the_world_as_it_was(rig: str, clearance_m: float, seed: int) -> None:
    plain = build_world(small(rig, frames=10), seed)
    full = build_world(small(rig, frames=10, thin_structures=12), seed)
    count = len(plain.scene.solids)
    assert all(same(*pair) for pair in zip(plain.scene.solids, full.scene.solids[:count], strict=True))
    np.testing.assert_array_equal(plain.camera_poses, full.camera_poses)
    added = full.scene.solids[count:]
    assert len(added) > 25
    path = full.camera_poses[:, :3, 3]
    assert all(solid.clearance_m(path) >= clearance_m for solid in added)
    for mover in full.scene.movers:
        assert all(solid.clearance_m(mover.positions_m) > mover.radius_m() for solid in added)


@pytest.mark.parametrize("rig", ["drone", "car"])
def test_they_are_in_view_at_several_depths(rig: str) -> None:
    world = build_world(small(rig, frames=10, thin_structures=30, movers=(0, 0)), 3)
    added = world.scene.solids[-len(world.scene.solids) // 3 :]
    pose, camera = world.camera_poses[0], world.rig.camera
    x, y, z = np.stack([(solid.position_m - pose[:3, 3]) @ pose[:3, :3] for solid in added]).T
    ahead = z > 0.5
    u, v = camera.fx * x[ahead] / z[ahead] + camera.cx, camera.fy * y[ahead] / z[ahead] + camera.cy
    seen = (u > 0) & (u < camera.width) & (v > -10) & (v < camera.height + 10)
    assert seen.sum() > 10
    assert z[ahead][seen].max() > 2 * z[ahead][seen].min()


def test_without_them_a_sequence_is_recorded_as_before() -> None:
    assert "thin_structures" not in small("drone").sequence_record(0)
    assert small("drone", thin_structures=5).sequence_record(0)["thin_structures"] == 5
    for count in (-1, 301):
        with pytest.raises(ConfigError):
            small("drone", thin_structures=count)
