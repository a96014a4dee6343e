"""A frame pair as every network and runtime wants it: two views and a motion window, still numpy."""

from __future__ import annotations

from dataclasses import dataclass

from viflow_anomaly.config import ModelConfig
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.motion_input import MotionWindow, build_motion_window
from viflow_anomaly.motor_input import motor_input
from viflow_anomaly.sensor_data import FramePair, Uint8Array
from viflow_anomaly.view import InternalView, make_view


@dataclass(frozen=True, eq=False)
class ModelInput:
    """One pair.

    Attributes:
        source, target: [h, w] uint8 views.
        window: its ``values`` are [T, 6].
        view: how the views came from the source image.
        motor: [M] for the network's motor stream, None where it has none.
        rotation_known: the network sees the gyro; without, it predicts no rotation.
    """

    source: Uint8Array
    target: Uint8Array
    window: MotionWindow
    view: InternalView
    motor: Float32Array | None = None
    rotation_known: bool = True


def prepare(pair: FramePair, config: ModelConfig) -> ModelInput:
    """Render the views of a pair and build its motion window.

    Raises:
        InvalidInputError: as ``make_view``, ``build_motion_window`` and ``motor_input``.
    """
    height, width = pair.source.image.shape
    view = make_view(config.view, width=width, height=height, camera=pair.camera)
    # The calibrated preset takes its rotation from the gyro, and the correction finds the rest.
    window = build_motion_window(pair, config.motion_window, gyro_alone=config.preset == "calibrated")
    motor = motor_input(pair, config)
    source, target = (view.render(frame.image) for frame in (pair.source, pair.target))
    return ModelInput(source, target, window, view, motor, rotation_known=config.uses_imu)
