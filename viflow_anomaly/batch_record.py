"""``run.json``: what a batch run was asked for, with what it answered, and what it came to."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from viflow_anomaly.batch_files import JournalLine, Stamps
from viflow_anomaly.config import DetectorConfig, FrozenConfig
from viflow_anomaly.datasets.camera_json import camera_to_mapping
from viflow_anomaly.datasets.recording import Recording
from viflow_anomaly.detection import ModelInfo
from viflow_anomaly.errors import InvalidInputError
from viflow_anomaly.pair_detector import Execution

# What a resumed run must have in common with the run it goes on with.
_DECISIVE = (
    "model.sha256",
    "model.version",  # names the evidence head, too
    "execution",
    "configuration.detector",
    "options.look_ahead",
    "options.tracking",
    "options.rig_estimate",
    "recording.camera",
    "versions.viflow-anomaly",
)
_VERSIONED_PACKAGES = (
    "viflow-anomaly",
    "torch",
    "openvino",
    "onnxruntime",
    "numpy",
    "opencv-python-headless",
    "scikit-image",
)


@dataclass(frozen=True)
class PairFailure:
    """A pair that could not be judged, and why."""

    source_timestamp_ns: int
    target_timestamp_ns: int
    code: str
    field: str | None
    message: str


@dataclass(frozen=True)
class BatchSummary:
    """What a run came to; counts are over all pairs in ``detections.jsonl`` and the failed ones.

    ``reused``: how many of them an earlier run had done.
    """

    out_dir: Path
    pairs: int
    ok: int
    abstained: int
    failures: tuple[PairFailure, ...]
    reused: int
    wall_time_s: float

    @property
    def failed(self) -> int:
        return len(self.failures)


def summarise(
    out_dir: Path,
    lines: Mapping[Stamps, JournalLine],
    failures: Iterable[PairFailure],
    *,
    reused: int,
    wall_time_s: float,
) -> BatchSummary:
    """Count the lines of a journal and the failures."""
    listed = tuple(failures)
    failed = {(failure.source_timestamp_ns, failure.target_timestamp_ns) for failure in listed}
    statuses = Counter(line.status for line in lines.values())
    return BatchSummary(
        out_dir=out_dir,
        pairs=len(failed | lines.keys()),
        ok=statuses["ok"],
        abstained=statuses["abstained"],
        failures=listed,
        reused=reused,
        wall_time_s=wall_time_s,
    )


def describe_run(
    recording: Recording,
    *,
    model: ModelInfo,
    execution: Execution,
    detector: DetectorConfig,
    options: FrozenConfig,
    settings: Mapping[str, Any],
) -> dict[str, Any]:
    """The part of ``run.json`` that is known before the first pair; plain JSON values."""
    camera = recording.camera
    run = {
        "recording": {
            "name": recording.name,
            "root": str(recording.root.resolve()),
            "format": recording.format,
            "frames": len(recording),
            "camera": None if camera is None else camera_to_mapping(camera),
        },
        "configuration": {**settings, "detector": detector.model_dump(mode="json")},
        "options": options.model_dump(mode="json", exclude={"out_dir", "resume", "overwrite"}),
        "model": asdict(model),
        "execution": execution.as_mapping(),
        "versions": {name: _version(name) for name in _VERSIONED_PACKAGES},
    }
    return dict(json.loads(json.dumps(run)))


def describe_outcome(summary: BatchSummary) -> dict[str, Any]:
    """The part of ``run.json`` that is known after the last pair."""
    counts = {"pairs": summary.pairs, "ok": summary.ok, "abstained": summary.abstained, "failed": summary.failed}
    return {
        "counts": counts,
        "failures": [asdict(failure) for failure in summary.failures],
        "reused": summary.reused,
        "wall_time_s": round(summary.wall_time_s, 3),
    }


def check_same_run(earlier: Mapping[str, Any], run: Mapping[str, Any], *, out_dir: Path) -> None:
    """What decides the detections must be as it was, or the file would mix two kinds of them.

    Raises:
        InvalidInputError: ``resume_config_differs`` with the first key that differs.
    """
    for key in _DECISIVE:
        place, before, now = _first_difference(key, _at(earlier, key), _at(run, key))
        if before != now:
            raise InvalidInputError(
                f"{out_dir}: expected {place} as in the earlier run, {before!r:.200}, found {now!r:.200}",
                code="resume_config_differs",
                field=place,
            )


def _at(values: Any, dotted: str) -> Any:
    for step in dotted.split("."):
        values = values.get(step) if isinstance(values, Mapping) else None
    return values


def _first_difference(place: str, before: Any, now: Any) -> tuple[str, Any, Any]:
    """The deepest key at which two nested mappings part."""
    if isinstance(before, Mapping) and isinstance(now, Mapping):
        for key in sorted(before.keys() | now.keys()):
            if before.get(key) != now.get(key):
                return _first_difference(f"{place}.{key}", before.get(key), now.get(key))
    return place, before, now


def _version(package: str) -> str | None:
    """None where another build stands in for the package (opencv-python for the headless one)."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None
