from __future__ import annotations

import json
import struct
import zlib
from pathlib import Path
from typing import Any

import cv2
import jsonschema
import numpy as np
import pytest
from pair_world import Ask, PairFolder
from worlds import encode, textured_image, write_png

from viflow_anomaly.detection import load_detection_schema

GIGAPIXEL_PNG = (
    b"\x89PNG\r\n\x1a\n"
    + (header := struct.pack(">I4sIIBBBBB", 13, b"IHDR", 60_000, 60_000, 8, 0, 0, 0, 0))
    + struct.pack(">I", zlib.crc32(header[4:]))
)


def test_json_is_the_roi_object_and_nothing_else(ask: Ask, pair: PairFolder) -> None:
    answer = ask(pair.arguments("--camera", str(pair.camera), "--json"))
    assert (answer.code, answer.err) == (0, "")
    assert answer.out.count("\n") == 1
    detection = json.loads(answer.out)
    jsonschema.validate(detection, load_detection_schema())
    assert detection["rois"]


def test_table_shows_the_regions(ask: Ask, pair: PairFolder) -> None:
    answer = ask(pair.arguments())
    assert (answer.code, answer.err) == (0, "")
    assert answer.out.startswith("ok, ")
    assert "independent_motion" in answer.out
    assert "difference" in answer.out


def test_table_gives_the_reasons_of_an_abstention(ask: Ask, pair: PairFolder) -> None:
    write_png(pair.source, np.zeros((64, 96), dtype=np.uint8))
    answer = ask(pair.arguments())
    assert answer.code == 0
    assert "abstained, 0 regions" in answer.out
    assert "image_dark: the source image is black" in answer.out


def test_imu_csv_with_stamps_gives_the_same_answer_as_imu_json(ask: Ask, pair: PairFolder) -> None:
    document = json.loads(pair.imu.read_text())
    stamps = ["--source-timestamp-ns", str(document["source_timestamp_ns"])]
    stamps += ["--target-timestamp-ns", str(document["target_timestamp_ns"])]
    from_csv = ask(
        ["detect", str(pair.source), str(pair.target), "--imu", str(pair.folder / "imu.csv"), "--json", *stamps]
    )
    from_json = ask(pair.arguments("--json"))
    answers = [json.loads(answer.out) for answer in (from_csv, from_json)]
    for answer in answers:
        del answer["timings_ms"]
    assert answers[0] == answers[1]


def test_stamps_of_the_command_line_win_over_the_document(ask: Ask, pair: PairFolder) -> None:
    source_ns = json.loads(pair.imu.read_text())["source_timestamp_ns"] - 1000
    answer = ask(pair.arguments("--json", "--source-timestamp-ns", str(source_ns)))
    assert json.loads(answer.out)["source_timestamp_ns"] == source_ns


def test_accelerometer_may_be_absent(ask: Ask, pair: PairFolder) -> None:
    pair.change_imu(accel_m_s2=None)
    assert ask(pair.arguments("--json")).code == 0


def test_masks_on_request(ask: Ask, pair: PairFolder) -> None:
    assert "mask_rle" not in ask(pair.arguments("--json")).out
    assert "mask_rle" in ask(pair.arguments("--json", "--masks")).out


def test_overlay_is_a_picture(ask: Ask, pair: PairFolder, tmp_path: Path) -> None:
    path = tmp_path / "out.png"
    assert ask(pair.arguments("--json", "--overlay", str(path))).code == 0
    assert cv2.imread(str(path)).ndim == 3
    assert [entry.name for entry in tmp_path.iterdir() if entry.is_file()] == ["out.png"]


def test_settings_reach_the_detector(
    ask: Ask, pair: PairFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = tmp_path / "settings.toml"
    config.write_text("[detector]\ninclude_masks = true\n")
    assert "mask_rle" in ask(pair.arguments("--json", "--config", str(config))).out
    monkeypatch.setenv("VIFLOW_DETECTOR__INCLUDE_MASKS", "false")
    assert "mask_rle" not in ask(pair.arguments("--json", "--config", str(config))).out
    assert "mask_rle" in ask(pair.arguments("--json", "--set", "detector.include_masks=true")).out


# --- bad input


@pytest.mark.parametrize("name", ["source", "target"])
@pytest.mark.parametrize(
    ("content", "code"),
    [
        (encode(".png", textured_image(96, 64))[:-30], "image_truncated_or_corrupt"),
        (encode(".jpg", textured_image(96, 64))[:-30], "image_truncated_or_corrupt"),
        (b"this is a text, not an image", "image_unsupported_type"),
        (b"", "image_empty"),
        (encode(".png", np.zeros((1, 1), dtype=np.uint8)), "image_too_small"),
        (GIGAPIXEL_PNG, "image_too_many_pixels"),
    ],
    ids=["truncated png", "truncated jpeg", "text", "zero bytes", "1x1", "gigapixels"],
)
def test_bad_images(ask: Ask, pair: PairFolder, name: str, content: bytes, code: str) -> None:
    getattr(pair, name).write_bytes(content)
    answer = ask(pair.arguments())
    assert answer.is_refusal(f"[{code}]")
    assert f"{getattr(pair, name)}: {name}: " in answer.err


def test_images_of_different_sizes(ask: Ask, pair: PairFolder) -> None:
    write_png(pair.target, textured_image(98, 64))
    assert ask(pair.arguments()).is_refusal("96x64, found 98x64 [image_sizes_differ]")


@pytest.mark.parametrize("name", ["source", "target", "imu"])
def test_missing_files(ask: Ask, pair: PairFolder, name: str) -> None:
    getattr(pair, name).unlink()
    assert ask(pair.arguments()).is_refusal("No such file or directory")


@pytest.mark.parametrize("name", ["source", "target", "imu"])
def test_directories_in_place_of_files(ask: Ask, pair: PairFolder, name: str) -> None:
    path = getattr(pair, name)
    path.unlink()
    path.mkdir()
    assert ask(pair.arguments()).is_refusal("Is a directory")


@pytest.mark.parametrize("later_ns", [0, -1])
def test_target_not_later_than_source(ask: Ask, pair: PairFolder, later_ns: int) -> None:
    source_ns = json.loads(pair.imu.read_text())["source_timestamp_ns"]
    pair.change_imu(target_timestamp_ns=source_ns + later_ns)
    assert ask(pair.arguments()).is_refusal("[target_not_later]")


def test_target_not_later_than_source_with_a_csv(ask: Ask, pair: PairFolder) -> None:
    source_ns = json.loads(pair.imu.read_text())["source_timestamp_ns"]
    stamps = ["--source-timestamp-ns", str(source_ns), "--target-timestamp-ns", str(source_ns - 1)]
    arguments = ["detect", str(pair.source), str(pair.target), "--imu", str(pair.folder / "imu.csv"), *stamps]
    assert ask(arguments).is_refusal("[target_not_later]")


@pytest.mark.parametrize("name", ["source_timestamp_ns", "target_timestamp_ns"])
def test_missing_stamps(ask: Ask, pair: PairFolder, name: str) -> None:
    pair.change_imu(**{name: None})
    assert ask(pair.arguments()).is_refusal(f"expected it in --{name.replace('_', '-')} or in an imu.json")


def with_document(pair: PairFolder) -> dict[str, Any]:
    document: dict[str, Any] = json.loads(pair.imu.read_text())
    return document


def test_imu_unsorted(ask: Ask, pair: PairFolder) -> None:
    stamps = with_document(pair)["timestamps_ns"]
    pair.change_imu(timestamps_ns=[stamps[1], stamps[0], *stamps[2:]])
    assert ask(pair.arguments()).is_refusal("[imu_unsorted]")


def test_imu_empty(ask: Ask, pair: PairFolder) -> None:
    pair.change_imu(timestamps_ns=[], gyro_rad_s=[], accel_m_s2=[])
    assert ask(pair.arguments()).is_refusal("[imu_empty]")


@pytest.mark.parametrize("name", ["gyro_rad_s", "accel_m_s2"])
def test_imu_not_a_number(ask: Ask, pair: PairFolder, name: str) -> None:
    rows = with_document(pair)[name]
    rows[3][1] = float("nan")
    pair.change_imu(**{name: rows})
    assert ask(pair.arguments()).is_refusal(f"imu.{name}.3.1: Input should be a finite number")


@pytest.mark.parametrize("name", ["gyro_rad_s", "accel_m_s2"])
def test_imu_of_the_wrong_length(ask: Ask, pair: PairFolder, name: str) -> None:
    pair.change_imu(**{name: with_document(pair)[name][:-1]})
    assert ask(pair.arguments()).is_refusal("[imu_wrong_shape]")


@pytest.mark.parametrize("name", ["gyro_rad_s", "accel_m_s2"])
def test_imu_rows_of_two_numbers(ask: Ask, pair: PairFolder, name: str) -> None:
    rows = with_document(pair)[name]
    rows[0], rows[1] = rows[0][:2], rows[1][:2]
    pair.change_imu(**{name: rows})
    assert ask(pair.arguments()).is_refusal("(and 1 more) [imu_document_invalid]")


def test_imu_stamps_that_are_no_integers(ask: Ask, pair: PairFolder) -> None:
    stamps = with_document(pair)["timestamps_ns"]
    pair.change_imu(timestamps_ns=[*stamps[:-1], float(stamps[-1]) + 0.5])
    assert ask(pair.arguments()).is_refusal("[imu_document_invalid]")


def test_imu_stamps_beyond_64_bits(ask: Ask, pair: PairFolder) -> None:
    stamps = with_document(pair)["timestamps_ns"]
    pair.change_imu(timestamps_ns=[*stamps[:-1], 2**63])
    assert ask(pair.arguments()).is_refusal("imu.timestamps_ns")


def test_imu_csv_far_away_in_time(ask: Ask, pair: PairFolder) -> None:
    stamps = ["--source-timestamp-ns", "1000000000", "--target-timestamp-ns", "1050000000"]
    arguments = ["detect", str(pair.source), str(pair.target), "--imu", str(pair.folder / "imu.csv"), *stamps]
    assert ask(arguments).is_refusal("[imu_not_covering]")


def test_unknown_fields(ask: Ask, pair: PairFolder) -> None:
    pair.change_imu(gyro_deg_s=[])
    assert ask(pair.arguments()).is_refusal("imu.gyro_deg_s: there is no such field")


@pytest.mark.parametrize("content", [b"{", b"\xff\xfe\x00", b"[" * 100_000])
def test_imu_json_that_is_no_json(ask: Ask, pair: PairFolder, content: bytes) -> None:
    pair.imu.write_bytes(content)
    assert ask(pair.arguments()).is_refusal("Invalid JSON")


def test_imu_json_that_is_no_object(ask: Ask, pair: PairFolder) -> None:
    pair.imu.write_text("[1, 2]")
    assert ask(pair.arguments()).is_refusal("[imu_document_invalid]")


def test_imu_csv_with_other_columns(ask: Ask, pair: PairFolder) -> None:
    (pair.folder / "imu.csv").write_text("t,wx,wy,wz\n1,2,3,4\n")
    stamps = ["--source-timestamp-ns", "1", "--target-timestamp-ns", "2"]
    arguments = ["detect", str(pair.source), str(pair.target), "--imu", str(pair.folder / "imu.csv"), *stamps]
    assert ask(arguments).is_refusal("imu.csv, line 1: expected timestamp_ns,gyro_x")


def test_camera_of_another_size(ask: Ask, pair: PairFolder) -> None:
    pair.change_camera(width=95)
    assert ask(pair.arguments("--camera", str(pair.camera))).is_refusal("[camera_size_mismatch]")


@pytest.mark.parametrize(
    ("content", "words"),
    [("{}", "camera.fx: expected a number"), ("{", "[json_malformed]"), ('{"focal": 1}', "unknown field")],
)
def test_bad_camera_files(ask: Ask, pair: PairFolder, content: str, words: str) -> None:
    pair.camera.write_text(content)
    assert ask(pair.arguments("--camera", str(pair.camera))).is_refusal(words)


def test_missing_camera_file(ask: Ask, pair: PairFolder) -> None:
    assert ask(pair.arguments("--camera", "nowhere.json")).is_refusal("nowhere.json: expected a camera.json")


def test_the_folder_of_an_overlay_is_made_and_what_cannot_be_made_is_named(
    ask: Ask, pair: PairFolder, tmp_path: Path
) -> None:
    assert ask(pair.arguments("--overlay", str(tmp_path / "new" / "out.png"))).code == 0
    assert [one.name for one in (tmp_path / "new").iterdir()] == ["out.png"]
    answer = ask(pair.arguments("--overlay", str(tmp_path / "new" / "out.png" / "out.png")))
    assert answer.code == 2
    assert f"{tmp_path / 'new' / 'out.png'}: File exists" in answer.err


def test_wrong_settings(ask: Ask, pair: PairFolder) -> None:
    assert ask(pair.arguments("--set", "detector.regions.max_regions=none")).is_refusal("[config_invalid]")
    assert ask(pair.arguments("--config", "nowhere.toml")).is_refusal("[config_unreadable]")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--threads", "0"], "Invalid value for '--threads'"),
        (["--source-timestamp-ns", "1.5"], "Invalid value for '--source-timestamp-ns'"),
        (["--frobnicate"], "No such option"),
        (["third.png"], "unexpected extra argument"),
    ],
)
def test_bad_usage(ask: Ask, pair: PairFolder, arguments: list[str], words: str) -> None:
    answer = ask(pair.arguments(*arguments))
    assert answer.is_refusal(words)
    assert "try 'viflow-anomaly detect --help'" in answer.err


def test_bad_usage_without_imu(ask: Ask, pair: PairFolder) -> None:
    assert ask(["detect", str(pair.source), str(pair.target)]).is_refusal("--imu")
