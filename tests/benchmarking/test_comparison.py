from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from viflow_anomaly.benchmarking import comparison
from viflow_anomaly.benchmarking.benchmark_report import comparison_table, curve_tables, markdown, paper_table
from viflow_anomaly.benchmarking.comparison import Plan, compare, paper_ratios
from viflow_anomaly.benchmarking.cost_curves import BLOB_IMAGE, by_blobs, by_length, checkerboard, draw_curves
from viflow_anomaly.benchmarking.made_scene import make_pair
from viflow_anomaly.benchmarking.subjects import HOMOGRAPHY, OTHERS, Run, Subject, choose_subjects, load_subject
from viflow_anomaly.config import RegionConfig
from viflow_anomaly.detection import Detection
from viflow_anomaly.errors import ConfigError

PLAN = Plan(
    sizes=[(96, 64)], threads=[1], runtimes=["torch"], required=False, presets=["bundled", "paper"], repeats=2,
    budget_s=1.0, memory=False,
)  # fmt: skip


def test_every_runtime_is_measured_with_head_and_without_beside_the_others() -> None:
    subjects = choose_subjects(["torch", "openvino"], ["bundled", "paper"])
    ours = [(one.runtime, one.preset, one.evidence) for one in subjects if one.ours]
    assert ours == [
        ("torch", "bundled", "auto"),
        ("torch", "bundled", "residual"),
        ("openvino", "bundled", "auto"),
        ("openvino", "bundled", "residual"),
        ("torch", "paper", "residual"),
    ]
    assert tuple(one.name for one in subjects if not one.ours) == OTHERS


@pytest.mark.parametrize("evidence", ["auto", "residual"])
def test_ours_is_the_detector(evidence: str) -> None:
    found = load_subject(Subject("viflow-anomaly", "torch", "bundled", evidence), 1)(make_pair(224, 224))
    assert isinstance(found, Detection)
    assert found.status == "ok"
    assert any("probability" in roi.evidence for roi in found.rois) == (evidence == "auto")


@pytest.mark.parametrize("name", OTHERS)
def test_the_others_answer(name: str) -> None:
    found: Any = load_subject(Subject(name), 1)(make_pair(224, 224))
    if name == HOMOGRAPHY:
        assert len(found) >= 1
    else:
        assert found.shape == (224, 224, 2)


@pytest.fixture
def quick_subjects(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is loaded: OpenVINO is missing, everything else answers at once."""

    def load(subject: Subject, threads: int) -> Run:
        if subject.runtime == "openvino":
            raise ConfigError("expected OpenVINO, found it missing", code="runtime_unavailable", field="runtime")
        return lambda pair: np.zeros(pair.source.image.shape).sum()

    monkeypatch.setattr(comparison, "load_subject", load)


@pytest.mark.usefixtures("quick_subjects")
def test_rows_are_ratios_of_one_round() -> None:
    steps: list[str] = []
    threads = cv2.getNumThreads()
    compared = compare(Plan(**{**vars(PLAN), "threads": [1, 2]}), steps.append)
    assert cv2.getNumThreads() == threads
    assert steps == ["96x64 px, 1 thread", "96x64 px, 2 threads"]
    assert len(compared.rows) == 2 * (3 + len(OTHERS))
    for row in compared.rows:
        medians = {one["method"]: one["median_ms"] for one in compared.rows if one["threads"] == row["threads"]}
        assert row["over_dis_medium"] == pytest.approx(row["median_ms"] / medians["DIS medium"], abs=1e-3)
        assert row["over_homography"] == pytest.approx(row["median_ms"] / medians[HOMOGRAPHY], abs=1e-3)
    ratios = paper_ratios(compared.rows)
    assert [(one["threads"], one["evidence"]) for one in ratios] == [
        (1, "auto"), (1, "residual"), (2, "auto"), (2, "residual"),
    ]  # fmt: skip


@pytest.mark.usefixtures("quick_subjects")
def test_a_runtime_that_is_missing_is_named_or_refused_where_it_was_asked_for() -> None:
    plan = Plan(**{**vars(PLAN), "runtimes": ["torch", "openvino"]})
    compared = compare(plan, lambda step: None)
    assert compared.skipped == ["openvino: expected OpenVINO, found it missing"]
    with pytest.raises(ConfigError, match="found it missing"):
        compare(Plan(**{**vars(plan), "required": True}), lambda step: None)


@pytest.mark.parametrize("count", [1, 16, 256, 4096])
def test_a_checkerboard_has_as_many_squares_as_asked_for(count: int) -> None:
    board = checkerboard(count, *BLOB_IMAGE)
    found, _ = cv2.connectedComponents((board > 0).astype(np.uint8), connectivity=8)
    assert found - 1 == count


def test_regions_of_a_noisy_residual_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever stands out: a detection has no more regions than allowed, and no more are looked at."""
    monkeypatch.setattr("viflow_anomaly.benchmarking.cost_curves.REPEATS", 1)
    rows = by_blobs()
    assert max(row["regions"] for row in rows if row["limits"] == "default") == RegionConfig().max_regions
    assert [row["regions"] for row in rows if row["limits"] == "everything"] == [1, 16, 256, 4096, 4096]


def test_a_recordings_length_is_measured_in_a_process_of_its_own() -> None:
    (row,) = by_length((5,))
    assert (row["frames"], row["pairs"]) == (5, 4)
    assert row["peak_mib"] > 50


CURVES = {
    "pixels": [
        {"evidence": "auto", "pixels": 100, "median_ms": 1.0, "over_quarter": None, "peak_mib": None},
        {"evidence": "auto", "pixels": 400, "median_ms": 4.0, "over_quarter": 4.0, "peak_mib": None},
    ],
    "hypotheses": [{"hypotheses": 1, "residual": "winner", "median_ms": 3.0}],
    "blobs": [{"blobs": 16, "limits": "default", "regions": 16, "median_ms": 2.0}],
    "length": [{"frames": 10, "pairs": 9, "ms_a_pair": 5.0, "peak_mib": 200.0}],
}


@pytest.mark.usefixtures("quick_subjects")
def test_the_report_for_people_says_what_the_json_does() -> None:
    compared = compare(PLAN, lambda step: None)
    compared.rows[0]["peak_mib"] = 321.4
    tables = [comparison_table(compared.rows), paper_table(paper_ratios(compared.rows)), *curve_tables(CURVES)]
    about = {"cpu": "A", "cores": 2, "load_1min": 0.1, "load_1min_after": 0.2, "date": "today", "commit": None}
    text = markdown(
        {**about, "uncommitted_changes": True, "python": "3.11", "versions": {"numpy": "2"}, "skipped": ["x: why"]},
        tables,
    )
    assert "A, 2 usable cores, load 0.1 before and 0.2 after; today" in text
    assert "of an installed package with uncommitted changes; Python 3.11, numpy 2." in text
    assert "| viflow-anomaly | torch | bundled | auto | 96x64 | 1 |" in text
    assert "| 321 |" in text
    assert "| auto | 400 | 4.0 | 4.0 | - |" in text
    assert text.endswith("Not measured: x: why\n")


def test_curves_are_drawn(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    paths = draw_curves(CURVES, tmp_path / "curves")
    assert sorted(path.name for path in paths) == ["curves.pdf", "curves.png"]
    assert cv2.imread(str(tmp_path / "curves.png")).shape[1] > 1000
