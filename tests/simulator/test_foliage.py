"""Leaves are small, lit on both sides, clear of the camera, in view, and change nothing else."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from small_sequences import small

from viflow_anomaly.datasets.ground_truth_folder import GroundTruthFolder
from viflow_anomaly.errors import ConfigError
from viflow_anomaly.simulator.scene import Strip
from viflow_anomaly.simulator.sequence import build_world, write_sequence

MAX_LEAF_M = 0.25


def leaves_of(rig: str, seed: int, count: int = 12) -> tuple[Strip, ...]:
    plain = build_world(small(rig, frames=6), seed)
    return build_world(small(rig, frames=6, foliage=count), seed).scene.strips[len(plain.scene.strips) :]


@pytest.mark.parametrize("rig", ["drone", "car"])
def test_every_leaf_is_small_and_has_a_back(rig: str) -> None:
    clouds = leaves_of(rig, 1)
    assert len(clouds) > 4
    for cloud in clouds:
        triangles = cloud.vertices_m[cloud.faces.astype(int)]
        assert (triangles.max(axis=1) - triangles.min(axis=1)).max() < 2 * MAX_LEAF_M
        fronts, backs = np.split(triangles, 2)
        np.testing.assert_array_equal(fronts, backs[:, ::-1])
        normals = [np.cross(one[:, 1] - one[:, 0], one[:, 2] - one[:, 0]) for one in (fronts, backs)]
        np.testing.assert_allclose(normals[0], -normals[1], atol=1e-12)


@pytest.mark.parametrize(("rig", "clearance_m"), [("drone", 0.4), ("car", 1.5)])
def test_they_grow_clear_of_the_camera_in_the_world_as_it_was(rig: str, clearance_m: float) -> None:
    plain = build_world(small(rig, frames=6), 2)
    full = build_world(small(rig, frames=6, foliage=12), 2)
    np.testing.assert_array_equal(plain.camera_poses, full.camera_poses)
    assert [one.material for one in full.scene.solids[: len(plain.scene.solids)]] == [
        one.material for one in plain.scene.solids
    ]
    path = full.camera_poses[:, :3, 3]
    for cloud in full.scene.strips[len(plain.scene.strips) :]:
        nearest = np.linalg.norm(cloud.vertices_m[:, None] - path[None], axis=-1).min()
        assert nearest > clearance_m - MAX_LEAF_M


def test_they_are_seen_at_several_depths_and_do_not_move(gl: None, tmp_path: Path) -> None:
    config = small("car", frames=2, foliage=40, movers=(0, 0))
    write_sequence(config, 3, tmp_path)
    plain_folder = tmp_path / "plain"
    write_sequence(small("car", frames=2, movers=(0, 0)), 3, plain_folder)
    with_leaves, without = (GroundTruthFolder.find(folder) for folder in (tmp_path, plain_folder))
    assert with_leaves is not None
    assert without is not None
    stamp = min(int(path.stem) for path in (with_leaves.folder / "depth").glob("*.png"))
    near, far = with_leaves.depth(stamp), without.depth(stamp)
    covered = near < far - 0.2
    assert covered.mean() > 0.02
    assert np.ptp(near[covered]) > 3.0
    assert not with_leaves.instances(stamp).any()


def test_without_them_a_sequence_is_recorded_as_before() -> None:
    assert "foliage" not in small("drone").sequence_record(0)
    assert small("drone", foliage=5).sequence_record(0)["foliage"] == 5
    for count in (-1, 101):
        with pytest.raises(ConfigError):
            small("drone", foliage=count)
