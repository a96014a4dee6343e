"""Where numbers meet classes: a ModelConfig becomes a network."""

from __future__ import annotations

import torch
from torch import nn

from viflow_anomaly.config import ModelConfig
from viflow_anomaly.errors import ConfigError
from viflow_anomaly.model.calibrated import CalibratedViflow
from viflow_anomaly.model.compact import CompactViflow
from viflow_anomaly.model.layers import COARSEST_STRIDE
from viflow_anomaly.model.paper import PaperViflow

CONVOLUTIONAL_PRESETS: dict[
    str, tuple[type[CompactViflow] | type[CalibratedViflow], tuple[int, int, int, int], int, int]
] = {
    "compact": (CompactViflow, (24, 48, 112, 128), 256, 128),
    "calibrated": (CalibratedViflow, (16, 32, 72, 96), 128, 64),
}
"""Network, channels at strides 4, 8, 16, 32, and widths of the motion encoder's hidden layers and code."""


def build_model(config: ModelConfig, *, seed: int = 0) -> nn.Module:
    """A freshly initialised network; the same seed gives the same weights and leaves the global generator alone.

    Raises:
        ConfigError: ``config_invalid``: a crop that is no multiple of 32, or the paper preset without its crop;
            ``motor_not_fitted``: a motor stream whose number of inputs only a training knows.
    """
    if config.motor_source is not None and not config.motor_numbers:
        raise ConfigError(
            f"model.motor: expected values fitted by a training for the motion inputs {config.motion_inputs!r}, "
            "found none",
            code="motor_not_fitted",
            field="model.motor",
        )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        if config.preset == "paper":
            return _build_paper(config)
        _require_crop_of_whole_cells(config)
        network, widths, motion_width, code_width = CONVOLUTIONAL_PRESETS[config.preset]
        return network(
            widths=widths,
            motion_width=motion_width,
            code_width=code_width,
            motion_rows=config.motion_window.rows if config.uses_imu else 0,
            motor_numbers=config.motor_numbers,
            interval_rows=config.motion_window.samples_between,
            hypotheses=config.hypotheses,
            focal_px=config.view.focal_px,
        )


def _require_crop_of_whole_cells(config: ModelConfig) -> None:
    side = config.view.crop_size
    if config.view.mode == "center_crop" and side % COARSEST_STRIDE:
        raise ConfigError(
            f"the {config.preset} preset needs a view.crop_size that is a multiple of {COARSEST_STRIDE}, found {side}",
            code="config_invalid",
            field="view.crop_size",
        )


def _build_paper(config: ModelConfig) -> nn.Module:
    side = config.view.crop_size
    if config.view.mode != "center_crop" or side % 32:
        raise ConfigError(
            "the paper preset needs view.mode 'center_crop' with a crop_size that is a multiple of 32, "
            f"found {config.view.mode!r} of {side}",
            code="config_invalid",
            field="view",
        )
    return PaperViflow(
        motion_rows=config.motion_window.rows if config.uses_imu else 0,
        motor_numbers=config.motor_numbers,
        hypotheses=config.hypotheses,
        image_size=(side, side),
    )
