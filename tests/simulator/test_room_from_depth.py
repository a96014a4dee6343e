"""Point clouds against the simulator: other frames' depth becomes the cloud, a frame's flow is compared."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from small_sequences import small

from viflow_anomaly.datasets.ground_truth_folder import GroundTruthFolder
from viflow_anomaly.geometry import pixel_grid, rigid_motion_flow, unproject_pixels
from viflow_anomaly.ground_truth.point_cloud import PointCloud, make_point_cloud
from viflow_anomaly.ground_truth.range_image import render_depth
from viflow_anomaly.simulator.run import simulate

MAX_DEPTH_M = 40.0


def static_points(truth: GroundTruthFolder, stamps: list[int]) -> PointCloud:
    camera = truth.camera
    rays = unproject_pixels(camera, pixel_grid(camera.height, camera.width))
    rays = np.concatenate([rays, np.ones((camera.height, camera.width, 1))], axis=-1)
    clouds = []
    for stamp in stamps:
        depth, pose = truth.depth(stamp), truth.camera_pose(stamp)
        kept = (depth < MAX_DEPTH_M) & (truth.instances(stamp) == 0)
        clouds.append((rays * depth[..., None])[kept] @ pose[:3, :3].T + pose[:3, 3])
    return make_point_cloud(np.concatenate(clouds).astype(np.float32))


@pytest.mark.parametrize("seed", [3, 11])
def test_static_flow_is_the_simulators(gl: None, tmp_path: Path, seed: int) -> None:
    sequence = simulate(small("drone", seed=seed, frames=9, width=192, height=128), tmp_path)[0]
    truth = GroundTruthFolder(sequence)
    stamps = list(truth.source_stamps)
    source, target = stamps[4], stamps[5]
    cloud = static_points(truth, [stamp for stamp in stamps if stamp != source])
    depth = render_depth(truth.camera, cloud, truth.camera_pose(source))
    motion = np.linalg.inv(truth.camera_pose(target)) @ truth.camera_pose(source)
    flow, _ = rigid_motion_flow(truth.camera, depth, motion)
    exact, valid = truth.static_flow(source, target)
    judged = valid & np.isfinite(depth) & (truth.depth(source) < MAX_DEPTH_M) & (truth.instances(source) == 0)
    assert judged.mean() > 0.5
    error = np.linalg.norm(flow - exact, axis=-1)[judged]
    assert np.median(error) < 0.03
    assert np.percentile(error, 90) < 0.1
    assert np.median(np.linalg.norm(exact, axis=-1)[judged]) > 1
