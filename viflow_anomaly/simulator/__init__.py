"""Simulated camera + IMU sequences with exact ground truth. Rendering needs the ``simulate`` extra (mujoco)."""
