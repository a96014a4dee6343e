"""The second motion input: a displacement or a real command -> the numbers of a network's motor stream [Methods].

- ``sffms``, the paper's surrogate feed-forward motor signal: K-means over the displacements between the frames of the
  training pairs, and one-hot by the nearest centroid. Displacements are the camera's, in metres along the source
  camera's axes, as a command is given in the vehicle's own axes.
- ``motor``: what the platform itself says (a speed, a commanded velocity): its numbers, standardised, and the same
  times the frame interval, because distance is what moves pixels. This lifts the paper's fourth limit [Limitations].
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.config import ModelConfig, MotorConfig, MotorSource
from viflow_anomaly.errors import ConfigError, InvalidInputError
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.sensor_data import Float64Array, FramePair

MIRRORED_DISPLACEMENT_SIGNS = (-1, 1, 1)
"""Left and right exchanged in the camera's axes."""
INTERVALS_PER_UNIT = 10.0
"""Intervals are fed in tenths of a second, so that they are near 1, as everywhere in the networks."""
MAX_COMMAND = 1e6
"""No speed or displacement in SI units is larger; distances of such numbers overflow."""
MAX_COMMAND_NUMBERS = 64
MIN_DEVIATION = 1e-6
"""Of a command over its size: what varied less did not vary, and is not blown up when it does one day."""
KMEANS_STARTS = 8
KMEANS_ITERATIONS = 50


def motor_input(pair: FramePair, config: ModelConfig) -> Float32Array | None:
    """[M] what the network's motor stream takes for ``pair``, M = ``config.motor_numbers``; None where it has none.

    Raises:
        InvalidInputError: ``motor_command_missing``, ``motor_command_length``.
        ConfigError: ``motor_not_fitted``.
    """
    if config.motor_source is None:
        return None
    numbers = require_command(pair.motor_command, config)
    return np.asarray(encode(numbers[None], np.array([pair.interval_ns * 1e-9]), config)[0])


def require_supported(pair: FramePair, motor_source: MotorSource | None) -> None:
    """Refuse a command sent to a model that would not look at it. (Recordings may hold one that nobody asked for.)

    Raises:
        InvalidInputError: ``motor_command_unsupported``.
    """
    if pair.motor_command is not None and motor_source is None:
        raise InvalidInputError(
            f"motor_command: expected none, because this model takes no motor input, found {len(pair.motor_command)} "
            "numbers",
            code="motor_command_unsupported",
            field="motor_command",
        )


def require_command(command: Float64Array | None, config: ModelConfig) -> Float64Array:
    """The command that a model with a motor stream needs, before it is encoded.

    Raises:
        InvalidInputError: ``motor_command_missing``, ``motor_command_invalid``, ``motor_command_length``.
    """
    wanted = {
        "displacement": "the camera's displacement x y z between the frames, in metres along the source camera's axes",
        "command": f"{len(config.motor.mean) or 'its'} numbers, in the order and units of its training",
        None: "none",
    }[config.motor_source]
    if command is None:
        raise InvalidInputError(
            f"motor_command: this model (motion inputs {config.motion_inputs}) expects {wanted}, found none",
            code="motor_command_missing",
            field="motor_command",
        )
    if not np.isfinite(command).all() or np.abs(command).max(initial=0) > MAX_COMMAND:
        found = str(command.tolist())[:99]
        raise InvalidInputError(
            f"motor_command: expected finite numbers of at most {MAX_COMMAND:g} in size, found {found}",
            code="motor_command_invalid",
            field="motor_command",
        )
    count = 3 if config.motor_source == "displacement" else len(config.motor.mean) or len(command)
    if len(command) != count:
        raise InvalidInputError(
            f"motor_command: this model (motion inputs {config.motion_inputs}) expects {wanted}, "
            f"found {len(command)} numbers",
            code="motor_command_length",
            field="motor_command",
        )
    return command


def encode(commands: Float64Array, interval_s: NDArray[np.floating], config: ModelConfig) -> Float32Array:
    """Commands [P, C] and intervals [P] -> [P, M] float32.

    Raises:
        ConfigError: ``motor_not_fitted``.
    """
    fitted = config.motor
    if not config.motor_is_fitted:
        raise ConfigError(
            f"model.motor: expected values fitted by a training for the motion inputs {config.motion_inputs!r}, "
            "found none",
            code="motor_not_fitted",
            field="model.motor",
        )
    if config.motor_source == "displacement":
        return np.eye(fitted.clusters, dtype=np.float32)[nearest_cluster(commands, fitted)]
    standard = (commands - np.array(fitted.mean)) / np.array(fitted.deviation)
    over_interval = standard * interval_s[:, None] * INTERVALS_PER_UNIT
    return np.concatenate([standard, over_interval], axis=1).astype(np.float32)


def nearest_cluster(displacements_m: Float64Array, fitted: MotorConfig) -> NDArray[np.intp]:
    """[P] index of the nearest centroid of each displacement [P, 3]."""
    return np.asarray(_squared_distances(displacements_m, fitted).argmin(axis=1))


def clustering_error_m(displacements_m: Float64Array, fitted: MotorConfig) -> Float64Array:
    """[P, 3] what one-hot loses of displacements [P, 3]: displacement minus its centroid (the paper's Fig. 3)."""
    return np.asarray(displacements_m - np.array(fitted.centroids_m)[nearest_cluster(displacements_m, fitted)])


def _squared_distances(displacements_m: Float64Array, fitted: MotorConfig) -> Float64Array:
    difference = displacements_m[:, None] - np.array(fitted.centroids_m)
    return np.asarray(np.square(difference).sum(axis=-1))


def fitted_motor(commands: Float64Array, config: ModelConfig, *, seed: int) -> ModelConfig:
    """``config`` with the motor stream's values fitted to the training pairs' commands [P, C].

    Raises:
        ConfigError: ``config_invalid``: fewer different displacements than clusters, clusters that stay empty, or
            commands of more than 64 numbers.
    """
    if commands.shape[1] > MAX_COMMAND_NUMBERS:
        raise ConfigError(
            f"motor commands: expected at most {MAX_COMMAND_NUMBERS} numbers, found {commands.shape[1]}",
            code="config_invalid",
            field="model.motor",
        )
    if config.motor_source == "displacement":
        values = {"centroids_m": _kmeans(commands, config.motor.clusters, seed=seed)}
    else:
        deviation = commands.std(axis=0)
        deviation[deviation < MIN_DEVIATION * np.maximum(np.abs(commands).max(axis=0), 1)] = 1.0
        values = {"mean": tuple(commands.mean(axis=0).tolist()), "deviation": tuple(deviation.tolist())}
    return config.model_copy(update={"motor": MotorConfig.model_validate({**config.motor.model_dump(), **values})})


def _kmeans(displacements_m: Float64Array, clusters: int, *, seed: int) -> tuple[tuple[float, ...], ...]:
    """Centroids in lexicographic order, the best of a few k-means++ starts."""
    from scipy.cluster.vq import ClusterError, kmeans2  # noqa: PLC0415  # only a training needs it

    different = len(np.unique(displacements_m, axis=0))
    if different < clusters:
        raise ConfigError(
            f"model.motor.clusters: expected at most as many as there are different displacements in the training "
            f"data, {different}, found {clusters}",
            code="config_invalid",
            field="model.motor.clusters",
        )
    best, lowest = None, np.inf
    for start in range(KMEANS_STARTS):
        rng = np.random.default_rng([seed, start])
        try:
            centroids, _ = kmeans2(displacements_m, clusters, KMEANS_ITERATIONS, minit="++", rng=rng, missing="raise")
        except ClusterError:  # a cluster lost its last member
            continue
        error = np.square(displacements_m[:, None] - centroids).sum(axis=-1).min(axis=1).mean()
        if error < lowest:
            best, lowest = centroids, error
    if best is None:
        raise ConfigError(
            f"model.motor.clusters: expected {clusters} clusters that all keep a displacement, found none in "
            f"{KMEANS_STARTS} starts of K-means",
            code="config_invalid",
            field="model.motor.clusters",
        )
    order = np.lexsort(best.T[::-1])
    return tuple(tuple(row) for row in best[order].tolist())
