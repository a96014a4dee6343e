"""From a configuration to a network."""

from __future__ import annotations

from typing import Literal

import pytest
import torch

from viflow_anomaly.config import ModelConfig, MotionWindowConfig, ViewConfig
from viflow_anomaly.errors import ConfigError
from viflow_anomaly.model.builder import build_model
from viflow_anomaly.model.calibrated import CalibratedViflow
from viflow_anomaly.model.compact import CompactViflow
from viflow_anomaly.model.layers import ConvolutionalViflow
from viflow_anomaly.model.paper import PaperViflow


def test_the_same_seed_gives_the_same_weights_and_another_seed_others() -> None:
    first, second, other = (build_model(ModelConfig(), seed=seed).state_dict() for seed in (5, 5, 6))
    assert all(torch.equal(value, second[name]) for name, value in first.items())
    assert not torch.equal(first["encode4.0.weight"], other["encode4.0.weight"])


def test_the_global_generator_is_left_alone() -> None:
    before = torch.get_rng_state()
    build_model(ModelConfig(), seed=5)
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize(("preset", "kind"), [("compact", CompactViflow), ("calibrated", CalibratedViflow)])
def test_a_convolutional_preset_is_built_as_configured(
    preset: Literal["compact", "calibrated"], kind: type[ConvolutionalViflow]
) -> None:
    window = MotionWindowConfig(samples_before=2, samples_between=6)
    config = ModelConfig(preset=preset, hypotheses=4, motion_window=window, view=ViewConfig(focal_px=100.0))
    network = build_model(config)
    assert isinstance(network, kind)
    assert (network.hypotheses, network.focal_px) == (4, 100.0)
    with torch.no_grad():
        flow = network(torch.rand(1, 1, 32, 32), torch.zeros(1, 8, 6), torch.tensor([0.1])).flow_px
    assert flow.shape == (1, 4, 2, 8, 8)


def test_paper_is_built_as_configured() -> None:
    config = ModelConfig(
        preset="paper",
        hypotheses=4,
        view=ViewConfig(mode="center_crop", crop_size=64),
        motion_window=MotionWindowConfig(layout="paper_euroc"),
    )
    with torch.device("meta"):
        network = build_model(config).to("meta")
        flow = network(torch.empty(2, 1, 64, 64), torch.empty(2, 50, 6), torch.empty(2)).flow_px
    assert isinstance(network, PaperViflow)
    assert flow.shape == (2, 4, 2, 64, 64)


@pytest.mark.parametrize("preset", ["compact", "calibrated"])
def test_a_crop_of_broken_cells_is_refused(preset: Literal["compact", "calibrated"]) -> None:
    config = ModelConfig(preset=preset, view=ViewConfig(mode="center_crop", crop_size=100))
    with pytest.raises(ConfigError, match="multiple of 32, found 100") as caught:
        build_model(config)
    assert (caught.value.code, caught.value.field) == ("config_invalid", "view.crop_size")


@pytest.mark.parametrize("view", [ViewConfig(mode="whole"), ViewConfig(mode="center_crop", crop_size=225)])
def test_the_paper_preset_needs_its_crop(view: ViewConfig) -> None:
    with pytest.raises(ConfigError, match=r"needs view\.mode 'center_crop'.*found 'whole' of 224|of 225") as caught:
        build_model(ModelConfig(preset="paper", view=view))
    assert (caught.value.code, caught.value.field) == ("config_invalid", "view")
