"""One training of an evidence head from recordings to a checkpoint: cues, steps, scores."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from viflow_anomaly import __version__
from viflow_anomaly.batch import require_device
from viflow_anomaly.checkpoint import LoadedEvidenceHead, load_evidence_head, save_evidence_head
from viflow_anomaly.checkpoint_record import BUNDLED_EVIDENCE_NAME, EvidenceRecord, source_commit
from viflow_anomaly.config import EvidenceTrainingConfig
from viflow_anomaly.detection import ModelInfo
from viflow_anomaly.detector import AnomalyDetector
from viflow_anomaly.errors import ConfigError
from viflow_anomaly.evaluation.labelled_pairs import SimulatedPairs
from viflow_anomaly.evidence_augmentation import Augment
from viflow_anomaly.evidence_cues import CUES_VERSION, GEOMETRIC_CUES, PHOTOMETRIC_CUES
from viflow_anomaly.evidence_data import EvidenceData, cues_settings, load_examples
from viflow_anomaly.evidence_training import EvidenceTraining, Fingerprint
from viflow_anomaly.model.evidence_head import EvidenceHead
from viflow_anomaly.region_score_fit import fit_region_score, labelled_regions
from viflow_anomaly.runtime.loading import LoadedEvidence
from viflow_anomaly.runtime.torch_evidence import TorchEvidence
from viflow_anomaly.training_init import origin_of, read_initial_head

LOG_EVERY = 100
Report = Callable[[str, int, int], None]
"""Called with what is being done, how much of it is, and how much there is."""


def train_evidence(
    data: Sequence[Path],
    out_dir: Path,
    *,
    calibration: Sequence[Path],
    detector: AnomalyDetector,
    training: EvidenceTrainingConfig,
    init: Path | None = None,
    device: str = "cpu",
    resume: bool = False,
    report: Report = lambda what, done, total: None,
) -> Path:
    """Train a head on simulated recordings, and fit its scores on others.

    Args:
        data: recordings with masks of what moves, in any order: they are taken by name.
        out_dir: gets ``cues/`` (kept between runs), ``state.safetensors``, ``metrics.jsonl`` and the checkpoint
            ``evidence.safetensors``.
        calibration: recordings to fit the scores on, never to train on.
        detector: whose network's flow the head is to judge; its cues are learned from.
        training: structure and steps.
        init: a head to start from, instead of fresh weights; the structure is its own.
        resume: go on from ``out_dir``; a fresh directory starts anew.

    Returns:
        The checkpoint's path.

    Raises:
        ConfigError: ``training_exists``, ``output_unusable``, ``resume_config_differs``, ``device_unavailable``,
            ``training_diverged``, ``init_model_differs``; ``config_invalid`` for an ``init_share`` without ``init``;
            ``calibration_trained_on`` where a recording is in both lists.
        DatasetError: as ``load_examples`` and ``labelled_regions``.
        CheckpointError: ``checkpoint_corrupt`` for the state to go on from; as ``load_evidence_head`` for ``init``.
    """
    require_device(device)
    if init is None and training.init_share:
        raise ConfigError(
            f"evidence_training.init_share: expected 0 where no weights are begun with, found {training.init_share}",
            code="config_invalid",
            field="evidence_training.init_share",
        )
    initial = None if init is None else read_initial_head(init, training.head)
    if initial is not None:
        training = training.model_copy(update={"head": initial.record.head})
    data, calibration = (sorted(some, key=lambda path: (path.name, path)) for some in (data, calibration))
    _require_apart(data, calibration)
    for path in calibration:
        SimulatedPairs(path)  # what is wrong with one should be told before the training, not after it
    _require_usable(out_dir, resume=resume)
    torch.set_num_threads(training.threads)
    fingerprint: Fingerprint = {
        **cues_settings(detector),
        "evidence_training": training.model_dump(mode="json", exclude={"checkpoint_every"}),
        "init": None if initial is None else initial.record.sha256,
        "data": [path.name for path in data],
    }
    run = EvidenceTraining(training, device=device)
    if initial is not None:
        run.network.load_state_dict(initial.head.state_dict())
    run.restore(out_dir, fingerprint)
    if run.step < training.steps:
        examples = load_examples(
            detector,
            data,
            out_dir / "cues",
            every=training.every,
            augment=Augment(training.seed, training.augmented_share, training.own_size_share),
            on_progress=lambda done, total: report("reading", done, total),
        )
        _run_steps(run, EvidenceData(examples, training), out_dir, fingerprint, report)
    record = _record(training, detector.model_info, data, calibration)
    if initial is not None:
        record = _with_provenance(record, init=origin_of(initial.record))
    network = run.network if initial is None else _between(initial.head, run.network, training.init_share)
    head = LoadedEvidenceHead(network.eval(), record)
    return _with_scores(head, out_dir / "evidence.safetensors", detector, calibration, report, device=device)


def refit_scores(
    detector: AnomalyDetector,
    head: Path | None,
    calibration: Sequence[Path],
    out: Path,
    *,
    report: Report = lambda what, done, total: None,
) -> Path:
    """Write a head with the same weights, and scores fitted on these recordings.

    Args:
        detector: whose network and regions the scores are to hold for.
        head: None: the bundled one.
        calibration: recordings with masks of what moves, that the head was not trained on.
        out: the new checkpoint (.safetensors).

    Raises:
        CheckpointError: as ``load_evidence_head``; ``evidence_cues_differ``.
        ConfigError: ``config_invalid`` where there are no recordings; ``output_unusable``.
        DatasetError: as ``labelled_regions``.
    """
    if out.suffix != ".safetensors" or not out.parent.is_dir():
        raise ConfigError(
            f"{out}: expected a file in an existing folder whose name ends in .safetensors",
            code="output_unusable",
            field="out",
        )
    _require_some("calibration", calibration)
    loaded = load_evidence_head(head)
    record = _with_provenance(loaded.record, scores_commit=source_commit(), calibration=_told(calibration))
    return _with_scores(loaded._replace(record=record), out, detector, calibration, report)


def _between(initial: EvidenceHead, trained: EvidenceHead, share: float) -> EvidenceHead:
    """``trained``, changed: each weight the mean of before and after the training, ``share`` of it before.

    What lies between two heads of one origin judges other scenes better than either (Wortsman et al., Robust
    fine-tuning of zero-shot models, CVPR 2022).
    """
    before, after = initial.state_dict(), trained.state_dict()
    mean = {key: torch.lerp(value, before[key].to(value.device), share) for key, value in after.items()}
    trained.load_state_dict(mean)
    return trained


def _run_steps(
    run: EvidenceTraining, data: EvidenceData, out_dir: Path, fingerprint: Fingerprint, report: Report
) -> None:
    """All steps that are left, logged and saved as they go."""
    losses: list[float] = []

    def on_step(step: int, loss: float) -> None:
        report(f"training, loss {loss:.3f}", step, run.config.steps)
        losses.append(loss)
        if step % LOG_EVERY == 0:
            _log(out_dir / "metrics.jsonl", step, sum(losses) / len(losses))
            losses.clear()
        if step % run.config.checkpoint_every == 0 or step == run.config.steps:
            run.save(out_dir, fingerprint)

    run.run(data, on_step)


def _record(
    training: EvidenceTrainingConfig, model: ModelInfo, data: Sequence[Path], calibration: Sequence[Path]
) -> EvidenceRecord:
    """What the head is; its checksum and scores are not known yet."""
    return EvidenceRecord(
        name=BUNDLED_EVIDENCE_NAME,
        version=__version__,
        sha256="0" * 64,
        head=training.head,
        photometric_cues=PHOTOMETRIC_CUES,
        geometric_cues=GEOMETRIC_CUES,
        cues_version=CUES_VERSION,
        provenance={
            "commit": source_commit(),
            "training": training.model_dump(mode="json"),
            "model": {"name": model.name, "version": model.version, "sha256": model.sha256},
            "data": _told(data),
            "calibration": _told(calibration),
        },
    )


def _with_provenance(record: EvidenceRecord, **told: Any) -> EvidenceRecord:
    return record.model_copy(update={"provenance": {**record.provenance, **told}})


def _told(recordings: Sequence[Path]) -> dict[str, Any]:
    return {"recordings": len(recordings), "first": recordings[0].name, "last": recordings[-1].name}


def _require_usable(out_dir: Path, *, resume: bool) -> None:
    if out_dir.exists() and not out_dir.is_dir():
        raise ConfigError(
            f"{out_dir}: expected a directory or nothing, found a file", code="output_unusable", field="out"
        )
    if (out_dir / "state.safetensors").exists() and not resume:
        raise ConfigError(
            f"{out_dir}: expected a directory without a training run, found one; --resume goes on with it",
            code="training_exists",
            field="out",
        )


def _log(path: Path, step: int, loss: float) -> None:
    """One line, the mean loss of the last steps; a resumed run logs what it repeats once more."""
    with path.open("a", encoding="utf-8") as metrics:
        metrics.write(json.dumps({"step": step, "loss": round(loss, 6)}) + "\n")


def _require_apart(data: Sequence[Path], calibration: Sequence[Path]) -> None:
    for name, some in (("data", data), ("calibration", calibration)):
        _require_some(name, some)
    shared = sorted({path.name for path in data} & {path.name for path in calibration})
    if shared:
        raise ConfigError(
            f"calibration: expected recordings that the head is not trained on, found {shared[0]!r} in both lists",
            code="calibration_trained_on",
            field="calibration",
        )


def _require_some(name: str, recordings: Sequence[Path]) -> None:
    if not recordings:
        raise ConfigError(f"{name}: expected recordings, found none", code="config_invalid", field=name)


def _with_scores(
    head: LoadedEvidenceHead,
    path: Path,
    detector: AnomalyDetector,
    calibration: Sequence[Path],
    report: Report,
    *,
    device: str = "cpu",
) -> Path:
    """Write the checkpoint with what its regions score, fitted on recordings that it has not seen."""
    record = head.record
    runtime = TorchEvidence(head.head, device=device)
    judging = detector.with_evidence(LoadedEvidence(runtime, record))
    regions = labelled_regions(
        judging.with_config(detector.config.model_copy(update={"evidence": "learned"})),
        calibration,
        on_progress=lambda done, total: report("calibrating", done, total),
    )
    counts = {"regions": len(regions.moving), "moving": int(regions.moving.sum())}
    scored = record.model_copy(
        update={
            "region_score": fit_region_score(regions),
            "provenance": {**record.provenance, "calibrated_on": counts},
        }
    )
    return save_evidence_head(path, head.head, scored)
