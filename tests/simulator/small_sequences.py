"""The configuration of the small sequences that these tests simulate."""

from __future__ import annotations

from viflow_anomaly.simulator.config import SimulatorConfig


def small(rig: str, **changes: object) -> SimulatorConfig:
    """64x48, four frames, two movers, an IMU without errors."""
    settings = {"rig": rig, "frames": 4, "width": 64, "height": 48, "movers": (2, 2), "imu_errors": False, **changes}
    return SimulatorConfig.from_mapping(settings, where="test")
