"""``detect --url``: the same pair, asked from a service."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from difference_detector import DifferenceDetector
from pair_world import Ask, PairFolder

sys.path.append(str(Path(__file__).parents[1] / "service"))

from service_world import live_server

from viflow_anomaly_service.api_keys import new_key


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, Path]]:
    """The address of a service, and a file that holds a key of it."""
    folder = tmp_path_factory.mktemp("keys")
    key, line = new_key("drone", ["detect"])
    (folder / "keys.txt").write_text(line)
    (folder / "key.txt").write_text(key + "\n")
    with live_server(lambda settings: DifferenceDetector(), key_file=folder / "keys.txt") as server:
        yield f"http://127.0.0.1:{server.port}", folder / "key.txt"


def test_the_service_answers_what_is_computed_here(ask: Ask, pair: PairFolder, guarded: tuple[str, Path]) -> None:
    url, key_file = guarded
    more = ["--camera", str(pair.camera), "--json", "--masks"]
    here = json.loads(ask(pair.arguments(*more)).out)
    answer = ask(pair.arguments(*more, "--url", url, "--key-file", str(key_file)))
    assert (answer.code, answer.err) == (0, "")
    there = json.loads(answer.out)
    assert there["rois"]
    del here["timings_ms"], there["timings_ms"]
    assert there == here


def test_a_table_and_an_overlay_are_made(ask: Ask, pair: PairFolder, guarded: tuple[str, Path], tmp_path: Path) -> None:
    url, key_file = guarded
    overlay = tmp_path / "overlay.png"
    answer = ask(pair.arguments("--url", url, "--key-file", str(key_file), "--overlay", str(overlay)))
    assert answer.code == 0
    assert answer.out.startswith("ok, ")
    assert overlay.read_bytes().startswith(b"\x89PNG")


def test_what_the_service_says_is_one_line(ask: Ask, pair: PairFolder, guarded: tuple[str, Path]) -> None:
    url, _ = guarded
    assert ask(pair.arguments("--url", url)).is_refusal(f"{url}: 401: expected an API key")
    assert ask(pair.arguments("--url", "here")).is_refusal("expected the address of a service")
    wrong = ask(pair.arguments("--url", url, "--key-file", str(pair.folder / "none")))
    assert wrong.is_refusal("expected a file that holds an API key")


def test_options_that_would_have_no_effect_are_refused(ask: Ask, pair: PairFolder) -> None:
    for name, value in (("--checkpoint", "x"), ("--threads", "2"), ("--runtime", "torch"), ("--set", "threads=2")):
        answer = ask(pair.arguments("--url", "http://127.0.0.1:1", name, value))
        assert answer.is_refusal(f"expected none of the options that set up a detector here, found {name}")
    assert ask(pair.arguments("--key-file", "x")).is_refusal("expected --url beside it, found none")
