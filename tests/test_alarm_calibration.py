from __future__ import annotations

import json
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
from difference_detector import DifferenceDetector

from viflow_anomaly import alarm_calibration
from viflow_anomaly.alarm_calibration import (
    MAX_FILE_BYTES,
    AlarmCalibration,
    calibrated,
    digest,
    make_calibration,
    read_calibration,
    write_calibration,
)
from viflow_anomaly.alarm_footage import JudgedPair, WatchedRecording, footage_of
from viflow_anomaly.config import DetectorConfig
from viflow_anomaly.detection import ModelInfo
from viflow_anomaly.errors import ConfigError
from viflow_anomaly.pair_detector import Backend, Execution

CALM = (JudgedPair(0.5, ()),)
HALL = WatchedRecording(
    "hall",
    "cam0",
    (JudgedPair(0.5, (0.9,)), *CALM * 400, JudgedPair(0.5, (0.6,)), *CALM * 398),
    abstained=3,
    failed={"imu_gap": 2},
)
"""400 s: no alarm promises 27 an hour, one promises 43."""
YARD = WatchedRecording("yard", None, CALM, abstained=0, failed={"imu_gap": 1, "image_empty": 1})


def made(**changes: Any) -> AlarmCalibration:
    watched = [HALL, YARD]
    what: dict[str, Any] = {
        "model": ModelInfo("difference", "1", "ab" * 32),
        "execution": Execution(Backend("rule", "cpu", "f32"), None),
        "detector": DetectorConfig(),
        "budget_per_hour": 30.0,
        "confidence": 0.95,
        "block_s": 10.0,
    }
    return make_calibration(watched, footage_of(watched), **(what | changes))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    write_calibration(tmp_path / "made" / "hall.json", made())
    return tmp_path / "made" / "hall.json"


def test_it_says_what_it_was_made_with() -> None:
    calibration = made()
    assert (calibration.motion_score, calibration.promised, calibration.alarms) == (0.9001, True, 0)
    assert (calibration.pairs, calibration.abstained, calibration.regions) == (801, 3, 2)
    assert calibration.failed == {"image_empty": 1, "imu_gap": 3}
    assert calibration.hours == pytest.approx(400.5 / 3600, rel=1e-5)
    assert (calibration.blocks, calibration.block_s) == (41, 10.0)
    assert [(one.name, one.camera, one.pairs, one.regions) for one in calibration.recordings] == [
        ("hall", "cam0", 800, 2),
        ("yard", None, 1, 0),
    ]
    assert "motion_score" not in calibration.detector["regions"]
    assert "include_masks" not in calibration.detector
    assert calibration.package_version == version("viflow-anomaly")
    assert timedelta(0) <= datetime.now(UTC) - calibration.created < timedelta(minutes=5)


def test_what_is_written_is_read(path: Path) -> None:
    assert read_calibration(path) == made(detector=DetectorConfig()).model_copy(
        update={"created": read_calibration(path).created}
    )
    assert [one.name for one in path.parent.iterdir()] == ["hall.json"]


def test_the_file_holds_no_path(path: Path, tmp_path: Path) -> None:
    assert str(tmp_path) not in path.read_text()


def test_the_threshold_reaches_the_detector_and_nothing_else_changes(path: Path) -> None:
    detector = DifferenceDetector(config=DetectorConfig.model_validate({"include_masks": True}))
    changed = calibrated(detector, path)
    assert changed.config.regions.motion_score == 0.9001
    assert changed.config.include_masks is True
    back = changed.config.regions.model_copy(update={"motion_score": 0.5})
    assert changed.config.model_copy(update={"regions": back}) == detector.config
    assert detector.config.regions.motion_score == 0.5


def test_it_wins_over_a_threshold_that_was_set(path: Path) -> None:
    config = DetectorConfig.model_validate({"regions": {"motion_score": 0.6}})
    assert calibrated(DifferenceDetector(config=config), path).config.regions.motion_score == 0.9001


def test_none_leaves_the_detector_alone() -> None:
    detector = DifferenceDetector()
    assert calibrated(detector, None) is detector


# --- stale


def test_other_weights_are_refused(path: Path) -> None:
    detector = DifferenceDetector(model_info=ModelInfo("difference", "1", "cd" * 32))
    with pytest.raises(
        ConfigError, match=f"model.sha256 {'ab' * 32}, found {'cd' * 32}; run `calibrate` again"
    ) as caught:
        calibrated(detector, path)
    assert (caught.value.code, caught.value.field) == ("calibration_stale", "calibration")
    assert str(path) in caught.value.message


@pytest.mark.parametrize(
    ("execution", "words"),
    [
        (Execution(Backend("torch", "cpu", "f32"), None), "execution.network.runtime rule, found torch"),
        (Execution(Backend("rule", "cuda", "f32"), None), "execution.network.device cpu, found cuda"),
        (Execution(Backend("rule", "cpu", "bf16"), None), "execution.network.precision f32, found bf16"),
        (Execution(*[Backend("rule", "cpu", "f32")] * 2), "execution.evidence None, found nothing"),
    ],
)
def test_scores_that_were_computed_otherwise_are_refused(path: Path, execution: Execution, words: str) -> None:
    with pytest.raises(ConfigError, match=words) as caught:
        calibrated(DifferenceDetector(execution=execution), path)
    assert caught.value.code == "calibration_stale"


def test_a_file_from_before_that_was_recorded_is_refused(path: Path) -> None:
    values = json.loads(path.read_text())
    del values["execution"]
    path.write_text(json.dumps(values))
    assert read_calibration(path).execution == {}
    with pytest.raises(ConfigError, match="found rule") as caught:
        calibrated(DifferenceDetector(), path)
    assert caught.value.code == "calibration_stale"


@pytest.mark.parametrize(
    ("config", "words"),
    [
        ({"regions": {"threshold_mads": 8}}, "detector.regions.threshold_mads 6.0, found 8.0"),
        ({"correction": {"enabled": False}}, "detector.correction.enabled True, found False"),
        ({"residual": "minimum"}, "detector.residual winner, found minimum"),
    ],
)
def test_another_configuration_is_refused(path: Path, config: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words) as caught:
        calibrated(DifferenceDetector(config=DetectorConfig.model_validate(config)), path)
    assert caught.value.code == "calibration_stale"


def test_another_version_is_refused(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = version("viflow-anomaly")
    monkeypatch.setattr(alarm_calibration, "version", lambda name: "99.0")
    with pytest.raises(ConfigError, match=rf"viflow-anomaly {found}, found 99\.0") as caught:
        calibrated(DifferenceDetector(), path)
    assert caught.value.code == "calibration_stale"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda detector: detector.pop("residual"), "detector.residual nothing, found winner"),
        (lambda detector: detector.update(gone=1), "detector.gone 1, found nothing"),
    ],
)
def test_settings_that_came_or_went_are_refused(
    path: Path, change: Callable[[dict[str, Any]], None], words: str
) -> None:
    values = json.loads(path.read_text())
    change(values["detector"])
    path.write_text(json.dumps(values | {"detector_sha256": digest(values["detector"])}))
    with pytest.raises(ConfigError, match=words) as caught:
        calibrated(DifferenceDetector(), path)
    assert caught.value.code == "calibration_stale"


# --- malformed


@pytest.mark.parametrize(
    ("content", "code"),
    [
        (b"", "calibration_unreadable"),
        (b"{", "calibration_unreadable"),
        (b"\xff\xfe{}", "calibration_unreadable"),
        (b"[" * 100_000, "calibration_unreadable"),
        (b" " * (MAX_FILE_BYTES + 1), "calibration_unreadable"),
        (b"[]", "calibration_invalid"),
        (b"{}", "calibration_invalid"),
        (b'{"schema_version": "2.0"}', "calibration_version"),
        (b'{"schema_version": 1}', "calibration_version"),
    ],
)
def test_a_file_that_is_none_of_ours_is_refused(path: Path, content: bytes, code: str) -> None:
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=r"hall\.json: ") as caught:
        read_calibration(path)
    assert (caught.value.code, caught.value.field) == (code, "calibration")


def test_a_missing_file_and_a_directory_are_refused(tmp_path: Path) -> None:
    for place, reason in ((tmp_path / "missing.json", "No such file"), (tmp_path, "Is a directory")):
        with pytest.raises(ConfigError, match=reason) as caught:
            read_calibration(place)
        assert caught.value.code == "calibration_unreadable"


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("motion_score", 0.4),
        ("motion_score", 1.02),
        ("motion_score", None),
        ("motion_score", "high"),
        ("confidence", 1.0),
        ("hours", 0),
        ("model", {"name": "a", "version": "1", "sha256": "no"}),
        ("detector", {}),
        ("detector_sha256", "0" * 64),
        ("recordings", []),
        ("created", "2026-11-25T12:00:00"),
        ("other", 1),
    ],
)
def test_a_wrong_value_is_named(path: Path, key: str, value: object) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | {key: value}))
    named = "detector_sha256" if key == "detector" else key
    with pytest.raises(ConfigError, match=f"hall.json: .*{named}") as caught:
        read_calibration(path)
    assert caught.value.code == "calibration_invalid"


def test_a_number_that_is_none_is_refused(path: Path) -> None:
    path.write_text(path.read_text().replace('"motion_score": 0.9001', '"motion_score": NaN'))
    with pytest.raises(ConfigError) as caught:
        read_calibration(path)
    assert caught.value.code == "calibration_invalid"
