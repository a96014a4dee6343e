"""What holds for the project as a whole: its text, its numbers of version, its commands."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tomllib
import zipfile
from importlib.metadata import requires, version
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from viflow_anomaly.checkpoint import load_checkpoint
from viflow_anomaly.checkpoint_record import BUNDLED_NAME
from viflow_anomaly.cli.main import run
from viflow_anomaly.datasets.registry import open_recording
from viflow_anomaly.runtime.loading import load_runtime

ROOT = Path(__file__).resolve().parents[1]
# Written in pieces, or this file would find itself.
MACHINE_PATH = re.compile("(?<![\\w.])/" + "(work/|root/|Users/\\w|home/\\w)")
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def tracked_files() -> list[Path]:
    listed = subprocess.run(["git", "-C", ROOT, "ls-files", "-z"], capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("not a git checkout: which files belong to the project is unknown")
    return [path for name in listed.stdout.split("\0") if name and (path := ROOT / name).is_file()]


def text_of(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        return ""


def test_no_file_names_a_path_of_some_machine() -> None:
    found = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()}"
        for path in tracked_files()
        for number, line in enumerate(text_of(path).splitlines(), start=1)
        if MACHINE_PATH.search(line)
    ]
    assert found == []


def test_no_file_is_huge() -> None:
    limit = 8 * 1024 * 1024
    assert [path for path in tracked_files() if path.stat().st_size > limit] == []


def test_version_is_stated_once_and_agrees() -> None:
    assert version("viflow-anomaly") == PYPROJECT["project"]["version"]
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert "## [Unreleased]" in changelog or f"## [{PYPROJECT['project']['version']}]" in changelog


def pins() -> dict[str, str]:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    exact = [line.split("==") for line in lines if line and not line.startswith("#")]
    return {canonicalize_name(name): pinned for name, pinned in exact}


def test_every_requirement_is_pinned_within_its_range() -> None:
    wanted = [Requirement(line) for line in requires("viflow-anomaly") or []]
    for requirement in wanted:
        if requirement.name == "viflow-anomaly":
            continue
        pinned = pins()[canonicalize_name(requirement.name)]
        assert requirement.specifier.contains(pinned), requirement


# Installed in another package's place, never beside it; it needs what that one needs.
STANDS_IN = {"opencv-contrib-python-headless": "opencv-python-headless"}


def test_pins_hold_what_the_requirements_require() -> None:
    """No dependency of a dependency is left to the day of the installation."""
    waiting = {canonicalize_name(Requirement(line).name) for line in requires("viflow-anomaly") or []}
    seen: set[str] = {"viflow-anomaly"}
    while waiting - seen:
        name = (waiting - seen).pop()
        seen.add(name)
        assert name in pins(), name
        needed = [Requirement(line) for line in requires(STANDS_IN.get(name, name)) or []]
        waiting |= {canonicalize_name(need.name) for need in needed if not need.marker or need.marker.evaluate()}


def documented_commands() -> list[list[str]]:
    """Every ``viflow-anomaly`` line in the code blocks of the README and the docs, continued lines joined."""
    commands = []
    for page in [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]:
        for block in re.findall(r"```[a-z]*\n(.*?)```", page.read_text(encoding="utf-8"), flags=re.DOTALL):
            for line in block.replace("\\\n", " ").splitlines():
                for part in re.split(r"&&|\||;|#", line):
                    words = part.split()
                    if "viflow-anomaly" in words[:1] or ".venv/bin/viflow-anomaly" in words[:1]:
                        commands.append(words[1:])
    return commands


def test_documented_commands_and_options_exist(capsys: pytest.CaptureFixture[str]) -> None:
    helps: dict[tuple[str, ...], str] = {}
    for words in documented_commands():
        depth = 2 if words[:1] in (["evaluate"], ["groundtruth"], ["keys"]) else 1
        command = tuple(word for word in words[:depth] if not word.startswith("-"))
        if command not in helps:
            assert run([*command, "--help"]) == 0, words
            helps[command] = capsys.readouterr().out
        for option in (word.split("=")[0] for word in words if word.startswith("--")):
            assert re.search(rf"{re.escape(option)}\b", helps[command]), f"{option} in: {' '.join(words)}"


def test_documented_make_targets_exist() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"^([a-z]+):", makefile, flags=re.MULTILINE))
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]
    named = {name for page in pages for name in re.findall(r"(?:^|`|\s)make ([a-z]+)(?=`|$)", page.read_text(), re.M)}
    assert named <= targets
    assert {"demo", "test", "lint", "model", "wheel", "clean"} <= targets


def test_every_package_is_listed_for_the_wheel() -> None:
    tops = [ROOT / "viflow_anomaly", ROOT / "service"]
    packages = {".".join(init.parent.relative_to(ROOT).parts) for top in tops for init in top.rglob("__init__.py")}
    folders = {
        ".".join(path.relative_to(ROOT).parts)
        for top in tops
        for path in [top, *top.rglob("*")]
        if path.is_dir() and path.name != "__pycache__"
    }
    listed = set(PYPROJECT["tool"]["setuptools"]["packages"])
    assert packages == folders
    assert listed == {re.sub(r"^service\b", "viflow_anomaly_service", name) for name in packages}


def test_the_wheel_check_finds_what_is_missing(tmp_path: Path) -> None:
    wheel = tmp_path / "empty.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("x.dist-info/METADATA", "Name: other\n")
        archive.writestr("tests/test_x.py", "")
    done = subprocess.run(
        [sys.executable, ROOT / ".ci" / "check_wheel.py", wheel], capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    for words in ("missing viflow_anomaly/py.typed", "bundled weights", "unexpected tests/", "found other"):
        assert words in done.stderr


def test_the_demo_shows_the_best_detection(tmp_path: Path) -> None:
    def line(stamp: int, *scores: float) -> str:
        return json.dumps({"source_timestamp_ns": stamp, "rois": [{"score": score} for score in scores]})

    (tmp_path / "detections.jsonl").write_text("\n".join([line(1), line(2, 0.9, 0.1), line(3, 0.5)]))
    done = subprocess.run(
        [sys.executable, ROOT / ".ci" / "show_demo.py", tmp_path], capture_output=True, text=True, check=True
    )
    assert '"source_timestamp_ns": 2' in done.stdout
    assert f"{tmp_path}/overlays/2.png" in done.stdout


def test_the_bundled_sample_is_whole_in_the_repository() -> None:
    recording = open_recording(ROOT / "samples" / "drone")
    images = {recording.frame_path(index).resolve() for index in range(len(recording))}
    assert len(images) == 10
    assert images <= {path.resolve() for path in tracked_files()}


def test_the_recipe_replaces_the_model_that_is_loaded() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert f"viflow_anomaly/weights/{BUNDLED_NAME}.$$kind" in makefile
    weights = ROOT / "viflow_anomaly" / "weights"
    kinds = {path.suffix for path in weights.iterdir() if path.stem == BUNDLED_NAME}
    assert kinds == {".safetensors", ".json", ".onnx", ".md"}
    assert load_checkpoint().record.sha256 in (weights / f"{BUNDLED_NAME}.md").read_text(encoding="utf-8")
    assert load_runtime(None).record.name == BUNDLED_NAME
