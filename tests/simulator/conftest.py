"""Small sequences that several tests read, and a skip where no OpenGL is to be had."""

from __future__ import annotations

from pathlib import Path

import pytest
from small_sequences import small

from viflow_anomaly.errors import MissingDependencyError
from viflow_anomaly.sensor_data import PinholeCamera
from viflow_anomaly.simulator.rendering import SceneRenderer
from viflow_anomaly.simulator.run import simulate
from viflow_anomaly.simulator.scene import Scene


@pytest.fixture(scope="session")
def gl() -> None:
    camera = PinholeCamera(fx=30, fy=30, cx=16, cy=16, width=32, height=32)
    empty = Scene(materials=(), solids=(), lights=(), ambient=0.5, headlight=0.0, far_m=10.0)
    try:
        with SceneRenderer(empty, camera, supersampling=1):
            pass
    except MissingDependencyError as err:
        pytest.skip(f"simulated pictures cannot be drawn here: {err.message}")


@pytest.fixture(scope="session", params=[("drone", 7), ("car", 1)], ids=["drone", "car"])
def sequence(request: pytest.FixtureRequest, gl: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One sequence of each rig with ground truth; movers are in view at these seeds."""
    rig, seed = request.param
    return simulate(small(rig, seed=seed), tmp_path_factory.mktemp("sequence"))[0]
