"""What ``evaluate flow`` is asked to measure: recordings, checkpoints, methods, and places for the results."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from viflow_anomaly.evaluation.flow_methods import FlowMethod, NetworkMethod
    from viflow_anomaly.evaluation.flow_truth import FlowTruth, RecordingTruth
    from viflow_anomaly.evaluation.sceneflow_truth import SceneFlowTruth
    from viflow_anomaly.settings import Settings

DEFAULT, NONE = "default", "none"


def require_places(*places: Path | None) -> None:
    """Find out before the measurement that a result could not be written, or would be written over another."""
    from viflow_anomaly.errors import ConfigError

    *files, plots = places
    given = [path.resolve() for path in places if path is not None]
    for path in [path for path in files if path is not None and path.is_dir()]:
        raise ConfigError(f"{path}: expected the name of a file to write, found a directory", code="output_unusable")
    if plots is not None and plots.exists() and not plots.is_dir():
        raise ConfigError(f"{plots}: expected a directory for pictures, found a file", code="output_unusable")
    if len(set(given)) < len(given):
        raise ConfigError(f"expected places of their own for each result, found {given}", code="output_unusable")


def numbers_of(text: str) -> list[int]:
    """Raises: InvalidInputError: ``look_ahead_out_of_range``."""
    from viflow_anomaly.datasets.pairing import pair_indices
    from viflow_anomaly.errors import InvalidInputError

    try:
        numbers = sorted({int(part) for part in text.split(",")})
    except ValueError as err:
        raise InvalidInputError(
            f"look_aheads: expected numbers between 1 and 4, comma-separated, found {text!r}",
            code="look_ahead_out_of_range",
            field="look_aheads",
        ) from err
    pair_indices(0, numbers)
    return numbers


def named_checkpoints(texts: Sequence[str] | None, settings: Settings) -> list[tuple[str | None, Path | None]]:
    """(name, path) of each; no path is the bundled model."""
    if texts is None:
        return [(None, settings.checkpoint)]
    if list(texts) == [NONE]:
        return []
    pairs = [_named(text) for text in texts]
    return [(name, Path(path)) for name, path in pairs]


def _named(text: str) -> tuple[str | None, str]:
    """NAME=VALUE, or VALUE alone; a path may hold an equals sign behind a slash."""
    name, equals, value = text.partition("=")
    return (name, value) if equals and name and "/" not in name else (None, text)


def open_truths(
    recordings: Sequence[Path], look_aheads: Sequence[int], ground_truth: Path | None, movers: bool
) -> Sequence[RecordingTruth | SceneFlowTruth]:
    from viflow_anomaly.errors import ConfigError
    from viflow_anomaly.evaluation.flow_truth import RecordingTruth
    from viflow_anomaly.evaluation.sceneflow_truth import is_scene_flow, open_scene_flow

    if ground_truth is not None and len(recordings) != 1:
        raise ConfigError(
            f"--ground-truth: expected one recording with it, found {len(recordings)}",
            code="ground_truth_ambiguous",
            field="ground_truth",
        )
    truths: list[RecordingTruth | SceneFlowTruth] = []
    for path in recordings:
        if is_scene_flow(path):
            if ground_truth is not None or tuple(look_aheads) != (1,):
                raise ConfigError(
                    f"{path}: expected neither --ground-truth nor --look-aheads with KITTI scene flow, whose pairs and "
                    f"flow are its own, found {ground_truth or list(look_aheads)}",
                    code="scene_flow_options",
                    field="look_aheads" if ground_truth is None else "ground_truth",
                )
            truths += open_scene_flow(path, movers=movers)
        else:
            truths.append(RecordingTruth(path, look_aheads, ground_truth=ground_truth, movers=movers))
    names = [truth.sequence for truth in truths]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ConfigError(
            f"recordings: expected folders of different names, by which they are told apart, found {twice[0]!r} twice",
            code="sequence_names",
            field="recordings",
        )
    return truths


def test_parts(
    truths: Sequence[RecordingTruth | SceneFlowTruth],
    named: Sequence[tuple[str | None, Path | None]],
    settings: Settings,
) -> Sequence[FlowTruth]:
    """What the split keeps for the test; every checkpoint must have been trained with that very split."""
    from viflow_anomaly.checkpoint_record import bundled_checkpoint, read_checkpoint
    from viflow_anomaly.errors import ConfigError
    from viflow_anomaly.evaluation.flow_truth import RecordingTruth, TestPart

    split = settings.training.split
    if split.rule == "none":
        raise ConfigError(
            "--test-part: expected the split that the training had (--set training.split.rule=blocks), found none",
            code="split_rule_unknown",
            field="training.split.rule",
        )
    if not all(isinstance(truth, RecordingTruth) for truth in truths):
        raise ConfigError(
            "--test-part: expected recordings, found KITTI scene flow, which is a test of its own",
            code="scene_flow_options",
            field="training.split",
        )
    for _, path in named:
        checkpoint = path or bundled_checkpoint()
        trained = read_checkpoint(checkpoint)[1].provenance.get("training", {}).get("split")
        if trained != split.model_dump(mode="json"):
            raise ConfigError(
                f"--test-part: expected the split that {checkpoint} was trained with, {trained}, "
                f"found {split.model_dump(mode='json')}",
                code="split_differs",
                field="training.split",
            )
    return [TestPart(truth, split) if isinstance(truth, RecordingTruth) else truth for truth in truths]


def baselines_of(text: str) -> tuple[list[FlowMethod], list[str]]:
    from viflow_anomaly.evaluation.flow_baselines import choose_baselines

    if text == NONE:
        return [], []
    chosen = choose_baselines(None if text == DEFAULT else [part.strip() for part in text.split(",")])
    return list(chosen.methods), chosen.left_out


def result_files(texts: Sequence[str], truths: Sequence[FlowTruth], max_pairs: int | None) -> list[FlowMethod]:
    from viflow_anomaly.errors import ConfigError
    from viflow_anomaly.evaluation.flow_results import ResultFiles
    from viflow_anomaly.evaluation.flow_truth import spread

    names = [truth.name(index) for truth, index in spread(truths, max_pairs)]
    methods: list[FlowMethod] = []
    for text in texts:
        name, folder = _named(text)
        if name is None:
            raise ConfigError(f"--results: expected NAME=DIR, found {text!r}", code="results_unnamed", field="results")
        methods.append(ResultFiles(name, Path(folder), names))
    return methods


def networks_of(named: Sequence[tuple[str | None, Path | None]], settings: Settings) -> list[NetworkMethod]:
    from viflow_anomaly.evaluation.flow_methods import network_methods
    from viflow_anomaly.runtime.loading import load_runtime

    methods = []
    for name, path in named:
        runtime, record = load_runtime(
            path,
            runtime=settings.runtime,
            device=settings.device,
            threads=settings.threads,
            precision=settings.network_precision,
        )
        methods += network_methods(name or record.name, runtime, record, settings.detector.correction)
    return methods


def require_distinct(methods: Sequence[FlowMethod]) -> None:
    from viflow_anomaly.errors import ConfigError

    names = [method.about.name for method in methods]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice or not names:
        found = f"{twice[0]!r} twice" if twice else "none"
        raise ConfigError(
            f"methods: expected something to measure under names that differ (--checkpoint NAME=PATH), found {found}",
            code="method_names",
            field="checkpoint",
        )
