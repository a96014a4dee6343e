from __future__ import annotations

import json
from pathlib import Path

import pytest
from pair_world import Ask


def test_the_quick_benchmark_prints_and_writes_the_same(ask: Ask, tmp_path: Path) -> None:
    arguments = ["benchmark", "--quick", "--sizes", "96x64", "--preset", "bundled", "--runtime", "torch"]
    answer = ask([*arguments, "--json", "--out", str(tmp_path / "results" / "here.json")])
    assert (answer.code, answer.err) == (0, "")
    report = json.loads(answer.out)
    assert report == json.loads((tmp_path / "results" / "here.json").read_text())
    assert [(row["method"], row["evidence"]) for row in report["rows"]] == [
        ("viflow-anomaly", "auto"),
        ("viflow-anomaly", "residual"),
        ("DIS ultrafast", "-"),
        ("DIS fast", "-"),
        ("DIS medium", "-"),
        ("Farneback", "-"),
        ("homography difference", "-"),
    ]
    assert {(row["width"], row["height"], row["threads"], row["peak_mib"]) for row in report["rows"]} == {
        (96, 64, 1, None)
    }
    assert all(0 < row["least_ms"] <= row["median_ms"] <= row["p95_ms"] for row in report["rows"])
    assert {"cpu", "commit", "date"} <= report.keys()
    text = (tmp_path / "results" / "here.md").read_text()
    assert text.startswith("# Benchmark\n")
    assert text.count("\n| ") == 8
    assert sorted(path.name for path in (tmp_path / "results").iterdir()) == ["here.json", "here.md"]


def test_memory_is_that_of_a_process_for_each_row(ask: Ask, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("viflow_anomaly.benchmarking.subjects.OTHERS", ("DIS medium", "homography difference"))
    monkeypatch.setattr(
        "viflow_anomaly.benchmarking.comparison.in_own_process", lambda function, subject, *about: 100.0 + about[0]
    )
    answer = ask(["benchmark", "--quick", "--memory", "--sizes", "96x64,64x64", "--preset", "compact", "--json"])
    assert [row["peak_mib"] for row in json.loads(answer.out)["rows"]] == [196.0] * 3 + [164.0] * 3


def test_an_image_that_the_papers_crop_does_not_fit_in_is_not_measured(ask: Ask) -> None:
    answer = ask(["benchmark", "--quick", "--sizes", "96x64", "--preset", "paper"])
    assert answer.code == 0
    assert "not measured: paper: " in answer.out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--sizes", "224"], "expected sizes as 224x224,752x480"),
        (["--sizes", "224x224,"], "expected sizes as 224x224,752x480"),
        (["--sizes", "8x224"], "sides of 64 to 4096 pixels, found '8x224'"),
        (["--sizes", "224x9999"], "sides of 64 to 4096 pixels"),
        (["--threads", "0"], "expected numbers from 1 to 256"),
        (["--threads", "1,two"], "found '1,two'"),
        (["--threads", "257"], "expected numbers from 1 to 256"),
        (["--runtime", "tensorrt"], "expected one of torch"),
        (["--preset", "huge"], "expected one of bundled, compact, paper, found 'huge'"),
    ],
)
def test_bad_usage(ask: Ask, arguments: list[str], words: str) -> None:
    assert ask(["benchmark", *arguments]).is_refusal(words)
