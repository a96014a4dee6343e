"""``simulate``: a configuration becomes a directory of sequences; finished ones are kept, so a run can be resumed."""

from __future__ import annotations

import json
import multiprocessing
import os
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from importlib.metadata import version
from pathlib import Path
from typing import Any

from viflow_anomaly.errors import ConfigError
from viflow_anomaly.simulator.config import SimulatorConfig
from viflow_anomaly.simulator.gl import load_mujoco
from viflow_anomaly.simulator.sequence import write_sequence

WORLD_VERSION = 2  # raised whenever the same seed gives other bytes


def simulate(
    config: SimulatorConfig, out_dir: Path, *, on_progress: Callable[[int, int], None] | None = None
) -> list[Path]:
    """Write ``config.sequences`` sequences as ``out_dir/<rig>_<seed>`` (six digits), each a EuRoC ASL tree.

    Each is written beside its place and renamed when it is complete. One that is there and complete with the same
    configuration is left alone.

    Args:
        on_progress: called with (sequences done, sequences in all) after each, in this process.

    Returns:
        The sequence directories, in order of their seeds.

    Raises:
        MissingDependencyError: ``mujoco_missing``, ``gl_missing``.
        ConfigError: ``simulation_exists`` when a directory holds a sequence of another configuration.
    """
    load_mujoco()
    seeds = range(config.seed, config.seed + config.sequences)
    places = {seed: out_dir / f"{config.rig}_{seed:06d}" for seed in seeds}
    missing = [seed for seed in seeds if not _is_complete(config, seed, places[seed])]
    out_dir.mkdir(parents=True, exist_ok=True)
    done = config.sequences - len(missing)
    for _ in _finish_each(config, {seed: places[seed] for seed in missing}):
        done += 1
        if on_progress is not None:
            on_progress(done, config.sequences)
    if not missing and on_progress is not None:
        on_progress(done, config.sequences)
    return list(places.values())


def _record(config: SimulatorConfig, seed: int) -> dict[str, Any]:
    return {"world_version": WORLD_VERSION, "config": config.sequence_record(seed)}


def _is_complete(config: SimulatorConfig, seed: int, place: Path) -> bool:
    if not place.exists():
        return False
    note = place / "simulation.json"
    try:
        found = json.loads(note.read_text(encoding="utf-8"))
        found = {key: found.get(key) for key in ("world_version", "config")}
    except (OSError, ValueError, AttributeError) as err:
        raise ConfigError(
            f"{place}: expected nothing or a simulated sequence, found something without a readable simulation.json; "
            "choose another directory or remove it",
            code="simulation_exists",
        ) from err
    if found != _record(config, seed):
        raise ConfigError(
            f"{place}: expected nothing or a sequence of this configuration {_record(config, seed)}, "
            f"found one of {found}; choose another directory or remove it",
            code="simulation_exists",
        )
    return True


def _finish_each(config: SimulatorConfig, places: dict[int, Path]) -> Iterator[int]:
    """Write the sequences, here or in processes; yields the seeds as they are done."""
    workers = min(config.jobs, len(places))
    if workers <= 1:
        for seed, place in places.items():
            _write_one(config, seed, place)
            yield seed
        return
    # GL contexts do not survive a fork.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context, initializer=_one_thread_each) as pool:
        waiting = {pool.submit(_write_one, config, seed, place): seed for seed, place in places.items()}
        try:
            for finished in as_completed(waiting):
                finished.result()
                yield waiting[finished]
        finally:
            for future in waiting:
                future.cancel()


def _one_thread_each() -> None:
    """Mesa's rasteriser would start a thread for every core in every process."""
    os.environ.setdefault("LP_NUM_THREADS", "1")


def _write_one(config: SimulatorConfig, seed: int, place: Path) -> None:
    partial = place.with_name(f".{place.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        write_sequence(config, seed, partial)
        note = {**_record(config, seed), "package_version": version("viflow-anomaly")}
        (partial / "simulation.json").write_text(json.dumps(note, indent=2, sort_keys=True) + "\n", encoding="utf-8")
        partial.rename(place)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
