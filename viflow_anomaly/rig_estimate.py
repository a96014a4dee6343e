"""What an IMU and its mounting get wrong, estimated slowly over a stream: gyro bias, time offset, small mounting turn.

Each pair's correction measures how the camera turned beside what the gyro said. To first order that is linear in seven
unknowns. With rates w in camera axes, the interval T and the turn th = integral of w over it,

    turned = J (T R_cam_imu bias - (w(end) - w(start)) offset + th x mounting),     J = I - [th]x / 2

A Kalman filter with a random walk follows them; ``RigEstimate`` is its whole state, a value that is passed in and given
back. Measured turns do not err at random: a depth that the network misread makes a sideways step look like a turn, for
as long as the scene stays. That *lasting error* is estimated beside them (three more states, forgotten within seconds),
or the filter would take it for a bias and be sure of it. What a stream does not show (a mounting without rotation, an
offset at a constant rate) keeps its prior and its large sigma.

Signs: ``bias`` is what the gyro reads at rest, in IMU axes; ``offset`` is to be added to
``PinholeCamera.time_offset_s``; the true mounting is exp(``mounting``) R_cam_imu, ``mounting`` in camera axes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from viflow_anomaly.config import RigEstimateConfig
from viflow_anomaly.correction import Correction
from viflow_anomaly.errors import InvalidInputError
from viflow_anomaly.geometry import so3_exp
from viflow_anomaly.sensor_data import Float64Array, FramePair, ImuSamples

UNKNOWNS, STATES = 7, 10
BIAS, OFFSET, MOUNTING, LASTING = slice(0, 3), slice(3, 4), slice(4, 7), slice(7, 10)
PARTS = {"gyro_bias": BIAS, "time_offset": OFFSET, "mounting": MOUNTING}
RATE_WINDOW_S = 0.015
"""A rate at a frame is the mean over so much before it: nothing behind the target is asked for, so that a stream and
a batch see the same, and vibration is averaged."""
MAX_DRIFT_S = 3600.0


@dataclass(frozen=True, eq=False)
class TurnObservation:
    """What one pair says: turned_rad = design @ unknowns + noise.

    Attributes:
        source_ns, target_ns: of the pair.
        design: [3, 7].
        turned_rad: [3] beside the gyro's turn, as the recording's own calibration has it.
        covariance_rad2: [3, 3] as the correction has it.
    """

    source_ns: int
    target_ns: int
    design: Float64Array
    turned_rad: Float64Array
    covariance_rad2: Float64Array

    def to_json(self) -> dict[str, Any]:
        """Plain numbers; a float's shortest decimal is read back as the same float."""
        numbers: dict[str, Any] = {
            name: getattr(self, name).tolist() for name in ("design", "turned_rad", "covariance_rad2")
        }
        return numbers

    @classmethod
    def from_json(cls, stamps: tuple[int, int], values: Mapping[str, Any]) -> Self:
        """What ``to_json`` gave for the pair of these stamps.

        Raises:
            InvalidInputError: ``rig_observation_malformed``.
        """
        shapes = {"design": (3, UNKNOWNS), "turned_rad": (3,), "covariance_rad2": (3, 3)}
        try:
            arrays = {name: np.array(values[name], dtype=np.float64) for name in shapes}
        except (KeyError, TypeError, ValueError) as err:
            raise _malformed(f"found {err!r}") from err
        for name, shape in shapes.items():
            if arrays[name].shape != shape or not np.isfinite(arrays[name]).all():
                raise _malformed(f"found {name} of shape {arrays[name].shape}")
        return cls(*stamps, arrays["design"], arrays["turned_rad"], arrays["covariance_rad2"])


def _malformed(found: str) -> InvalidInputError:
    expected = "expected an observation of the rig with finite numbers"
    return InvalidInputError(f"{expected}, {found}", code="rig_observation_malformed", field="rig_estimate")


@dataclass(frozen=True, eq=False)
class RigEstimate:
    """The state of the filter; ``RigEstimate.prior(config)`` begins one.

    Attributes:
        mean: [10] gyro bias (rad/s, IMU axes), time offset (s), mounting (rad, camera axes), lasting error of the
            measured turns (rad).
        covariance: [10, 10].
        pairs: that were taken in.
        rejected: that were outliers.
        rejected_in_a_row: the last of them.
        source_ns: of the last observation.
    """

    mean: Float64Array
    covariance: Float64Array
    pairs: int = 0
    rejected: int = 0
    rejected_in_a_row: int = 0
    source_ns: int | None = None

    @classmethod
    def prior(cls, config: RigEstimateConfig) -> Self:
        return cls(np.zeros(STATES), np.diag(_prior_sigmas(config) ** 2))

    @property
    def sigmas(self) -> Float64Array:
        """[7] deviations of the unknowns."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[:UNKNOWNS]))

    @property
    def gyro_bias_rad_s(self) -> Float64Array:
        return self.mean[BIAS]

    @property
    def time_offset_s(self) -> float:
        """To be added to the calibrated one."""
        return float(self.mean[OFFSET][0])

    @property
    def mounting_rad(self) -> Float64Array:
        return self.mean[MOUNTING]

    def known(self, config: RigEstimateConfig) -> tuple[str, ...]:
        """The parts, by name, whose sigmas are small enough to be applied."""
        limits = (config.apply_bias_sigma_rad_s, config.apply_offset_sigma_s, config.apply_mounting_sigma_rad)
        sigmas = self.sigmas
        return tuple(
            name
            for (name, part), limit in zip(PARTS.items(), limits, strict=True)
            if bool((sigmas[part] <= limit).all())
        )

    def applicable(self, config: RigEstimateConfig) -> Float64Array:
        """[7] what the next pair is corrected by: the known parts with ``config.apply``, else zeros."""
        applied = np.zeros(UNKNOWNS)
        for name in self.known(config) if config.apply and config.enabled else ():
            applied[PARTS[name]] = self.mean[PARTS[name]]
        return applied

    def report(self, config: RigEstimateConfig) -> dict[str, Any]:
        """As ``run.json`` has it."""
        sigmas = self.sigmas
        return {
            "gyro_bias_rad_s": _rounded(self.gyro_bias_rad_s),
            "gyro_bias_sigma_rad_s": _rounded(sigmas[BIAS]),
            "time_offset_s": _rounded(self.mean[OFFSET])[0],
            "time_offset_sigma_s": _rounded(sigmas[OFFSET])[0],
            "mounting_rad": _rounded(self.mounting_rad),
            "mounting_sigma_rad": _rounded(sigmas[MOUNTING]),
            "pairs": self.pairs,
            "rejected": self.rejected,
            "applied": list(self.known(config)) if config.apply else [],
        }


def observe(
    pair: FramePair, correction: Correction | None, config: RigEstimateConfig, applied: Float64Array | None = None
) -> TurnObservation | None:
    """What a pair says, None where it says nothing: no mounting is known, nothing converged, too few cells agree.

    Args:
        pair: as it was judged.
        correction: of its prediction, from the gyro's rotation on.
        config: which pairs may speak.
        applied: [7] what ``pair`` had been corrected by; it is added back, so that observations are always beside the
            recording's own calibration.
    """
    camera, turn = pair.camera, None if correction is None else correction.turn
    if correction is None or turn is None or camera is None or camera.R_cam_imu is None:
        return None
    if correction.inlier_share < config.min_inlier_share or not np.isfinite(turn.covariance_rad2).all():
        return None
    design = turn_design(pair, camera.R_cam_imu)
    turned = turn.turned_rad if applied is None else turn.turned_rad + design @ applied
    return TurnObservation(pair.source.timestamp_ns, pair.target.timestamp_ns, design, turned, turn.covariance_rad2)


def turn_design(pair: FramePair, R_cam_imu: Float64Array) -> Float64Array:
    """[3, 7] how the turn beside the gyro's follows the unknowns, see the module."""
    offset_ns = 0 if pair.camera is None else round(pair.camera.time_offset_s * 1e9)
    interval_s = pair.interval_ns * 1e-9
    window_s = min(RATE_WINDOW_S, interval_s)
    edges_s = np.array([-window_s, 0.0, interval_s - window_s, interval_s])
    turned = _gyro_integral(pair.imu, pair.source.timestamp_ns + offset_ns, edges_s) @ R_cam_imu.T
    change_rad_s = ((turned[3] - turned[2]) - (turned[1] - turned[0])) / window_s
    across = _cross(turned[3] - turned[1])
    design = np.zeros((3, UNKNOWNS))
    design[:, BIAS] = interval_s * R_cam_imu
    design[:, OFFSET] = -change_rad_s[:, None]
    design[:, MOUNTING] = across
    return np.asarray((np.eye(3) - 0.5 * across) @ design)


def _gyro_integral(imu: ImuSamples, start_ns: int, edges_s: Float64Array) -> Float64Array:
    """[E, 3] of the rates joined by straight lines, from the first sample that the edges touch; ends are held."""
    times_s = np.asarray((imu.timestamps_ns - start_ns) * 1e-9, dtype=np.float64)
    first = max(int(np.searchsorted(times_s, edges_s[0], side="right")) - 1, 0)
    kept = slice(first, int(np.searchsorted(times_s, edges_s[-1], side="left")) + 1)
    times_s, rates = times_s[kept], imu.gyro_rad_s[kept]
    knots_s = np.union1d(times_s, edges_s)
    values = np.stack([np.interp(knots_s, times_s, rates[:, axis]) for axis in range(3)], axis=1)
    integral = np.zeros_like(values)
    np.cumsum(0.5 * (values[1:] + values[:-1]) * np.diff(knots_s)[:, None], axis=0, out=integral[1:])
    return np.asarray(integral[np.searchsorted(knots_s, edges_s)])


def update(estimate: RigEstimate, observation: TurnObservation, config: RigEstimateConfig) -> RigEstimate:
    """One step of the filter; observations come in the order of their source frames."""
    estimate = _drifted(estimate, observation.source_ns, config)
    design, covariance = np.hstack([observation.design, np.eye(3)]), estimate.covariance
    noise = config.noise_scale**2 * observation.covariance_rad2 + config.noise_floor_rad**2 * np.eye(3)
    innovation = observation.turned_rad - design @ estimate.mean
    spread = design @ covariance @ design.T
    distance = float(np.sqrt(innovation @ np.linalg.solve(spread + noise, innovation) / 3))
    if distance > config.gate_sigmas:
        return _after_outlier(estimate, config)
    noise = noise * max(1.0, distance / config.huber_sigmas)
    gain = np.linalg.solve(spread + noise, design @ covariance).T
    kept = np.eye(STATES) - gain @ design
    after = kept @ covariance @ kept.T + gain @ noise @ gain.T  # Joseph's form: stays positive
    mean = estimate.mean + gain @ innovation
    return replace(
        estimate, mean=mean, covariance=0.5 * (after + after.T), pairs=estimate.pairs + 1, rejected_in_a_row=0
    )


def _after_outlier(estimate: RigEstimate, config: RigEstimateConfig) -> RigEstimate:
    """Counted only; so many in a row say that the estimate is wrong, not they."""
    in_a_row = estimate.rejected_in_a_row + 1
    estimate = replace(estimate, rejected=estimate.rejected + 1, rejected_in_a_row=in_a_row)
    if in_a_row < config.reopen_after:
        return estimate
    return replace(estimate, covariance=RigEstimate.prior(config).covariance, rejected_in_a_row=0)


def _drifted(estimate: RigEstimate, source_ns: int, config: RigEstimateConfig) -> RigEstimate:
    """At a later frame: less sure, but never less than the prior was; the lasting error fades."""
    before_ns = estimate.source_ns
    if before_ns is None:
        return replace(estimate, source_ns=source_ns)
    elapsed_s = min(max(source_ns - before_ns, 0) * 1e-9, MAX_DRIFT_S)
    fading = np.ones(STATES)
    fading[LASTING] = np.exp(-elapsed_s / config.lasting_s)
    drifts = (config.bias_drift_rad_s, config.offset_drift_s, config.mounting_drift_rad)
    variances = np.zeros(STATES)
    variances[:UNKNOWNS] = np.repeat(np.square(drifts), (3, 1, 3)) * elapsed_s
    variances[LASTING] = config.lasting_sigma_rad**2 * (1 - fading[LASTING] ** 2)
    covariance = estimate.covariance * np.outer(fading, fading)
    room = np.maximum(_prior_sigmas(config) ** 2 - np.diag(covariance), 0.0)
    covariance = covariance + np.diag(np.minimum(variances, room))
    return replace(estimate, mean=estimate.mean * fading, covariance=covariance, source_ns=source_ns)


def corrected_pair(pair: FramePair, unknowns: Float64Array) -> FramePair:
    """The pair as a rig without these errors would have given it.

    Args:
        pair: of a camera whose mounting is known.
        unknowns: [7] as in ``RigEstimate.mean``; zeros leave the pair as it is.
    """
    camera = pair.camera
    if not unknowns.any() or camera is None or camera.T_cam_imu is None:
        return pair
    T_cam_imu = camera.T_cam_imu.copy()
    T_cam_imu[:3, :3] = so3_exp(unknowns[MOUNTING]) @ T_cam_imu[:3, :3]
    camera = replace(camera, T_cam_imu=T_cam_imu, time_offset_s=camera.time_offset_s + float(unknowns[OFFSET][0]))
    return replace(pair, imu=replace(pair.imu, gyro_rad_s=pair.imu.gyro_rad_s - unknowns[BIAS]), camera=camera)


def _prior_sigmas(config: RigEstimateConfig) -> Float64Array:
    """[10] deviations before anything is seen."""
    sigmas = (config.bias_sigma_rad_s, config.offset_sigma_s, config.mounting_sigma_rad, config.lasting_sigma_rad)
    return np.asarray(np.repeat(sigmas, (3, 1, 3, 3)), dtype=np.float64)


def _cross(vector: Float64Array) -> Float64Array:
    """[3, 3] with _cross(a) @ b = a x b."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _rounded(values: Float64Array) -> list[float]:
    return [round(float(value), 6) for value in values]
