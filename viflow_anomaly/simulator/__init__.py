"""Simulated camera + IMU sequences with exact ground truth. Rendering needs the ``simulate`` extra (mujoco)."""

from viflow_anomaly.simulator.config import SimulatorConfig
from viflow_anomaly.simulator.run import simulate

__all__ = ["SimulatorConfig", "simulate"]
