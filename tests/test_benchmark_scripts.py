"""The programs of ``benchmarks/``, which no type checker and no other test reads."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"


@pytest.mark.parametrize("script", sorted(path.name for path in FOLDER.glob("*.py")))
def test_every_benchmark_starts(script: str) -> None:
    done = subprocess.run([sys.executable, FOLDER / script, "--help"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("usage: ")


@pytest.mark.parametrize(("script", "repeats"), [("latency.py", 50), ("pair_profile.py", 10)])
def test_what_clocks_parts_of_a_detection_runs_through(script: str, repeats: int, tmp_path: Path) -> None:
    """They call what ``detect`` calls, part by part; how long it takes is no matter here."""
    out = tmp_path / "report.json"
    options = ["--cameras", "pinhole", "--repeats", str(repeats), "--warm-up", "1", "--out", out]
    done = subprocess.run([sys.executable, FOLDER / script, *options], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    cases = [(case["width"], case["height"], case["camera"]) for case in json.loads(out.read_text())["results"]]
    assert cases == [(224, 224, "pinhole"), (752, 480, "pinhole")]
