"""Frames and IMU samples as they come -> detections with tracks, for a robot that looks while it moves.

The state is a value: ``DetectionStream`` holds its parts only, each step takes a state and gives the next one. What
comes late, twice or out of order is left out and reported, and the stream goes on::

    stream, state = DetectionStream(detector, camera=camera), StreamState()
    state, detections, faults = stream.add_imu(state, samples)    # whenever samples come
    state, detections, faults = stream.add_frame(state, frame)    # whenever a frame comes

A pair is judged as soon as the IMU reaches its target frame, so that either call may give its detection. It is the one
that ``batch`` writes for the same recording. A clock that was set back needs a new state.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple, Protocol

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat

from viflow_anomaly.config import FrozenConfig, RigEstimateConfig, TrackingConfig
from viflow_anomaly.detection import Detection, Reason
from viflow_anomaly.errors import ViflowError
from viflow_anomaly.imu_log import ImuLog
from viflow_anomaly.prediction import PredictedFlow
from viflow_anomaly.rig_estimate import OFFSET, RigEstimate, corrected_pair, observe, update
from viflow_anomaly.sensor_data import Float64Array, Frame, FramePair, ImuSamples, PinholeCamera
from viflow_anomaly.tracking import Tracker, TrackingState


class StreamConfig(FrozenConfig):
    """What a stream keeps, and how long it waits.

    ``before_s``, ``after_s``: how much IMU a pair gets ahead of its source and waits for behind its target (the paper's
    motion windows reach beyond it). ``max_frame_delay_s``: how long after its IMU samples a frame may come.
    ``max_waiting_frames``: kept while their IMU is not there yet. ``tracking``: None leaves ``track_id`` null.
    ``rig_estimate``: what the stream learns of the IMU and its mounting.
    """

    before_s: NonNegativeFloat = 0.25
    after_s: NonNegativeFloat = 0.0
    max_frame_delay_s: PositiveFloat = 1.0
    max_waiting_frames: int = Field(default=8, ge=1, le=1024)
    max_imu_samples: int = Field(default=20_000, ge=2)
    tracking: TrackingConfig | None = TrackingConfig()
    rig_estimate: RigEstimateConfig = RigEstimateConfig()


class Judged(Protocol):
    """A detection, and how the camera turned; None from a detector that does not know."""

    @property
    def detection(self) -> Detection: ...

    @property
    def predicted(self) -> PredictedFlow | None: ...


class PairJudge(Protocol):
    """What a stream needs of ``viflow_anomaly.detector.AnomalyDetector``."""

    def analyze(self, pair: FramePair, *, decode_ms: float = 0.0) -> Judged: ...


@dataclass(frozen=True, eq=False)
class StreamState:
    """What a stream remembers; ``StreamState()`` begins one.

    Attributes:
        imu: the samples that a pair may still need.
        frames: the source of the next pair and the frames behind it that wait for their IMU.
        tracking: after the last pair that was judged.
        rig: likewise; None before the first pair that said something of the rig.
    """

    imu: ImuLog | None = None
    frames: tuple[Frame, ...] = ()
    tracking: TrackingState = field(default_factory=TrackingState)
    rig: RigEstimate | None = None


class StreamStep(NamedTuple):
    """What one call came to.

    Attributes:
        state: to go on from.
        detections: of the pairs that could be judged now, in time order.
        faults: what was left out and why: ``frame_duplicate``, ``frame_out_of_order``, ``imu_duplicate``,
            ``imu_out_of_order``, ``imu_accel_changed``, ``imu_dropped`` (more samples than may be kept), ``imu_late``
            (a pair was given up: too many frames wait for their IMU), and the codes of errors that a pair raised.
    """

    state: StreamState
    detections: tuple[Detection, ...] = ()
    faults: tuple[Reason, ...] = ()


@dataclass(frozen=True)
class DetectionStream:
    """Pairs each frame with the next one, judges the pairs and tracks what is found.

    Args:
        detector: what judges a pair.
        camera: calibration of the frames, or None.
        config: limits, and how to track.
    """

    detector: PairJudge
    camera: PinholeCamera | None = None
    config: StreamConfig = field(default_factory=StreamConfig)

    def add_frame(self, state: StreamState, frame: Frame) -> StreamStep:
        """One frame, later than those before."""
        newest_ns = state.frames[-1].timestamp_ns if state.frames else None
        if newest_ns is not None and frame.timestamp_ns <= newest_ns:
            code = "frame_duplicate" if frame.timestamp_ns == newest_ns else "frame_out_of_order"
            found = f"expected a frame later than {newest_ns} ns, found {frame.timestamp_ns} ns; it is left out"
            return StreamStep(state, faults=(Reason(code, found),))
        return self._judged(replace(state, frames=(*state.frames, frame)), [])

    def add_imu(self, state: StreamState, samples: ImuSamples) -> StreamStep:
        """Samples later than those before; of a packet that reaches back, the later part is taken."""
        imu, faults = _appended(state.imu, samples)
        return self._judged(replace(state, imu=imu), faults)

    def _judged(self, state: StreamState, faults: list[Reason]) -> StreamStep:
        """Judge all pairs whose IMU is there, give up those that wait for too long, forget what no pair needs."""
        detections = []
        while len(state.frames) > 1:
            source, target = state.frames[:2]
            there = self._is_covered(state, target)
            if not there and len(state.frames) <= self.config.max_waiting_frames:
                break
            if there:
                try:
                    state, detection = self._judge(state, source, target)
                    detections.append(detection)
                except ViflowError as err:
                    faults.append(Reason(err.code, f"pair at {source.timestamp_ns} ns: {err.message}"))
            else:
                faults.append(_given_up(source, target, len(state.frames)))
            state = replace(state, frames=state.frames[1:])
        imu, dropped = self._kept(state)
        return StreamStep(replace(state, imu=imu), tuple(detections), (*faults, *dropped))

    def _judge(self, state: StreamState, source: Frame, target: Frame) -> tuple[StreamState, Detection]:
        assert state.imu is not None
        applied, offset_ns = self._applied(state), self._offset_ns(state)
        start_ns = source.timestamp_ns + offset_ns - round(self.config.before_s * 1e9)
        end_ns = target.timestamp_ns + offset_ns + round(self.config.after_s * 1e9)
        pair = FramePair(source, target, state.imu.between(start_ns, end_ns), self.camera)
        pair = corrected_pair(pair, applied)
        judged = self.detector.analyze(pair)
        tracking, detection = state.tracking, judged.detection
        if self.config.tracking is not None:
            tracking, detection = Tracker(self.config.tracking).update(tracking, detection)
        config, predicted, rig = self.config.rig_estimate, judged.predicted, state.rig
        observation = observe(pair, predicted.correction if predicted else None, config, applied)
        if observation is not None and config.enabled:
            rig = update(rig or RigEstimate.prior(config), observation, config)
        return replace(state, tracking=tracking, rig=rig), detection

    def _applied(self, state: StreamState) -> Float64Array:
        config = self.config.rig_estimate
        return (state.rig or RigEstimate.prior(config)).applicable(config)

    def _offset_ns(self, state: StreamState) -> int:
        """t_imu - t_cam, as far as it is known by now."""
        known_s = 0.0 if self.camera is None else self.camera.time_offset_s
        return round((known_s + float(self._applied(state)[OFFSET][0])) * 1e9)

    def _is_covered(self, state: StreamState, target: Frame) -> bool:
        needed_ns = target.timestamp_ns + self._offset_ns(state) + round(self.config.after_s * 1e9)
        return state.imu is not None and int(state.imu.timestamps_ns[-1]) >= needed_ns

    def _kept(self, state: StreamState) -> tuple[ImuLog | None, list[Reason]]:
        """The samples that the frames at hand, or one that comes as late as it may, can need."""
        imu = state.imu
        if imu is None:
            return None, []
        stamps_ns = imu.timestamps_ns
        oldest_ns = int(stamps_ns[-1]) - round(self.config.max_frame_delay_s * 1e9)
        if state.frames:
            oldest_ns = min(oldest_ns, state.frames[0].timestamp_ns + self._offset_ns(state))
        first = int(np.searchsorted(stamps_ns, oldest_ns - round(self.config.before_s * 1e9), side="right")) - 1
        first, surplus = max(first, 0), len(imu) - max(first, 0) - self.config.max_imu_samples
        if surplus <= 0:
            return _rows(imu, first), []
        limit = f"expected at most {self.config.max_imu_samples} samples that pairs may need, found {surplus} more"
        return _rows(imu, first + surplus), [Reason("imu_dropped", f"{limit}; the oldest are left out")]


def _appended(imu: ImuLog | None, samples: ImuSamples) -> tuple[ImuLog, list[Reason]]:
    """The log with what is later than it of a packet, and what is to be said of the rest."""
    stamps_ns, accel = samples.timestamps_ns, samples.accel_m_s2
    if imu is None:
        return ImuLog(stamps_ns, samples.gyro_rad_s, accel), []
    if (accel is None) != (imu.accel_m_s2 is None):
        found = "samples with" if imu.accel_m_s2 is None else "samples without"
        told = f"expected all samples with or all without an accelerometer, found {found} it; they are left out"
        return imu, [Reason("imu_accel_changed", told)]
    newest_ns = int(imu.timestamps_ns[-1])
    first = int(np.searchsorted(stamps_ns, newest_ns, side="right"))
    faults = []
    if first:
        code = "imu_duplicate" if np.isin(stamps_ns[:first], imu.timestamps_ns).all() else "imu_out_of_order"
        told = f"expected samples later than {newest_ns} ns, found {first} that are not, the first at {stamps_ns[0]} ns"
        faults = [Reason(code, f"{told}; they are left out")]
    stamps_ns = np.concatenate([imu.timestamps_ns, stamps_ns[first:]])
    gyro = np.concatenate([imu.gyro_rad_s, samples.gyro_rad_s[first:]])
    joined = None if accel is None or imu.accel_m_s2 is None else np.concatenate([imu.accel_m_s2, accel[first:]])
    return ImuLog(stamps_ns, gyro, joined), faults


def _rows(imu: ImuLog, first: int) -> ImuLog:
    """From row ``first`` on, in arrays of their own: a slice would keep the whole log alive."""
    if not first:
        return imu
    accel = None if imu.accel_m_s2 is None else imu.accel_m_s2[first:].copy()
    return ImuLog(imu.timestamps_ns[first:].copy(), imu.gyro_rad_s[first:].copy(), accel)


def _given_up(source: Frame, target: Frame, waiting: int) -> Reason:
    told = f"expected IMU samples up to {target.timestamp_ns} ns (camera time), found none while {waiting} frames wait"
    return Reason("imu_late", f"{told}; the pair at {source.timestamp_ns} ns is given up")
