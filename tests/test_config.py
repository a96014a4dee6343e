"""What the sections refuse beyond the type of a single value."""

from __future__ import annotations

from typing import Literal

import pytest

from viflow_anomaly.config import ModelConfig, MotionWindowConfig
from viflow_anomaly.errors import ConfigError

PaperLayout = Literal["paper_euroc", "paper_kitti"]


@pytest.mark.parametrize("preset", ["compact", "calibrated"])
@pytest.mark.parametrize("layout", ["paper_euroc", "paper_kitti"])
def test_a_convolutional_preset_needs_the_resampled_window(preset: str, layout: str) -> None:
    values = {"preset": preset, "motion_window": {"layout": layout}}
    with pytest.raises(ConfigError, match=f"'resampled' for the preset '{preset}', found '{layout}'") as caught:
        ModelConfig.from_mapping(values, where="--set")
    assert caught.value.code == "config_invalid"


@pytest.mark.parametrize("layout", ["paper_euroc", "paper_kitti"])
def test_the_papers_preset_takes_the_papers_windows(layout: PaperLayout) -> None:
    window = MotionWindowConfig(layout=layout)
    assert ModelConfig(preset="paper", motion_window=window).motion_window.rows == {"paper_euroc": 50}.get(layout, 20)


@pytest.mark.parametrize("preset", ["paper", "compact", "calibrated"])
def test_every_preset_takes_the_resampled_window(preset: Literal["paper", "compact", "calibrated"]) -> None:
    assert ModelConfig(preset=preset).motion_window.layout == "resampled"
