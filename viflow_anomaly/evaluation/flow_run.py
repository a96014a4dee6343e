"""The measurement itself: every method on the same pairs, errors and runtimes of one run."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from viflow_anomaly.config import MotorSource
from viflow_anomaly.errors import DatasetError, InvalidInputError
from viflow_anomaly.evaluation.flow_methods import FlowMethod, MethodAbout, NoEstimateError
from viflow_anomaly.evaluation.flow_statistics import FlowStatistics
from viflow_anomaly.evaluation.flow_truth import FlowTruth, TrueFlow, spread
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.sensor_data import FramePair

ByMethod = dict[str, FlowStatistics]
NO_TRUTH = "no_valid_ground_truth"
NO_PAIR = ("trajectory_not_covering", "image_missing")
"""What one pair may lack while the recording is sound."""


@dataclass(frozen=True)
class FlowMeasurement:
    """What a run found.

    Attributes:
        methods: the rows, in the order that they were given.
        sequences: statistics by sequence and method.
        skipped: pairs that were measured with no method (no ground truth, no usable IMU), by reason.
    """

    methods: tuple[MethodAbout, ...]
    sequences: Mapping[str, ByMethod]
    skipped: Mapping[str, int] = field(default_factory=dict)

    def groups(self) -> dict[str, ByMethod]:
        """By group: a sequence's name up to its first underscore."""
        names = sorted({group_of(name) for name in self.sequences})
        return {
            group: self._merged(some for name, some in self.sequences.items() if group_of(name) == group)
            for group in names
        }

    def total(self) -> ByMethod:
        """Of all pairs."""
        return self._merged(self.sequences.values())

    def _merged(self, parts: Iterable[ByMethod]) -> ByMethod:
        merged = {about.name: FlowStatistics() for about in self.methods}
        for part in parts:
            for name, statistics in part.items():
                merged[name].merge(statistics)
        return merged


def group_of(sequence: str) -> str:
    """The group of a sequence: its name up to the first underscore (``car_000001``: car)."""
    return sequence.split("_", 1)[0]


def measure_flow_methods(
    methods: Sequence[FlowMethod],
    truths: Sequence[FlowTruth],
    *,
    max_pairs: int | None = None,
    crop_px: int | None = None,
    repeats: int = 1,
    on_progress: Callable[[int, int], None] | None = None,
) -> FlowMeasurement:
    """Errors and runtimes of ``methods`` on the pairs of ``truths``.

    A method's first call for each size of image is not timed; reading images never is. Threads are the caller's to
    limit (``cv2.setNumThreads``, the runtime's own).

    Args:
        methods: with names that differ.
        truths: where pairs and true flow come from.
        max_pairs: evenly spread over all pairs (None: all).
        crop_px: measure the middle crop_px x crop_px pixels only, as the paper did with 224 (None: the whole image).
        repeats: timed runs of each method on each pair.
        on_progress: called with (done, total) after each pair.

    Raises:
        DatasetError: ``ground_truth_missing`` when no pair can be measured; ``no_estimate`` for a method without any;
            as the truths and methods raise.
    """
    assert len({method.about.name for method in methods}) == len(methods)
    chosen = spread(truths, max_pairs)
    sequences: dict[str, ByMethod] = {}
    skipped: Counter[str] = Counter()
    clock = _Clock(repeats)
    for done, (truth, index) in enumerate(chosen, start=1):
        by_method = sequences.setdefault(truth.sequence, {method.about.name: FlowStatistics() for method in methods})
        reason = _measure_pair(methods, truth, index, by_method, crop_px=crop_px, clock=clock)
        if reason is not None:
            skipped[reason] += 1
        if on_progress is not None:
            on_progress(done, len(chosen))
    measurement = FlowMeasurement(tuple(method.about for method in methods), sequences, dict(skipped))
    _require_estimates(measurement, len(chosen))
    return measurement


class _Clock:
    """Calls a method and takes its time; the first call for each size of image is a warm-up."""

    def __init__(self, repeats: int) -> None:
        assert repeats >= 1
        self._repeats = repeats
        self._warm: set[tuple[str, tuple[int, ...]]] = set()

    def flow(
        self, method: FlowMethod, truth: FlowTruth, index: int, pair: FramePair
    ) -> tuple[Float32Array, list[float]]:
        """The method's flow and its runtimes in milliseconds (none for a method that is not timed)."""
        name = truth.name(index)
        if not method.timed:
            return method.flow(pair, name), []
        key = (method.about.name, pair.source.image.shape)
        if key not in self._warm:
            method.flow(pair, name)
            self._warm.add(key)
        runtimes_ms = []
        for _ in range(self._repeats):
            start_ns = time.perf_counter_ns()
            flow = method.flow(pair, name)
            runtimes_ms.append((time.perf_counter_ns() - start_ns) / 1e6)
        return flow, runtimes_ms


def _measure_pair(
    methods: Sequence[FlowMethod],
    truth: FlowTruth,
    index: int,
    by_method: ByMethod,
    *,
    crop_px: int | None,
    clock: _Clock,
) -> str | None:
    """Measure one pair; why it was skipped, or None."""
    try:
        true_px, valid = _cropped(truth.truth(index), crop_px)
    except DatasetError as err:
        if err.code != "ground_truth_missing":
            raise
        return err.code  # real recordings have it for some of their pairs
    if not valid.any():
        return NO_TRUTH
    pairs: dict[MotorSource | None, FramePair] = {}
    try:
        for motor_source in dict.fromkeys(method.motor_source for method in methods):
            pairs[motor_source] = truth.pair(index, motor_source)
    except InvalidInputError as err:
        return err.code
    except DatasetError as err:
        if err.code not in NO_PAIR:
            raise
        return err.code
    for method in methods:
        pair = pairs[method.motor_source]
        if pair.source.image.shape != valid.shape:
            raise DatasetError(
                f"{truth.name(index)}: expected ground truth of the image's shape {pair.source.image.shape}, "
                f"found {valid.shape}",
                code="ground_truth_malformed",
            )
        statistics = by_method[method.about.name]
        try:
            flow, runtimes_ms = clock.flow(method, truth, index, pair)
        except NoEstimateError as err:
            statistics.missing[err.reason] += 1
            continue
        statistics.runtimes_ms.extend(runtimes_ms)
        statistics.add_pair(flow, true_px, valid)
    return None


def _cropped(true_flow: TrueFlow, crop_px: int | None) -> TrueFlow:
    if crop_px is None:
        return true_flow
    height, width = true_flow.valid.shape
    top, left = max(0, (height - crop_px) // 2), max(0, (width - crop_px) // 2)
    inside = np.zeros_like(true_flow.valid)
    inside[top : top + crop_px, left : left + crop_px] = True
    return TrueFlow(true_flow.flow_px, true_flow.valid & inside)


def _require_estimates(measurement: FlowMeasurement, pairs: int) -> None:
    skipped = sum(measurement.skipped.values())
    if skipped == pairs:
        raise DatasetError(
            f"expected a pair that can be measured, found none among {pairs} (left out: {dict(measurement.skipped)})",
            code="ground_truth_missing",
        )
    for name, statistics in measurement.total().items():
        if not statistics.pairs:
            raise DatasetError(
                f"{name}: expected an estimate for some of {pairs - skipped} pairs, found none "
                f"(reasons: {dict(statistics.missing)})",
                code="no_estimate",
            )
