"""What an int8 export is calibrated on: what networks are given of pairs, from recordings or simulated."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from viflow_anomaly.config import ImageLimits, ModelConfig, MotorSource
from viflow_anomaly.datasets.pairing import RecordingPairs
from viflow_anomaly.datasets.registry import open_recording
from viflow_anomaly.detector import AnomalyDetector
from viflow_anomaly.errors import DatasetError, InvalidInputError
from viflow_anomaly.model_input import prepare
from viflow_anomaly.runtime.exported import Feed, network_feed
from viflow_anomaly.sensor_data import FramePair
from viflow_anomaly.simulator.config import SimulatorConfig
from viflow_anomaly.simulator.run import simulate

MAX_SAMPLES = 96
SIMULATED_SEEDS = {"drone": 36_000, "car": 86_000}
"""Neither trained on, nor used to fit scores, nor held out."""
SIMULATED_SEQUENCES, SIMULATED_FRAMES = 6, 4


def simulated_recordings(folder: Path) -> list[Path]:
    """A few short flights and drives, written into ``folder``.

    Raises:
        MissingDependencyError: ``mujoco_missing``, ``gl_missing``.
    """
    places = []
    for rig, seed in SIMULATED_SEEDS.items():
        config = {"rig": rig, "seed": seed, "sequences": SIMULATED_SEQUENCES, "frames": SIMULATED_FRAMES}
        places += simulate(SimulatorConfig.model_validate({**config, "ground_truth": False}), folder)
    return places


def network_samples(recordings: Sequence[Path], model: ModelConfig, limits: ImageLimits) -> list[Feed]:
    """What a VIFlow network is given of at most ``MAX_SAMPLES`` pairs, evenly spread.

    Raises:
        DatasetError: as ``open_recording``; ``calibration_pairs_missing`` where no pair can be used.
    """
    return _of_pairs(recordings, model.motor_source, limits, lambda pair: network_feed(prepare(pair, model)))


def head_samples(recordings: Sequence[Path], detector: AnomalyDetector, limits: ImageLimits) -> list[Feed]:
    """What an evidence head is shown behind the detector's network; otherwise as ``network_samples``."""

    def shown(pair: FramePair) -> Feed:
        cues, _ = detector.cues(detector.as_judged(pair, for_head=True))
        photometric, geometric = cues
        return {"photometric": np.array(photometric)[None], "geometric": np.array(geometric)[None]}

    return _of_pairs(recordings, detector.motor_source, limits, shown)


def _of_pairs(
    recordings: Sequence[Path], motor_source: MotorSource | None, limits: ImageLimits, make: Callable[[FramePair], Feed]
) -> list[Feed]:
    opened = [RecordingPairs(open_recording(path, limits=limits), motor_source=motor_source) for path in recordings]
    places = [(pairs, index) for pairs in opened for index in range(len(pairs))]
    chosen = np.unique(np.linspace(0, len(places) - 1, MAX_SAMPLES).round().astype(int)) if places else ()
    samples: list[Feed] = []
    reasons: list[str] = []
    for place in chosen:
        pairs, index = places[place]
        try:
            samples.append(make(pairs[index]))
        except InvalidInputError as err:
            reasons.append(err.message)
    if not samples:
        raise DatasetError(
            f"calibration: expected pairs that can be used in {', '.join(map(str, recordings))}, found none"
            + (f", the first because: {reasons[0]}" if reasons else ""),
            code="calibration_pairs_missing",
            field="calibration",
        )
    return samples
