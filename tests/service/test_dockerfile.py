"""The Dockerfile's promises, read from its text: no container engine is needed (or used) here."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def stages() -> list[list[tuple[str, str]]]:
    """[(instruction, arguments)] of each build stage, continued lines joined."""
    text = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    joined = re.sub(r"\\\n\s*", " ", text)
    found: list[list[tuple[str, str]]] = []
    for line in joined.splitlines():
        if not line.strip() or line.startswith("#"):
            continue
        name, _, arguments = line.partition(" ")
        if name == "FROM":
            found.append([])
        found[-1].append((name, arguments.strip()))
    return found


def arguments_of(stage: list[tuple[str, str]], name: str) -> list[str]:
    return [arguments for instruction, arguments in stage if instruction == name]


def test_every_base_is_a_pinned_slim_python(stages: list[list[tuple[str, str]]]) -> None:
    for stage in stages:
        base = arguments_of(stage, "FROM")[0].split()[0]
        assert re.fullmatch(r"python:3\.11(\.\d+)?-slim-[a-z]+", base), base


def test_the_last_stage_installs_nothing(stages: list[list[tuple[str, str]]]) -> None:
    assert len(stages) == 2
    assert arguments_of(stages[-1], "RUN") == []
    assert arguments_of(stages[-1], "COPY") == ["--from=builder /opt/venv /opt/venv"]


def test_no_cache_and_no_cuda(stages: list[list[tuple[str, str]]]) -> None:
    builder = stages[0]
    assert any("PIP_NO_CACHE_DIR=1" in line for line in arguments_of(builder, "ENV"))
    installs = [line for line in arguments_of(builder, "RUN") if "pip install" in line]
    assert all("--constraint constraints.txt" in line for line in installs)
    assert "https://download.pytorch.org/whl/cpu torch" in installs[0]
    assert not re.search(r"apt-get|build-essential|gcc", " ".join(installs))


def test_it_runs_as_a_numeric_user_that_is_not_root(stages: list[list[tuple[str, str]]]) -> None:
    users = arguments_of(stages[-1], "USER")
    assert len(users) == 1
    assert re.fullmatch(r"[1-9]\d*:[1-9]\d*", users[0])


def test_it_listens_and_is_checked(stages: list[list[tuple[str, str]]]) -> None:
    last = stages[-1]
    assert arguments_of(last, "EXPOSE") == ["8000"]
    assert arguments_of(last, "ENTRYPOINT") == ['["viflow-anomaly"]']
    assert arguments_of(last, "CMD") == ['["serve", "--host", "0.0.0.0"]']
    environment = " ".join(arguments_of(last, "ENV"))
    assert "OMP_WAIT_POLICY=PASSIVE" in environment
    assert "VIFLOW_PORT=8000" in environment
    assert "/healthz" in arguments_of(last, "HEALTHCHECK")[0]


def test_everything_copied_is_sent_to_the_builder(stages: list[list[tuple[str, str]]]) -> None:
    sent = {
        line.removeprefix("!")
        for line in (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines()
        if line.startswith("!")
    }
    copied = {source for line in arguments_of(stages[0], "COPY") for source in line.split()[:-1]}
    assert copied == sent
    assert all((ROOT / name).exists() for name in copied), "the builder would fail on a missing file"
