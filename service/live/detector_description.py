"""What judges the pairs, in words and numbers: configuration, limits of its settings, calibration, model cards."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import Any

from viflow_anomaly.config import RegionConfig
from viflow_anomaly.errors import ConfigError
from viflow_anomaly.pair_detector import LoadedWeights
from viflow_anomaly_service.models.table import LoadedModel


def describe_detector(model: LoadedModel) -> dict[str, Any]:
    """Plain JSON values; reads files."""
    detector, calibration = model.detector, model.calibration
    info = detector.model_info
    return {
        "model": {"name": info.name, "version": info.version, "sha256": info.sha256},
        "configuration": detector.config.model_dump(mode="json"),
        "region_settings": RegionConfig.model_json_schema()["properties"],
        "calibration": None if calibration is None else _promise(calibration),
        "cards": [card for weights in detector.loaded_weights if (card := _card(weights)) is not None],
    }


def _promise(path: Path) -> dict[str, Any] | None:
    """What the loaded calibration says; None where its file has gone since."""
    from viflow_anomaly.alarm_calibration import read_calibration  # noqa: PLC0415 - loaded only where there is one

    try:
        found = read_calibration(path)
    except ConfigError:
        return None
    wanted = ("motion_score", "budget_per_hour", "confidence", "promised", "bound_per_hour", "expected_per_hour")
    told = found.model_dump(mode="json", include={*wanted, "hours", "pairs", "alarms", "created"})
    return {**told, "recordings": [recording.name for recording in found.recordings]}


def _card(weights: LoadedWeights) -> dict[str, str] | None:
    """The bundled model card, if it is of these very weights."""
    card = files("viflow_anomaly.weights") / f"{Path(weights.name).name}.md"
    if not card.is_file():
        return None
    text = card.read_text(encoding="utf-8")
    return {"name": weights.name, "markdown": text} if weights.sha256 in text else None
