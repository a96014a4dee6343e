"""The examples of docs/client.md, run as they stand there."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from client_world import guarded_service

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "client.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, dict[str, str]]]:
    with guarded_service(tmp_path_factory.mktemp("keys")) as running:
        yield running


def example(language: str, words: str) -> str:
    blocks = re.findall(rf"```{language}\n(.*?)```", PAGE, flags=re.DOTALL)
    (found,) = (block for block in blocks if words in block)
    return found


@pytest.mark.skipif(shutil.which("curl") is None, reason="no curl")
def test_curl(service: tuple[str, dict[str, str]]) -> None:
    url, keys = service
    command = example("bash", "curl -sS").replace("http://127.0.0.1:8000", url)
    environment = os.environ | {"DETECT_KEY": keys["drone"], "NO_PROXY": "127.0.0.1"}
    done = subprocess.run(
        ["bash", "-c", command], cwd=ROOT, env=environment, capture_output=True, text=True, check=True
    )
    assert json.loads(done.stdout)["status"] == "ok", done.stdout


JAVASCRIPT = """
const fs = require("node:fs");
const [url, key] = process.argv.slice(2);
const file = (name) => fs.readFileSync(`samples/drone/${name}`);
const sent = [new Blob([file("source.png")]), new Blob([file("target.png")]), JSON.parse(file("imu.json"))];
detect(url, key, ...sent).then(
  (detection) => console.log(JSON.stringify(detection)),
  (error) => console.log(JSON.stringify({ error: error.message })),
);
"""


@pytest.mark.skipif(shutil.which("node") is None, reason="no node")
def test_javascript(service: tuple[str, dict[str, str]], tmp_path: Path) -> None:
    url, keys = service
    script = tmp_path / "ask.cjs"
    script.write_text(example("js", "async function detect") + JAVASCRIPT)
    answers = [
        json.loads(
            subprocess.run(["node", script, url, key], cwd=ROOT, capture_output=True, text=True, check=True).stdout
        )
        for key in (keys["drone"], keys["reader"])
    ]
    assert answers[0]["status"] == "ok"
    assert answers[1]["error"].startswith("403 scope_missing: expected a key of scope detect")
