"""What differs between configurations, and that both ways to say it are read back as the same configuration."""

from __future__ import annotations

from pathlib import Path

from viflow_anomaly.config import DetectorConfig
from viflow_anomaly.config_changes import ChangedValue, as_environment, as_toml, changed_values
from viflow_anomaly.settings import ENVIRONMENT_PREFIX, resolve_settings

BEFORE = DetectorConfig()
AFTER = DetectorConfig.model_validate(
    {
        "include_masks": True,
        "evidence": "residual",
        "regions": {"threshold_mads": 7, "shape_rule": "oriented"},
        "quality": {"max_blur_ratio": 2.5},
    }
)


def test_only_what_differs_is_told_by_its_name() -> None:
    assert changed_values(BEFORE, BEFORE, section="detector") == []
    assert ChangedValue("detector.regions.shape_rule", "axis_aligned", "oriented") in changed_values(
        BEFORE, AFTER, section="detector"
    )
    assert len(changed_values(BEFORE, AFTER, section="detector")) == 5


def test_a_file_and_the_environment_give_the_configuration_back(tmp_path: Path) -> None:
    changes = changed_values(BEFORE, AFTER, section="detector")
    file = tmp_path / "tuned.toml"
    file.write_text(as_toml(changes), encoding="utf-8")
    assert resolve_settings(config_file=file, environment={}).detector == AFTER
    lines = as_environment(changes, prefix=ENVIRONMENT_PREFIX).splitlines()
    assert resolve_settings(environment=dict(line.split("=", 1) for line in lines)).detector == AFTER
    assert as_toml([]) == as_environment([], prefix=ENVIRONMENT_PREFIX) == ""
