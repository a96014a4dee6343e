"""Figures against NumPy's on all errors at once."""

from __future__ import annotations

import numpy as np
import pytest

from viflow_anomaly.evaluation.flow_statistics import FlowStatistics
from viflow_anomaly.geometry import Float32Array

SHAPE = (20, 30)


def random_pair(
    seed: int, scale_px: float = 3.0
) -> tuple[Float32Array, Float32Array, np.ndarray[tuple[int, ...], np.dtype[np.bool_]]]:
    rng = np.random.default_rng(seed)
    true = rng.normal(0, 20, (*SHAPE, 2)).astype(np.float32)
    flow = true + rng.standard_t(2, (*SHAPE, 2)).astype(np.float32) * np.float32(scale_px)
    flow[rng.random(SHAPE) < 0.2] = np.nan
    return flow, true, rng.random(SHAPE) < 0.7


def test_figures_are_those_of_all_pixels_at_once() -> None:
    statistics, errors, lengths, valid_px = FlowStatistics(), [], [], 0
    for seed in range(6):
        flow, true, valid = random_pair(seed, scale_px=0.2 * 4**seed)
        statistics.add_pair(flow, true, valid)
        used = valid & np.isfinite(flow).all(axis=-1)
        valid_px += int(valid.sum())
        errors.append(np.linalg.norm(flow[used].astype(float) - true[used], axis=-1))
        lengths.append(np.linalg.norm(true[used].astype(float), axis=-1))
    error, length = np.concatenate(errors), np.concatenate(lengths)
    found = statistics.summary()
    assert found["pixels"] == error.size
    assert found["density"] == pytest.approx(error.size / valid_px, abs=1e-6)
    assert found["epe_mean_px"] == pytest.approx(error.mean(), abs=1e-4)
    assert found["epe_sd_px"] == pytest.approx(error.std(), abs=1e-4)
    assert found["epe_median_px"] == pytest.approx(np.median(error), rel=0.01)
    assert found["f1_all"] == pytest.approx(((error > 3) & (error > 0.05 * length)).mean(), abs=1e-6)
    assert found["epe_ratio"] == pytest.approx(error.mean() / length.mean(), abs=1e-4)


def test_merging_is_adding() -> None:
    parts = [FlowStatistics() for _ in range(3)]
    whole, merged = FlowStatistics(), FlowStatistics()
    for seed, part in enumerate(parts):
        pair = random_pair(seed)
        part.add_pair(*pair)
        whole.add_pair(*pair)
        part.runtimes_ms.append(seed + 1.0)
        part.missing["no_file"] += seed
        merged.merge(part)
    merged.merge(FlowStatistics())
    found = merged.summary()
    assert found["runtime_ms"] == 2.0
    assert found["missing_pairs"] == {"no_file": 3}
    assert {**found, "runtime_ms": None, "missing_pairs": {}, "quotient": None} == whole.summary()


@pytest.mark.parametrize(
    ("error_px", "length_px", "outlier"), [(2.9, 10, 0), (3.1, 10, 1), (3.1, 100, 0), (5.1, 100, 1)]
)
def test_kitti_outliers_need_both(error_px: float, length_px: float, outlier: int) -> None:
    true = np.full((1, 1, 2), (length_px, 0.0), np.float32)
    statistics = FlowStatistics()
    statistics.add_pair(true + np.array((0.0, error_px), np.float32), true, np.ones((1, 1), np.bool_))
    assert statistics.summary()["f1_all"] == outlier


@pytest.mark.parametrize("error_px", [0.0, 0.0049, 0.7, 10.2399, 10.24, 10.3, 250.0, 9000.0])
def test_the_median_is_known_to_a_bin(error_px: float) -> None:
    statistics = FlowStatistics()
    true = np.zeros((3, 3, 2), np.float32)
    statistics.add_pair(true + np.array((error_px, 0.0), np.float32), true, np.ones((3, 3), np.bool_))
    assert statistics.median_px() == pytest.approx(error_px, abs=max(0.005, 0.0025 * error_px))


def test_an_error_beyond_all_bins_is_counted() -> None:
    statistics = FlowStatistics()
    statistics.add_pair(np.full((1, 1, 2), 1e8, np.float32), np.zeros((1, 1, 2), np.float32), np.ones((1, 1), np.bool_))
    assert 1e4 < statistics.median_px() < 1.2e4


def test_the_quotient_is_the_papers() -> None:
    statistics = FlowStatistics()
    true = np.zeros((1, 1, 2), np.float32)
    statistics.add_pair(true + np.array((3.0, 4.0), np.float32), true, np.ones((1, 1), np.bool_))
    statistics.runtimes_ms.extend((9.0, 8.0, 100.0))
    found = statistics.summary()
    assert (found["runtime_ms"], found["quotient"]) == (9.0, 0.45)
    assert found["epe_ratio"] is None


def test_nothing_estimated_has_no_figures() -> None:
    statistics = FlowStatistics()
    statistics.add_pair(
        np.full((1, 1, 2), np.nan, np.float32), np.ones((1, 1, 2), np.float32), np.ones((1, 1), np.bool_)
    )
    found = statistics.summary()
    assert (found["pairs"], found["density"]) == (1, 0.0)
    assert {
        found[name] for name in ("epe_mean_px", "epe_sd_px", "epe_median_px", "f1_all", "epe_ratio", "quotient")
    } == {None}
    assert FlowStatistics().summary()["density"] is None
