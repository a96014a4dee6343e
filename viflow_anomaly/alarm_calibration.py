"""The file of a false-alarm budget: the threshold, what it promises, and what it was made with.

A threshold holds for the weights, the detector's configuration and the code that it was found with. A file that was
made with others is refused, never adapted.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, Self, TypeVar

from pydantic import AwareDatetime, Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt, model_validator

from viflow_anomaly.alarm_budget import ScoredFootage, choose_threshold
from viflow_anomaly.alarm_footage import WatchedRecording
from viflow_anomaly.checkpoint_record import source_commit, write_atomically
from viflow_anomaly.config import DetectorConfig, FrozenConfig
from viflow_anomaly.detection import ModelInfo
from viflow_anomaly.errors import ConfigError
from viflow_anomaly.pair_detector import Execution, PairDetector

SCHEMA_VERSION = "1.0"
MAX_FILE_BYTES = 4 * 1024 * 1024
ABSENT = "nothing"
_SIGNIFICANT_DIGITS = 6


AnyDetector = TypeVar("AnyDetector", bound=PairDetector)


class CalibratedModel(FrozenConfig):
    """Which weights the scores are of."""

    name: str
    version: str
    sha256: str = Field(pattern="^[0-9a-f]{64}$")


class CalibratedRecording(FrozenConfig):
    """One recording of the footage; ``failed``: pairs that could not be used, by error code."""

    name: str
    camera: str | None
    hours: NonNegativeFloat
    pairs: NonNegativeInt
    abstained: NonNegativeInt
    failed: dict[str, PositiveInt]
    regions: NonNegativeInt


class AlarmCalibration(FrozenConfig):
    """What ``calibrate`` writes; rates are alarms (regions of a pair) an hour of judged footage.

    Attributes:
        motion_score: for ``detector.regions.motion_score``.
        promised: with ``confidence`` the rate is within the budget; False: the footage was too short to say so.
        bound_per_hour, expected_per_hour, lowest_bound_per_hour, hours_needed, alarms, alarm_blocks, clump: as
            ``ThresholdChoice``.
        hours, pairs: judged; ``abstained`` and ``failed`` pairs are in neither.
        regions: labelled as motion at the lowest threshold.
        execution: what computed network and evidence head, on what, in which precision; empty in older files.
        detector: the configuration that the scores depend on; ``detector_sha256``: its digest.
        package_version: of viflow-anomaly.
        commit: of its source tree, where it ran from one.
    """

    schema_version: Literal["1.0"] = "1.0"
    motion_score: float = Field(ge=0.5, le=1.01)
    budget_per_hour: PositiveFloat
    confidence: float = Field(gt=0, lt=1)
    promised: bool
    bound_per_hour: PositiveFloat
    expected_per_hour: PositiveFloat
    lowest_bound_per_hour: PositiveFloat
    hours_needed: PositiveFloat
    hours: PositiveFloat
    pairs: PositiveInt
    abstained: NonNegativeInt
    failed: dict[str, PositiveInt]
    alarms: NonNegativeInt
    regions: NonNegativeInt
    blocks: PositiveInt
    block_s: PositiveFloat
    alarm_blocks: NonNegativeInt
    clump: float = Field(ge=1)
    model: CalibratedModel
    execution: dict[str, dict[str, str] | None] = Field(default_factory=dict)
    detector: dict[str, Any]
    detector_sha256: str = Field(pattern="^[0-9a-f]{64}$")
    package_version: str
    commit: str | None
    created: AwareDatetime
    recordings: tuple[CalibratedRecording, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _digest_is_the_configurations(self) -> Self:
        if (found := digest(self.detector)) != self.detector_sha256:
            raise ValueError(f"detector_sha256: expected {found} for this detector, found {self.detector_sha256}")
        return self


def make_calibration(
    watched: Sequence[WatchedRecording],
    footage: ScoredFootage,
    *,
    model: ModelInfo,
    execution: Execution,
    detector: DetectorConfig,
    budget_per_hour: float,
    confidence: float,
    block_s: float,
) -> AlarmCalibration:
    """Choose the threshold and say what it was made with.

    Args:
        watched: what the recordings gave.
        footage: its scores in blocks of ``block_s``.
        model, execution, detector: whose scores they are.
        budget_per_hour, confidence: as ``choose_threshold``.
    """
    choice = choose_threshold(footage, budget_per_hour=budget_per_hour, confidence=confidence)
    rates = ("clump", "bound_per_hour", "expected_per_hour", "lowest_bound_per_hour", "hours_needed")
    chosen = choice._asdict()
    configuration = what_scores_depend_on(detector)
    return AlarmCalibration(
        **(chosen | {name: _rounded(chosen[name]) for name in rates}),
        budget_per_hour=budget_per_hour,
        confidence=confidence,
        hours=_rounded(footage.hours),
        pairs=sum(len(one.judged) for one in watched),
        abstained=sum(one.abstained for one in watched),
        failed=dict(sorted(sum((Counter(one.failed) for one in watched), Counter[str]()).items())),
        regions=footage.scores.size,
        blocks=footage.block_hours.size,
        block_s=block_s,
        model=CalibratedModel.model_validate(asdict(model)),
        execution=execution.as_mapping(),
        detector=configuration,
        detector_sha256=digest(configuration),
        package_version=version("viflow-anomaly"),
        commit=source_commit(),
        created=datetime.now(UTC).replace(microsecond=0),
        recordings=tuple(map(_described, watched)),
    )


def write_calibration(path: Path, calibration: AlarmCalibration) -> None:
    """The whole file or none."""
    write_atomically(path, (calibration.model_dump_json(indent=2) + "\n").encode())


def read_calibration(path: Path) -> AlarmCalibration:
    """What a file says; whether it fits is for ``calibrated`` to tell.

    Raises:
        ConfigError: ``calibration_unreadable``, ``calibration_version``, ``calibration_invalid``.
    """
    try:
        with path.open("rb") as file:
            data = file.read(MAX_FILE_BYTES + 1)
    except OSError as err:
        raise _refusal(f"{path}: expected a readable file of `calibrate`, found: {err.strerror}") from err
    if len(data) > MAX_FILE_BYTES:
        raise _refusal(f"{path}: expected at most {MAX_FILE_BYTES} bytes, found more")
    try:
        values = json.loads(data)
    except (ValueError, RecursionError) as err:
        raise _refusal(f"{path}: expected JSON, found: {err}") from err
    found = values.get("schema_version") if isinstance(values, dict) else None
    if found is not None and found != SCHEMA_VERSION:
        raise _refusal(
            f"{path}: expected schema_version {SCHEMA_VERSION!r}, found {found!r:.80}", "calibration_version"
        )
    try:
        return AlarmCalibration.from_mapping(values, where=str(path))
    except ConfigError as err:
        raise _refusal(err.message, "calibration_invalid") from err


def calibrated(detector: AnyDetector, path: Path | None) -> AnyDetector:
    """The detector with the threshold of the file; None: the detector as it is.

    Raises:
        ConfigError: ``calibration_stale``: made with other weights, runtime, precision, configuration or version;
            as ``read_calibration``.
    """
    if path is None:
        return detector
    calibration = read_calibration(path)
    require_current(calibration, detector, where=path)
    regions = detector.config.regions.model_copy(update={"motion_score": calibration.motion_score})
    return detector.with_config(detector.config.model_copy(update={"regions": regions}))


def require_current(calibration: AlarmCalibration, detector: PairDetector, *, where: Path) -> None:
    """Nothing, where the scores of ``detector`` are those that the calibration was made of.

    Raises:
        ConfigError: ``calibration_stale`` with the first thing that differs.
    """
    made_with = {
        "model.sha256": calibration.model.sha256,
        "model.version": calibration.model.version,
        **flattened("execution", calibration.execution),
        **flattened("detector", calibration.detector),
        "viflow-anomaly": calibration.package_version,
    }
    now = {
        "model.sha256": detector.model_info.sha256,
        "model.version": detector.model_info.version,
        **flattened("execution", detector.execution.as_mapping()),
        **flattened("detector", what_scores_depend_on(detector.config)),
        "viflow-anomaly": version("viflow-anomaly"),
    }
    for key in (*made_with, *now):
        before, found = made_with.get(key, ABSENT), now.get(key, ABSENT)
        if before != found:
            raise stale(where, f"{key} {before}", str(found))


def stale(where: Path, expected: str, found: str) -> ConfigError:
    """The error of a calibration that says nothing of what is to be run."""
    return _refusal(
        f"{where}: expected what it was made with, {expected}, found {found}; run `calibrate` again",
        "calibration_stale",
    )


def what_scores_depend_on(config: DetectorConfig) -> dict[str, Any]:
    """The configuration as plain JSON values, without the threshold itself and without what is only written out."""
    return config.model_dump(mode="json", exclude={"include_masks": True, "regions": {"motion_score"}})


def digest(values: Mapping[str, Any]) -> str:
    """sha256 of a mapping's JSON, keys sorted."""
    return hashlib.sha256(json.dumps(values, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def flattened(place: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Dotted keys: ``detector.regions.max_regions``."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        inner = f"{place}.{key}"
        flat |= flattened(inner, value) if isinstance(value, Mapping) else {inner: value}
    return flat


def _described(watched: WatchedRecording) -> CalibratedRecording:
    return CalibratedRecording(
        name=watched.name,
        camera=watched.camera,
        hours=_rounded(watched.seconds / 3600.0),
        pairs=len(watched.judged),
        abstained=watched.abstained,
        failed=dict(watched.failed),
        regions=sum(len(pair.scores) for pair in watched.judged),
    )


def _rounded(value: float) -> float:
    return float(f"{value:.{_SIGNIFICANT_DIGITS}g}")


def _refusal(message: str, code: str = "calibration_unreadable") -> ConfigError:
    return ConfigError(message, code=code, field="calibration")
