"""Recordings in memory, ready for training: every frame in use rendered once to its view, pairs with their windows."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.batch import Batch, collate_arrays
from viflow_anomaly.config import ModelConfig, SplitConfig
from viflow_anomaly.datasets.pairing import RecordingPairs
from viflow_anomaly.datasets.recording import Recording
from viflow_anomaly.datasets.registry import open_recording
from viflow_anomaly.datasets.splits import split_pairs
from viflow_anomaly.errors import DatasetError, InvalidInputError, ViflowError
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.measured_flow import MeasuredFlow, measure_flow
from viflow_anomaly.model.layers import FLOW_STRIDE
from viflow_anomaly.motion_input import MotionWindow, build_motion_window
from viflow_anomaly.motor_input import MIRRORED_DISPLACEMENT_SIGNS, encode, fitted_motor, require_command
from viflow_anomaly.sensor_data import Float64Array, Frame, FramePair, Uint8Array
from viflow_anomaly.view import make_view

FRAMES_HELD = 8
"""More than the longest look-ahead: a frame is read once, and again only where pairs lie far apart."""
MIRRORED_MOTION_SIGNS = (1, -1, -1, -1, 1, 1)
"""Left and right exchanged: angular rate is an axial vector (y and z change sign), specific force a polar one (x)."""


@dataclass(frozen=True, eq=False)
class PairBucket:
    """All pairs whose views have one size.

    Attributes:
        frames: [N, h, w] uint8 views.
        pairs: [P, 2] indices into ``frames`` (source, target).
        motion: [P, T, 6] windows.
        interval_s: [P].
        mirrorable: [P] the window is in camera axes and the motor input no command, so that a mirrored pair has a known
            motion.
        motor: [P, C] displacements or commands, not yet encoded, or None.
        measured_px, confidence: [P, h/4, w/4(, 2)] what ``measure_flow`` found (confidence in 1/255), or None.
    """

    frames: Uint8Array
    pairs: NDArray[np.int64]
    motion: Float32Array
    interval_s: Float32Array
    mirrorable: NDArray[np.bool_]
    motor: Float64Array | None = None
    measured_px: NDArray[np.float16] | None = None
    confidence: Uint8Array | None = None

    def measured(self, index: int, *, mirrored: bool) -> MeasuredFlow:
        """What the images of one pair say of their flow."""
        assert self.measured_px is not None
        assert self.confidence is not None
        flow = self.measured_px[index].astype(np.float32)
        confidence = self.confidence[index].astype(np.float32) / 255
        if mirrored:
            flow, confidence = flow[:, ::-1] * np.array((-1, 1), np.float32), confidence[:, ::-1]
        return MeasuredFlow(flow, confidence, FLOW_STRIDE)


@dataclass(frozen=True, eq=False)
class TrainingData:
    """Buckets, how many pairs they hold, and why others were left out (fault code -> count).

    ``model`` is the configuration that was asked for, its motor stream fitted to the pairs.
    """

    buckets: tuple[PairBucket, ...]
    excluded: dict[str, int]
    model: ModelConfig

    @property
    def motor(self) -> Float64Array | None:
        """[P, C] displacements or commands of all pairs, None for models without a motor stream."""
        return _all_commands(self.buckets)

    @property
    def pair_count(self) -> int:
        return sum(len(bucket.pairs) for bucket in self.buckets)

    def sample(self, *, seed: int, step: int, batch_size: int, device: str) -> Batch:
        """The batch of one step: a pure function of (seed, step), so that a resumed run sees the same data.

        Half of the pairs that may be are mirrored left to right, with their motion.
        """
        rng = np.random.default_rng([seed, step])
        sizes = np.array([len(bucket.pairs) for bucket in self.buckets], dtype=np.float64)
        bucket = self.buckets[int(rng.choice(len(self.buckets), p=sizes / sizes.sum()))]
        chosen = rng.integers(len(bucket.pairs), size=batch_size)
        source, target = (bucket.frames[bucket.pairs[chosen, side]] for side in (0, 1))
        motion = bucket.motion[chosen].copy()
        mirrored = (rng.random(batch_size) < 0.5) & bucket.mirrorable[chosen]
        source[mirrored], target[mirrored] = source[mirrored, :, ::-1], target[mirrored, :, ::-1]
        motion[mirrored] *= np.array(MIRRORED_MOTION_SIGNS, dtype=np.float32)
        interval_s = bucket.interval_s[chosen]
        motor = None
        if bucket.motor is not None:
            commands = bucket.motor[chosen].copy()
            commands[mirrored] *= MIRRORED_DISPLACEMENT_SIGNS if mirrored.any() else 1
            motor = encode(commands, interval_s, self.model)
        batch = collate_arrays(source, target, motion, interval_s, motor, device=device)
        if bucket.measured_px is None:
            return batch
        measured = [bucket.measured(int(one), mirrored=bool(flip)) for one, flip in zip(chosen, mirrored, strict=True)]
        return batch._replace(measured=tuple(measured))


@dataclass(eq=False)
class _Growing:
    frames: list[Uint8Array]
    pairs: list[tuple[int, int]]
    windows: list[MotionWindow]
    mirrorable: list[bool]
    motor: list[Float64Array]
    measured_px: list[NDArray[np.float16]]
    confidence: list[Uint8Array]


def load_training_data(
    paths: Sequence[Path],
    config: ModelConfig,
    look_aheads: Sequence[int],
    *,
    measure: bool = False,
    seed: int = 0,
    split: SplitConfig | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> TrainingData:
    """Read recordings of any known layout. A pair that cannot be used is counted, by the code of its fault.

    Args:
        seed: of the clustering of displacements; a configuration that is fitted already is kept.
        split: which pairs are kept for a test; they are counted in ``excluded`` as ``held_out``, those with a frame on
            either side as ``straddling``.
        measure: measure the flow of every pair, too (milliseconds each, 5 bytes a flow cell).

    Raises:
        DatasetError: as ``open_recording``; ``training_data_empty`` when no pair is left; ``trajectory_missing`` for a
            model whose motor input is a displacement; ``motor_commands_differ`` in length.
        InvalidInputError: as ``make_view`` for the camera of a whole recording.
        ConfigError: as ``fitted_motor``.
    """
    buckets: dict[tuple[int, int], _Growing] = defaultdict(lambda: _Growing([], [], [], [], [], [], []))
    excluded: Counter[str] = Counter()
    for done, path in enumerate(paths):
        _add_recording(path, config, look_aheads, buckets, excluded, measure=measure, split=split or SplitConfig())
        if on_progress is not None:
            on_progress(done + 1, len(paths))
    filled = [buckets[size] for size in sorted(buckets) if buckets[size].pairs]
    if not filled:
        raise DatasetError(
            f"training data: expected at least one usable frame pair in {len(paths)} recordings, found none "
            f"(left out: {dict(excluded)})",
            code="training_data_empty",
            field="data",
        )
    lengths = sorted({len(command) for bucket in filled for command in bucket.motor})
    if len(lengths) > 1:
        raise DatasetError(
            f"training data: expected motor commands of one length in all recordings, found {lengths} numbers",
            code="motor_commands_differ",
            field="data",
        )
    finished = tuple(_finished(bucket) for bucket in filled)
    return TrainingData(finished, dict(excluded), _fitted(config, finished, seed=seed))


def _all_commands(buckets: Sequence[PairBucket]) -> Float64Array | None:
    commands = [bucket.motor for bucket in buckets if bucket.motor is not None]
    return np.concatenate(commands) if commands else None


def _fitted(config: ModelConfig, buckets: Sequence[PairBucket], *, seed: int) -> ModelConfig:
    commands = _all_commands(buckets)
    return config if commands is None or config.motor_is_fitted else fitted_motor(commands, config, seed=seed)


def _add_recording(
    path: Path,
    config: ModelConfig,
    look_aheads: Sequence[int],
    buckets: dict[tuple[int, int], _Growing],
    excluded: Counter[str],
    *,
    measure: bool,
    split: SplitConfig,
) -> None:
    recording = open_recording(path)
    pairs = RecordingPairs(recording, look_aheads, motor_source=config.motor_source)
    camera = recording.camera
    if camera is not None:  # one that cannot be used would exclude every pair: said at once instead
        make_view(config.view, width=camera.width, height=camera.height, camera=camera)
    in_camera_axes = config.motion_window.axes == "camera" and camera is not None and camera.T_cam_imu is not None
    mirrorable = in_camera_axes and config.motor_source != "command"
    # A few at a time: whole recordings at the source images' size would not fit into memory.
    read = lru_cache(maxsize=FRAMES_HELD)(partial(_read, recording))
    places: dict[int, int] = {}  # of the frames of usable pairs in their bucket
    for index in _for_training(pairs, split, excluded):
        indices = pairs.indices[index]
        try:
            source, target = (_require(read(one)) for one in indices)
            pair = FramePair(source, target, pairs.imu(index), camera)
            window = _require_judgeable(build_motion_window(pair, config.motion_window))
            motor = None if config.motor_source is None else require_command(pairs.motor_command(index), config)
            height, width = source.image.shape
            view = make_view(config.view, width=width, height=height, camera=camera)
        except (InvalidInputError, DatasetError) as err:
            excluded[err.code] += 1
            continue
        bucket = buckets[view.height, view.width]
        for one, frame in zip(indices, (source, target), strict=True):
            if one not in places:
                places[one] = len(bucket.frames)
                bucket.frames.append(view.render(frame.image))
        bucket.pairs.append((places[indices[0]], places[indices[1]]))
        bucket.windows.append(window)
        bucket.mirrorable.append(mirrorable)
        if motor is not None:
            bucket.motor.append(motor)
        if measure:
            views = (bucket.frames[place] for place in bucket.pairs[-1])
            measured = measure_flow(*views, stride=FLOW_STRIDE, thorough=True)
            bucket.measured_px.append(measured.flow_px.astype(np.float16))
            bucket.confidence.append((measured.confidence * 255).astype(np.uint8))


def _for_training(pairs: RecordingPairs, split: SplitConfig, excluded: Counter[str]) -> Sequence[int]:
    if split.rule == "none":
        return range(len(pairs))
    parts = split_pairs(pairs, split.rule, seed=split.seed, test_share=split.test_share, block_s=split.block_s)
    excluded.update({"held_out": len(parts.test), "straddling": len(parts.straddling)})
    return parts.train


def _read(recording: Recording, index: int) -> Frame | ViflowError:
    """A frame, or why it cannot be read: that excludes its pairs only."""
    try:
        return recording.frame(index)
    except (InvalidInputError, DatasetError) as err:
        return err


def _require(frame: Frame | ViflowError) -> Frame:
    if isinstance(frame, Frame):
        return frame
    raise InvalidInputError(frame.message, code=frame.code, field=frame.field)


def _require_judgeable(window: MotionWindow) -> MotionWindow:
    for fault in window.faults:
        if fault.severity == "abstain":
            raise InvalidInputError(fault.message, code=fault.code, field="imu")
    return window


def _finished(bucket: _Growing) -> PairBucket:
    return PairBucket(
        frames=np.stack(bucket.frames),
        pairs=np.array(bucket.pairs, dtype=np.int64),
        motion=np.stack([window.values for window in bucket.windows]),
        interval_s=np.array([window.interval_s for window in bucket.windows], dtype=np.float32),
        mirrorable=np.array(bucket.mirrorable, dtype=np.bool_),
        motor=np.stack(bucket.motor) if bucket.motor else None,
        measured_px=np.stack(bucket.measured_px) if bucket.measured_px else None,
        confidence=np.stack(bucket.confidence) if bucket.confidence else None,
    )
