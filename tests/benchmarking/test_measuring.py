from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
import pytest

from viflow_anomaly.benchmarking import machine
from viflow_anomaly.benchmarking.machine import circumstances, peak_memory_mib, spending, usable_cores
from viflow_anomaly.benchmarking.made_scene import make_pair
from viflow_anomaly.benchmarking.measuring import WARM_UP, Times, in_own_process, take_turns
from viflow_anomaly.benchmarking.subjects import Subject
from viflow_anomaly.errors import ConfigError
from viflow_anomaly.sensor_data import FramePair


def test_times_are_percentiles_and_a_rate() -> None:
    times = Times.of([10.0] * 19 + [30.0])
    assert (times.median_ms, times.least_ms) == (10.0, 10.0)
    assert times.p95_ms == pytest.approx(11.0)
    assert times.pairs_per_s == pytest.approx(20 / 0.22, abs=0.01)


def test_subjects_take_turns_and_each_is_first_as_often() -> None:
    order: list[str] = []
    runs = {Subject(name): lambda pair, name=name: order.append(name) for name in "abc"}
    times = take_turns(runs, make_pair(64, 64), repeats=6, budget_s=60)
    assert order == [*"aaabbbccc", *"abc", *"bca", *"cab", *"abc", *"bca", *"cab"]
    assert [subject.name for subject in times] == ["a", "b", "c"]


def test_a_slow_subject_drops_out_after_two_times() -> None:
    calls = {"slow": 0, "fast": 0}

    def call(name: str, pair: FramePair) -> None:
        calls[name] += 1
        time.sleep(0.02 if name == "slow" else 0)

    runs = {Subject(name): lambda pair, name=name: call(name, pair) for name in calls}
    take_turns(runs, make_pair(64, 64), repeats=9, budget_s=0.01)
    assert calls == {"slow": WARM_UP + 2, "fast": WARM_UP + 9}


def hold(mebibytes: int) -> float:
    np.ones(mebibytes * 2**20, dtype=np.uint8).sum()
    return peak_memory_mib()


def refuse() -> None:
    raise ConfigError("not here", code="runtime_unavailable", field="runtime")


def test_a_process_of_its_own_has_its_own_peak() -> None:
    little, much = in_own_process(hold, 1), in_own_process(hold, 300)
    assert 250 < much - little < 400


def test_the_peak_of_another_process_is_asked_for_by_its_number() -> None:
    assert peak_memory_mib(os.getpid()) == pytest.approx(peak_memory_mib(), abs=16)
    assert peak_memory_mib(2**30) == 0.0


def test_errors_come_back_from_a_process_of_its_own() -> None:
    with pytest.raises(ConfigError, match="not here") as caught:
        in_own_process(refuse)
    assert (caught.value.code, caught.value.field) == ("runtime_unavailable", "runtime")


def test_own_work_is_not_that_of_others() -> None:
    with spending() as spent:
        until = time.process_time() + 0.2
        while time.process_time() < until:
            pass
    assert spent.wall_s >= spent.cpu_s * 0.9
    assert spent.cpu_s == pytest.approx(0.2, abs=0.1)
    assert spent.others_share is None or 0 <= spent.others_share <= 1


@pytest.mark.parametrize("text", [None, "", "cpu  1 x", "cpu"])
def test_a_system_that_does_not_say_leaves_it_open(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, text: str | None
) -> None:
    stat = tmp_path / "stat"
    if text is not None:
        stat.write_text(text)
    monkeypatch.setattr(machine, "_STAT", stat)
    with spending() as spent:
        pass
    assert spent.others_share is None
    assert not spent.undisturbed


def test_circumstances_name_machine_and_versions() -> None:
    about = circumstances()
    assert about["cores"] == usable_cores() <= (os.cpu_count() or 1)
    assert about["versions"]["viflow-anomaly"]
    assert {"date", "commit", "cpu", "load_1min", "python"} <= about.keys()
