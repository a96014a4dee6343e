"""Finds independent motion in what a moving camera sees, from two frames and the IMU samples around them."""

from importlib.metadata import version

__version__ = version("viflow-anomaly")
