"""The examples of docs/client.md, run as they stand there."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import httpx
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
    command = example("bash", "-F source=@").replace("http://127.0.0.1:8000", url)
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


@pytest.mark.skipif(shutil.which("curl") is None, reason="no curl")
def test_curl_and_a_stream(service: tuple[str, dict[str, str]]) -> None:
    url, keys = service
    block = example("bash", "/streams/cam0/frames").replace("http://127.0.0.1:8000", url)
    command = block[: block.index("curl -N")]
    environment = os.environ | {"DETECT_KEY": keys["drone"], "NO_PROXY": "127.0.0.1"}
    done = subprocess.run(
        ["bash", "-c", command], cwd=ROOT, env=environment, capture_output=True, text=True, check=True
    )
    assert json.loads(done.stdout)["begun"] is True, done.stdout


JAVASCRIPT_STREAM = """
const fs = require("node:fs");
const [url, key] = process.argv.slice(2);
const imu = (first) => {
  const stamps = Array.from({ length: 61 }, (_, i) => first + 5000000n * BigInt(i));
  const [gyro, accel] = [[0, 0, 0.1], [0, 0, 9.8]].map((row) => stamps.map(() => row));
  return { timestamps_ns: stamps, gyro_rad_s: gyro, accel_m_s2: accel };
};
const start = 1700000000000000001n;
const image = (name) => new Blob([fs.readFileSync(`samples/drone/${name}`)]);
const said = [];
const send = openStream(url, key, {}, (message) => {
  said.push(message);
  if (message.opened) {
    send(1, image("source.png"), start + 250000000n, imu(start));
    send(2, image("target.png"), start + 350000000n, imu(start + 305000000n));
  }
  if (message.id === 2 || message.problem) {
    console.log(JSON.stringify(said));
    process.exit(0);
  }
}, (code, reason) => {
  console.log(JSON.stringify({ code, reason }));
  process.exit(0);
});
"""


@pytest.mark.skipif(shutil.which("node") is None, reason="no node")
def test_javascript_over_a_websocket(service: tuple[str, dict[str, str]], tmp_path: Path) -> None:
    url, keys = service
    httpx.delete(f"{url}/streams/cam0", headers={"X-API-Key": keys["drone"]}, trust_env=False)
    script = tmp_path / "stream.cjs"
    script.write_text(example("js", "function openStream") + JAVASCRIPT_STREAM)
    command = ["node", "--experimental-websocket", script, url.replace("http", "ws", 1)]
    if subprocess.run([*command[:2], "-e", "new WebSocket"], capture_output=True, text=True, check=False).stderr.count(
        "bad option"
    ):
        pytest.skip("no WebSocket in this node")
    done = subprocess.run([*command, keys["drone"]], cwd=ROOT, capture_output=True, text=True, check=True)
    opened, first, second = json.loads(done.stdout)
    assert opened == {"opened": {"stream_id": "cam0"}}
    assert (first["id"], first["answer"]["faults"]) == (1, [])
    (detection,) = second["answer"]["detections"]
    assert abs(detection["source_timestamp_ns"] - 1_700_000_000_250_000_001) <= 128  # as a number of JavaScript
    service_says = httpx.get(f"{url}/streams/cam0", headers={"X-API-Key": keys["drone"]}, trust_env=False).json()
    assert service_says["newest_frame_ns"] == 1_700_000_000_350_000_001
    done = subprocess.run([*command, keys["reader"]], cwd=ROOT, capture_output=True, text=True, check=True)
    assert "opened" not in done.stdout


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
