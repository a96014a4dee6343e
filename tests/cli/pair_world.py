"""The files of one image pair, ready for ``viflow-anomaly detect``, and one way to run a command in this process."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from worlds import make_world, write_plain

from viflow_anomaly.cli.main import run
from viflow_anomaly.datasets.camera_json import camera_to_mapping


@dataclass(frozen=True)
class Answer:
    """What a command left: exit code and the two streams."""

    code: int
    out: str
    err: str

    def is_refusal(self, words: str) -> bool:
        """Exit code 2, nothing on stdout, one line on stderr that holds ``words`` and no traceback."""
        lines = self.err.splitlines()
        return (
            self.code == 2 and not self.out and len(lines) == 1 and lines[0].startswith("error: ") and words in lines[0]
        )


Ask = Callable[[list[str]], Answer]


@dataclass(frozen=True)
class PairFolder:
    """A plain recording of ``frames`` frames with ``imu.json`` and ``camera.json`` of its first pair."""

    folder: Path

    @property
    def source(self) -> Path:
        return self.folder / "images" / "0000.png"

    @property
    def target(self) -> Path:
        return self.folder / "images" / "0001.png"

    @property
    def imu(self) -> Path:
        return self.folder / "imu.json"

    @property
    def camera(self) -> Path:
        return self.folder / "camera.json"

    def arguments(self, *more: str) -> list[str]:
        return ["detect", str(self.source), str(self.target), "--imu", str(self.imu), *more]

    def change_imu(self, **changes: Any) -> None:
        """Replace fields of ``imu.json``; None removes one."""
        self._change(self.imu, changes)

    def change_camera(self, **changes: Any) -> None:
        self._change(self.camera, changes)

    @staticmethod
    def _change(path: Path, changes: dict[str, Any]) -> None:
        values = json.loads(path.read_text()) | changes
        path.write_text(json.dumps({name: value for name, value in values.items() if value is not None}))


def write_pair_folder(folder: Path, *, frames: int = 4) -> PairFolder:
    world = make_world(frames=frames, square_px=24)
    write_plain(folder, world)
    (folder / "camera.json").write_text(json.dumps(camera_to_mapping(world.camera)))
    source_ns, target_ns = (int(stamp) for stamp in world.frame_timestamps_ns[:2])
    imu = world.imu.between(source_ns - 250_000_000, target_ns + 250_000_000)
    assert imu.accel_m_s2 is not None
    document = {
        "timestamps_ns": imu.timestamps_ns.tolist(),
        "gyro_rad_s": imu.gyro_rad_s.tolist(),
        "accel_m_s2": imu.accel_m_s2.tolist(),
        "source_timestamp_ns": source_ns,
        "target_timestamp_ns": target_ns,
    }
    (folder / "imu.json").write_text(json.dumps(document))
    return PairFolder(folder)


def answer_to(arguments: list[str], streams: pytest.CaptureFixture[str]) -> Answer:
    """Run one command line in this process."""
    streams.readouterr()
    code = run(arguments)
    left = streams.readouterr()
    return Answer(code, left.out, left.err)
