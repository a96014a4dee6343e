"""Training of the evidence head: it learns, it resumes exactly, its scores are fitted, its mistakes are told."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from evidence_world import SMALL, recording
from hypothesis import given
from hypothesis import strategies as st

from viflow_anomaly.checkpoint import load_evidence_head
from viflow_anomaly.checkpoint_record import EvidenceRecord, read_tensors
from viflow_anomaly.cli.train_evidence import recordings_in
from viflow_anomaly.config import EvidenceHeadConfig, EvidenceTrainingConfig
from viflow_anomaly.detector import AnomalyDetector
from viflow_anomaly.errors import CheckpointError, ConfigError, DatasetError
from viflow_anomaly.evidence_cues import CUES_VERSION, GEOMETRIC_CUES
from viflow_anomaly.evidence_data import EvidenceBatch
from viflow_anomaly.evidence_run import refit_scores, train_evidence
from viflow_anomaly.evidence_training import EvidenceTraining, evidence_loss, offset_loss
from viflow_anomaly.evidence_truth import IGNORED, MOVING, SEAM, SIZE_SHIFT, offsets_of
from viflow_anomaly.moving_regions import REGION_FEATURES, probability_of
from viflow_anomaly.region_score_fit import LabelledRegions, fit_region_score


@pytest.fixture(scope="module")
def detector() -> AnomalyDetector:
    return AnomalyDetector.from_checkpoint(with_evidence=False)


def batch(seed: int) -> EvidenceBatch:
    """Movers are where the difference is large."""
    rng = np.random.default_rng(seed)
    truth = np.zeros((4, 32, 64), np.uint8)
    photometric = rng.normal(0, 0.05, (4, 3, 32, 64)).astype(np.float32)
    for one in range(4):
        y, x = rng.integers(0, 16), rng.integers(0, 48)
        truth[one, y : y + 12, x : x + 12] = MOVING
        photometric[one, 0, y : y + 12, x : x + 12] = 0.8
    offsets = np.stack([offsets_of(one, (8, 16)) for one in truth])
    return EvidenceBatch(photometric, np.zeros((4, len(GEOMETRIC_CUES), 8, 16), np.float32), truth, offsets)


def test_it_learns_what_the_cues_show() -> None:
    run = EvidenceTraining(SMALL.model_copy(update={"steps": 300}))
    losses = [run.train_step(batch(step)) for step in range(300)]
    assert np.mean(losses[-10:]) < 0.4 * np.mean(losses[:5])
    new = batch(10_000)
    run.network.eval()
    with torch.inference_mode():
        seen, _ = run.network(torch.from_numpy(new.photometric), torch.from_numpy(new.geometric))
    logits, moving = seen[:, 0].numpy(), new.truth == MOVING
    assert (logits[moving] > 0).mean() > 0.7
    assert (logits[~moving] < 0).mean() > 0.95


def test_it_learns_where_things_have_their_middles() -> None:
    run = EvidenceTraining(SMALL.model_copy(update={"steps": 300, "offset_weight": 20.0}))
    for step in range(300):
        run.train_step(batch(step))
    run.network.eval()
    wrong, still = 0.0, 0.0
    for step in range(10_000, 10_008):
        new = batch(step)
        with torch.inference_mode():
            _, offsets = run.network(torch.from_numpy(new.photometric), torch.from_numpy(new.geometric))
        moving = (new.truth.reshape(4, 8, 4, 16, 4)[:, :, 1:3, :, 1:3] == MOVING).all(axis=(2, 4))
        wrong += float(np.abs(offsets.numpy() - new.offsets).sum(axis=1)[moving].sum())
        still += float(np.abs(new.offsets).sum(axis=1)[moving].sum())
    assert wrong < 0.7 * still


def test_what_is_ignored_costs_nothing() -> None:
    logits = torch.zeros(1, 2, 8, 8)
    truth = torch.zeros(1, 8, 8, dtype=torch.uint8)
    truth[0, :4] = MOVING
    before = evidence_loss(logits, truth, motion_weight=3.0, size_balance=0.0, seam_weight=0.3)
    wrong, ignored = logits.clone(), truth.clone()
    wrong[0, 0, 4:] = 9.0
    ignored[0, 4:] = IGNORED
    assert float(evidence_loss(wrong, truth, motion_weight=3.0, size_balance=0.0, seam_weight=0.3)) > float(before) + 1
    loss = evidence_loss(wrong, ignored, motion_weight=3.0, size_balance=0.0, seam_weight=0.3)
    assert float(loss) == pytest.approx(3.0 * np.log(2) + 0.5 * (1 - 33 / 49) + 0.3 * np.log(2), rel=1e-5)


def test_seams_count_where_something_moves() -> None:
    logits, truth = torch.zeros(1, 2, 8, 8), torch.zeros(1, 8, 8, dtype=torch.uint8)
    truth[0, :4], truth[0, 3] = MOVING, MOVING | SEAM
    logits[0, 1, 3], logits[0, 1, :3] = 9.0, -9.0
    right = evidence_loss(logits, truth, motion_weight=1.0, size_balance=0.0, seam_weight=1.0)
    logits[0, 1, 4:] = 9.0  # where nothing moves a seam means nothing
    assert float(evidence_loss(logits, truth, motion_weight=1.0, size_balance=0.0, seam_weight=1.0)) == pytest.approx(
        float(right)
    )
    logits[0, 1, 3] = -9.0
    assert float(evidence_loss(logits, truth, motion_weight=1.0, size_balance=0.0, seam_weight=1.0)) > float(right) + 1


def test_pixels_of_small_movers_weigh_more() -> None:
    """By the root of what the area is short of 1024, at most four times as much, and never less."""
    logits, costs = torch.zeros(1, 2, 8, 8), {}
    for log_area in (0, 4, 8, 10, 14):
        truth = torch.full((1, 8, 8), MOVING | log_area << SIZE_SHIFT, dtype=torch.uint8)
        rest, all_of_it = (
            float(evidence_loss(logits, truth, motion_weight=weight, seam_weight=0.0, size_balance=0.5))
            for weight in (1.0, 2.0)
        )
        costs[log_area] = (all_of_it - rest) / np.log(2)
    assert costs == pytest.approx({0: 4.0, 4: 4.0, 8: 2.0, 10: 1.0, 14: 1.0}, rel=1e-5)


def test_offsets_count_where_something_moves() -> None:
    truth, zeros = torch.zeros(1, 8, 8, dtype=torch.uint8), torch.zeros(1, 2, 2, 2)
    truth[0, :4] = MOVING
    wrong = zeros.clone()
    wrong[0, :, 1] = 5.0
    assert float(offset_loss(wrong, zeros, truth)) == 0.0
    wrong[0, 0, 0] = 8.5
    assert float(offset_loss(wrong, zeros, truth)) == pytest.approx(1.0)
    assert float(offset_loss(wrong, zeros, torch.zeros_like(truth))) == 0.0


def test_a_frame_without_movers_has_a_loss() -> None:
    loss = evidence_loss(
        torch.zeros(1, 2, 8, 8),
        torch.zeros(1, 8, 8, dtype=torch.uint8),
        motion_weight=3,
        size_balance=0.0,
        seam_weight=1,
    )
    assert bool(torch.isfinite(loss))


def test_a_diverged_training_stops(tmp_path: Path) -> None:
    run = EvidenceTraining(SMALL)
    broken = batch(0)
    broken.photometric[0, 0, 0, 0] = np.nan
    with pytest.raises(ConfigError, match="finite loss") as caught:
        run.train_step(broken)
    assert caught.value.code == "training_diverged"


class KilledError(Exception):
    """The machine went down."""


def test_a_killed_run_goes_on_to_the_same_weights(tmp_path: Path, detector: AnomalyDetector) -> None:
    data, calibration = [recording(tmp_path / "drone_1")], [recording(tmp_path / "drone_2")]

    def die(what: str, done: int, total: int) -> None:
        if what.startswith("training") and done == 5:
            raise KilledError

    config = SMALL.model_copy(update={"steps": 8})
    settings = {"calibration": calibration, "detector": easily_moved(detector), "training": config}
    whole = train_evidence(data, tmp_path / "whole", **settings)  # type: ignore[arg-type]
    with pytest.raises(KilledError):
        train_evidence(data, tmp_path / "parts", report=die, **settings)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="--resume") as caught:
        train_evidence(data, tmp_path / "parts", **settings)  # type: ignore[arg-type]
    assert caught.value.code == "training_exists"
    parts = train_evidence(data, tmp_path / "parts", resume=True, **settings)  # type: ignore[arg-type]
    assert parts.read_bytes() == whole.read_bytes()
    assert [one.name for one in (tmp_path / "whole" / "cues").iterdir()] == ["drone_1.npz"]
    again = train_evidence(data, tmp_path / "parts", resume=True, **settings)  # type: ignore[arg-type]
    assert again.read_bytes() == whole.read_bytes()
    other = config.model_copy(update={"learning_rate": 1.0})
    with pytest.raises(ConfigError) as differs:
        train_evidence(data, tmp_path / "parts", resume=True, **{**settings, "training": other})  # type: ignore[arg-type]
    assert differs.value.code == "resume_config_differs"
    record = load_evidence_head(whole).record
    assert record.provenance["model"]["sha256"] == detector.model_info.sha256
    assert len(record.region_score.weights) == len(REGION_FEATURES)


def test_a_run_goes_on_only_with_the_cues_that_it_began_with(
    tmp_path: Path, detector: AnomalyDetector, monkeypatch: pytest.MonkeyPatch
) -> None:
    data, calibration = [recording(tmp_path / "drone_1")], [recording(tmp_path / "drone_2")]
    settings = {"calibration": calibration, "training": SMALL.model_copy(update={"steps": 1}), "resume": True}
    train_evidence(data, tmp_path / "out", detector=easily_moved(detector), **settings)  # type: ignore[arg-type]
    correction = detector.config.correction.model_copy(update={"rounds": 1})
    corrected_once = detector.with_config(detector.config.model_copy(update={"correction": correction}))
    with pytest.raises(ConfigError) as differs:
        train_evidence(data, tmp_path / "out", detector=corrected_once, **settings)  # type: ignore[arg-type]
    assert (differs.value.code, differs.value.field) == ("resume_config_differs", "correction")
    monkeypatch.setattr("viflow_anomaly.evidence_data.CUES_VERSION", CUES_VERSION + 1)
    with pytest.raises(ConfigError, match=f"{CUES_VERSION}, found {CUES_VERSION + 1}") as differs:
        train_evidence(data, tmp_path / "out", detector=easily_moved(detector), **settings)  # type: ignore[arg-type]
    assert (differs.value.code, differs.value.field) == ("resume_config_differs", "cues_version")


def test_a_training_goes_on_from_a_heads_weights(tmp_path: Path, detector: AnomalyDetector) -> None:
    data, calibration = [recording(tmp_path / "drone_1")], [recording(tmp_path / "drone_2")]
    still = SMALL.model_copy(update={"steps": 1, "learning_rate": 1e-12, "weight_decay": 0.0})
    settings = {"calibration": calibration, "detector": easily_moved(detector)}
    first = train_evidence(data, tmp_path / "first", training=SMALL, **settings)  # type: ignore[arg-type]
    second = train_evidence(data, tmp_path / "second", training=still, init=first, **settings)  # type: ignore[arg-type]
    before, after = load_evidence_head(first), load_evidence_head(second)
    for name, weights in before.head.state_dict().items():
        torch.testing.assert_close(after.head.state_dict()[name], weights, rtol=0, atol=1e-9)
    assert after.record.provenance["init"]["sha256"] == before.record.sha256
    shared = SMALL.model_copy(update={"init_share": 0.25})
    whole = train_evidence(data, tmp_path / "whole", training=SMALL, init=first, **settings)  # type: ignore[arg-type]
    between = train_evidence(data, tmp_path / "between", training=shared, init=first, **settings)  # type: ignore[arg-type]
    trained, mean = (load_evidence_head(one).head.state_dict() for one in (whole, between))
    for name, weights in before.head.state_dict().items():
        torch.testing.assert_close(mean[name], 0.25 * weights + 0.75 * trained[name])
    with pytest.raises(ConfigError) as caught:
        train_evidence(data, tmp_path / "none", training=shared, **settings)  # type: ignore[arg-type]
    assert (caught.value.code, caught.value.field) == ("config_invalid", "evidence_training.init_share")
    with pytest.raises(ConfigError) as caught:
        train_evidence(data, tmp_path / "second", training=still, resume=True, **settings)  # type: ignore[arg-type]
    assert (caught.value.code, caught.value.field) == ("resume_config_differs", "init")
    wider = still.model_copy(update={"head": EvidenceHeadConfig(widths=(8, 8, 8, 16))})
    with pytest.raises(ConfigError) as caught:
        train_evidence(data, tmp_path / "third", training=wider, init=first, **settings)  # type: ignore[arg-type]
    assert (caught.value.code, caught.value.field) == ("init_model_differs", "evidence_training.head.widths")


def easily_moved(detector: AnomalyDetector) -> AnomalyDetector:
    """An untrained head says something near a half everywhere; some of it has to become regions."""
    regions = detector.config.regions.model_copy(update={"min_motion_probability": 0.01})
    return detector.with_config(detector.config.model_copy(update={"regions": regions}))


def test_lists_must_not_overlap_or_be_empty(tmp_path: Path, detector: AnomalyDetector) -> None:
    one = recording(tmp_path / "drone_1")
    for data, calibration, code in (
        ([one], [one], "calibration_trained_on"),
        ([one], [], "config_invalid"),
        ([], [one], "config_invalid"),
    ):
        with pytest.raises(ConfigError) as caught:
            train_evidence(data, tmp_path / "out", calibration=calibration, detector=detector, training=SMALL)
        assert caught.value.code == code
    assert not (tmp_path / "out").exists()


def test_a_head_is_fitted_where_regions_would_come_from_the_residual(tmp_path: Path, detector: AnomalyDetector) -> None:
    moved = easily_moved(detector)
    residual = moved.with_config(moved.config.model_copy(update={"evidence": "residual"}))
    data, calibration = [recording(tmp_path / "drone_1")], [recording(tmp_path / "drone_2")]
    path = train_evidence(data, tmp_path / "out", calibration=calibration, detector=residual, training=SMALL)
    assert load_evidence_head(path).record.region_score.weights


def test_scores_are_fitted_anew_and_the_weights_stay(tmp_path: Path, detector: AnomalyDetector) -> None:
    moved = easily_moved(detector)
    data, others = [recording(tmp_path / "drone_1")], [recording(tmp_path / "drone_2"), recording(tmp_path / "drone_3")]
    trained = train_evidence(data, tmp_path / "out", calibration=others[:1], detector=moved, training=SMALL)
    same = refit_scores(moved, trained, others[:1], tmp_path / "same.safetensors")
    assert same.read_bytes() == trained.read_bytes()
    before, after = (load_evidence_head(path).record for path in (trained, same))
    assert after.region_score == before.region_score
    refitted = load_evidence_head(refit_scores(moved, trained, others, tmp_path / "other.safetensors")).record
    assert refitted.region_score != before.region_score
    assert refitted.provenance["calibration"]["recordings"] == 2
    assert refitted.provenance["training"] == before.provenance["training"]


def test_scores_are_not_fitted_on_nothing_or_written_nowhere(tmp_path: Path, detector: AnomalyDetector) -> None:
    one = [recording(tmp_path / "drone_1")]
    for recordings, out, code in (
        ([], tmp_path / "head.safetensors", "config_invalid"),
        (one, tmp_path / "missing" / "head.safetensors", "output_unusable"),
        (one, tmp_path / "head.json", "output_unusable"),
    ):
        with pytest.raises(ConfigError) as caught:
            refit_scores(detector, None, recordings, out)
        assert caught.value.code == code


def test_a_file_is_no_place_for_a_training(tmp_path: Path, detector: AnomalyDetector) -> None:
    data, calibration = [recording(tmp_path / "drone_1")], [recording(tmp_path / "drone_2")]
    (tmp_path / "out").write_text("mine")
    with pytest.raises(ConfigError, match="found a file") as caught:
        train_evidence(data, tmp_path / "out", calibration=calibration, detector=detector, training=SMALL)
    assert caught.value.code == "output_unusable"


@pytest.mark.parametrize(
    "values",
    [
        {"head": {"widths": [10**6] * 4}},
        {"batch_size": 10**8},
        {"learning_rate": 1e300},
        {"weight_decay": 1e300},
        {"crop_width": 32 * 10**6},
    ],
)
def test_absurd_numbers_are_refused(values: dict[str, object]) -> None:
    with pytest.raises(ConfigError) as caught:
        EvidenceTrainingConfig.from_mapping(values, where="test")
    assert caught.value.code == "config_invalid"


def test_the_folder_of_calibration_must_be_one(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for name, found in (("missing", "nothing there"), ("file", "a file")):
        with pytest.raises(DatasetError, match=f"expected a folder of recordings.*{found}"):
            recordings_in(tmp_path / name)
    one = recording(tmp_path / "some" / "drone_1")
    assert recordings_in(one) == recordings_in(tmp_path / "some") == [one]


def test_scores_need_regions(tmp_path: Path, detector: AnomalyDetector) -> None:
    certain = {"min_motion_probability": 0.99, "faint_motion_probability": 0.99}
    regions = detector.config.regions.model_copy(update=certain)
    never = detector.with_config(detector.config.model_copy(update={"regions": regions}))
    data, calibration = [recording(tmp_path / "drone_1")], [recording(tmp_path / "drone_2")]
    with pytest.raises(DatasetError, match="regions that count"):
        train_evidence(data, tmp_path / "out", calibration=calibration, detector=never, training=SMALL)


def test_a_damaged_state_is_told(tmp_path: Path) -> None:
    run = EvidenceTraining(SMALL)
    run.train_step(batch(0))
    run.save(tmp_path, {})
    other = EvidenceTraining(SMALL.model_copy(update={"head": SMALL.head.model_copy(update={"widths": (8, 8, 8, 16)})}))
    with pytest.raises(CheckpointError) as caught:
        other.restore(tmp_path, {})
    assert caught.value.code == "checkpoint_corrupt"


def test_a_head_is_not_a_network_and_says_so(tmp_path: Path) -> None:
    bundled = Path(__file__).parent.parent / "viflow_anomaly" / "weights" / "viflow-calibrated.safetensors"
    with pytest.raises(CheckpointError, match="head") as caught:
        read_tensors(bundled, EvidenceRecord)
    assert caught.value.code == "checkpoint_of_other_kind"


# --- scores


def regions_with_truth(count: int, seed: int) -> tuple[LabelledRegions, np.ndarray]:
    rng = np.random.default_rng(seed)
    features = rng.normal(size=(count, len(REGION_FEATURES)))
    logits = 1.5 * features[:, 0] - 1.0 * features[:, 10] + 0.3
    return LabelledRegions(features, rng.random(count) < 1 / (1 + np.exp(-logits))), logits


def test_fitted_scores_are_probabilities() -> None:
    fitted = fit_region_score(regions_with_truth(4000, seed=0)[0])
    new, logits = regions_with_truth(4000, seed=1)
    scores = np.array([probability_of(features, fitted) for features in new.features])
    assert np.abs(scores - 1 / (1 + np.exp(-logits))).mean() < 0.03
    bins = np.minimum((scores * 5).astype(int), 4)
    for k in range(5):
        chosen = bins == k
        assert abs(scores[chosen].mean() - new.moving[chosen].mean()) < 0.06


def test_a_feature_that_hardly_varies_does_not_decide() -> None:
    regions, _ = regions_with_truth(400, seed=0)
    features = regions.features.copy()
    features[:, 11] = 1.0 - 1e-3 * regions.moving  # a giveaway here, and noise anywhere else
    fitted = fit_region_score(LabelledRegions(features, regions.moving))
    assert abs(fitted.weights[11] * 1e-3) < 0.2


@given(st.integers(1, 30), st.booleans())
def test_few_regions_of_one_kind_give_a_finite_score(count: int, moving: bool) -> None:
    features = np.random.default_rng(count).normal(size=(count, len(REGION_FEATURES)))
    fitted = fit_region_score(LabelledRegions(features, np.full(count, moving)))
    for one in features:
        score = probability_of(one, fitted)
        assert score > 0.5 if moving else score < 0.5
