from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import jsonschema
import numpy as np
import pytest
from difference_detector import DifferenceDetector
from worlds import World, in_memory, make_world, with_stamps, write_png

from viflow_anomaly import batch_files, batch_job, batch_record
from viflow_anomaly.batch_files import Journal
from viflow_anomaly.batch_job import BatchOptions, run_batch
from viflow_anomaly.batch_pictures import spread_indices
from viflow_anomaly.batch_record import check_same_run
from viflow_anomaly.config import DetectorConfig, RegionConfig, RigEstimateConfig, TrackingConfig
from viflow_anomaly.datasets.recording import FileRecording
from viflow_anomaly.detection import ModelInfo, load_detection_schema
from viflow_anomaly.errors import DatasetError, InvalidInputError, ViflowError
from viflow_anomaly.pair_detector import Backend, Execution
from viflow_anomaly.sensor_data import FramePair

FRAMES = 6
STUMP = b'{"schema_version":"1.0","source_timestamp_ns":1,"target_timestamp_ns":2,"status":"ok"}\n'


class StoppedError(Exception):
    """Stands for a kill: whatever ends a run at once."""


@pytest.fixture
def world() -> World:
    return make_world(frames=FRAMES, square_px=24)


@pytest.fixture
def recording(world: World, tmp_path: Path) -> FileRecording:
    return in_memory(world, tmp_path / "frames")


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "out"


def detections(out: Path) -> list[dict[str, Any]]:
    """The lines of ``detections.jsonl`` without what may differ between two runs."""
    found = [json.loads(line) for line in (out / "detections.jsonl").read_text().splitlines()]
    for detection in found:
        del detection["timings_ms"]
    return found


def run_json(out: Path) -> dict[str, Any]:
    values: dict[str, Any] = json.loads((out / "run.json").read_text())
    return values


def stop_at(stamp_ns: int) -> Callable[[FramePair], None]:
    def check(pair: FramePair) -> None:
        if pair.source.timestamp_ns == stamp_ns:
            raise StoppedError

    return check


def stop_run(recording: FileRecording, options: BatchOptions, *, at: int) -> None:
    """Run until pair ``at`` and die there."""
    detector = DifferenceDetector(on_pair=stop_at(int(recording.frame_timestamps_ns[at])))
    with pytest.raises(StoppedError):
        run_batch(recording, detector, options)


def test_every_pair_becomes_a_line_in_time_order(recording: FileRecording, out: Path) -> None:
    summary = run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=out))
    lines = detections(out)
    stamps = recording.frame_timestamps_ns.tolist()
    assert [(line["source_timestamp_ns"], line["target_timestamp_ns"]) for line in lines] == [*pairwise(stamps)]
    assert any(line["rois"] for line in lines)
    assert (summary.pairs, summary.ok, summary.abstained, summary.failed, summary.reused) == (FRAMES - 1, 5, 0, 0, 0)
    assert sorted(path.name for path in out.iterdir()) == ["detections.jsonl", "run.json"]


def test_lines_satisfy_the_shipped_schema(recording: FileRecording, out: Path) -> None:
    detector = DifferenceDetector(config=DetectorConfig(include_masks=True))
    run_batch(recording, detector, BatchOptions(out_dir=out))
    for line in (out / "detections.jsonl").read_text().splitlines():
        jsonschema.validate(json.loads(line), load_detection_schema())


def test_run_json_records_what_decided_the_results(recording: FileRecording, out: Path) -> None:
    options = BatchOptions(out_dir=out, look_ahead=2, limit=3)
    run_batch(recording, DifferenceDetector(), options, settings={"threads": 1})
    run = run_json(out)
    assert run["state"] == "done"
    assert run["counts"] == {"pairs": 3, "ok": 3, "abstained": 0, "failed": 0}
    tracking = TrackingConfig().model_dump(mode="json")
    assert run["options"] == {
        "look_ahead": 2,
        "limit": 3,
        "overlays": 0,
        "video": False,
        "tracking": tracking,
        "rig_estimate": RigEstimateConfig().model_dump(mode="json"),
    }
    assert run["rig_estimate"] is None
    assert run["configuration"] == {"threads": 1, "detector": DetectorConfig().model_dump(mode="json")}
    assert run["model"] == {"name": "difference", "version": "1", "sha256": "ab" * 32}
    assert run["recording"]["frames"] == FRAMES
    assert run["recording"]["camera"]["fx"] == 80.0
    assert set(run["versions"]) == {
        "viflow-anomaly",
        "torch",
        "openvino",
        "onnxruntime",
        "numpy",
        "opencv-python-headless",
        "scikit-image",
    }
    assert run["execution"] == {
        "network": {"runtime": "rule", "device": "cpu", "precision": "f32"},
        "evidence": None,
    }
    assert run["wall_time_s"] >= 0


def test_a_package_that_is_not_installed_has_no_version(
    recording: FileRecording, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(batch_record, "_VERSIONED_PACKAGES", ("not-a-package-of-anyone",))
    run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=out))
    assert run_json(out)["versions"] == {"not-a-package-of-anyone": None}


def test_look_ahead_pairs_frames_further_apart(recording: FileRecording, out: Path) -> None:
    run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=out, look_ahead=4))
    stamps = recording.frame_timestamps_ns.tolist()
    assert [line["target_timestamp_ns"] for line in detections(out)] == stamps[4:]


def test_progress_counts_pairs_and_failures(recording: FileRecording, out: Path) -> None:
    recording.frame_paths[2].write_bytes(b"")
    told: list[tuple[int, int, int]] = []
    run_batch(
        recording, DifferenceDetector(), BatchOptions(out_dir=out), on_progress=lambda *counts: told.append(counts)
    )
    assert told == [(1, 5, 0), (2, 5, 1), (3, 5, 2), (4, 5, 2), (5, 5, 2)]


def test_pairs_with_broken_images_are_listed_and_the_others_go_on(recording: FileRecording, out: Path) -> None:
    recording.frame_paths[1].write_bytes(recording.frame_paths[1].read_bytes()[:-20])
    summary = run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=out))
    stamps = recording.frame_timestamps_ns.tolist()
    assert (summary.pairs, summary.ok, summary.failed) == (5, 3, 2)
    assert [line["source_timestamp_ns"] for line in detections(out)] == stamps[2:5]
    failures = run_json(out)["failures"]
    assert [failure["source_timestamp_ns"] for failure in failures] == stamps[:2]
    assert {failure["code"] for failure in failures} == {"image_truncated_or_corrupt"}
    assert str(recording.frame_paths[1]) in failures[0]["message"]


def test_pairs_with_disordered_imu_are_listed(world: World, tmp_path: Path, out: Path) -> None:
    stamps = world.imu.timestamps_ns.tolist()
    # Half a second of samples stands before the first frame, a quarter of a second belongs to a pair.
    swapped = [*stamps[:52], stamps[53], stamps[52], *stamps[54:]]
    recording = in_memory(replace(world, imu=with_stamps(world.imu, swapped)), tmp_path / "disorder")
    summary = run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=out))
    assert [(failure.source_timestamp_ns, failure.code) for failure in summary.failures] == [
        (int(recording.frame_timestamps_ns[0]), "imu_unsorted")
    ]
    assert summary.ok == 4


def test_abstained_pairs_are_counted(world: World, tmp_path: Path, out: Path) -> None:
    world.images[0][:] = 0
    summary = run_batch(in_memory(world, tmp_path / "dark"), DifferenceDetector(), BatchOptions(out_dir=out))
    assert (summary.ok, summary.abstained) == (4, 1)
    assert detections(out)[0]["status"] == "abstained"


@pytest.mark.parametrize(("frames", "look_ahead"), [(1, 1), (3, 3), (4, 4)])
def test_a_recording_without_a_pair_is_refused(tmp_path: Path, out: Path, frames: int, look_ahead: int) -> None:
    recording = in_memory(make_world(frames=frames), tmp_path / "short")
    with pytest.raises(DatasetError, match=f"at least {look_ahead + 1} frames, found {frames}") as caught:
        run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=out, look_ahead=look_ahead))
    assert caught.value.code == "recording_too_short"
    assert not out.exists()


# --- the output directory


def test_results_are_not_overwritten_unasked(recording: FileRecording, out: Path) -> None:
    run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=out))
    with pytest.raises(InvalidInputError, match="expected a new or empty directory") as caught:
        run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=out))
    assert caught.value.code == "output_not_empty"


def test_an_empty_directory_is_welcome(recording: FileRecording, out: Path) -> None:
    out.mkdir()
    assert run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=out)).ok == 5


def test_overwrite_replaces_results_and_leaves_other_files(recording: FileRecording, out: Path) -> None:
    run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=out, overlays="all", video=True))
    (out / "notes.txt").write_text("mine")
    (out / "overlays" / "best.png").write_text("mine")
    run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=out, overwrite=True, limit=2))
    assert len(detections(out)) == 2
    left = sorted(str(path.relative_to(out)) for path in out.rglob("*") if path.is_file())
    assert left == ["detections.jsonl", "notes.txt", "overlays/best.png", "run.json"]


def test_overwrite_forgets_an_unfinished_run(recording: FileRecording, out: Path) -> None:
    stop_run(recording, BatchOptions(out_dir=out, overlays="all"), at=3)
    detector = DifferenceDetector()
    assert run_batch(recording, detector, BatchOptions(out_dir=out, overwrite=True)).reused == 0
    assert len(detector.seen) == 5
    assert sorted(path.name for path in out.iterdir()) == ["detections.jsonl", "run.json"]


def test_resume_and_overwrite_contradict(recording: FileRecording, out: Path) -> None:
    with pytest.raises(InvalidInputError, match="found both") as caught:
        run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=out, resume=True, overwrite=True))
    assert caught.value.code == "options_contradict"


def test_two_runs_cannot_share_a_directory(recording: FileRecording, out: Path) -> None:
    stop_run(recording, BatchOptions(out_dir=out), at=2)
    with (
        Journal(out / "detections.jsonl.partial"),
        pytest.raises(InvalidInputError, match="another one at work") as caught,
    ):
        run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=out, resume=True))
    assert caught.value.code == "output_in_use"


# --- resume


def test_unfinished_results_have_another_name(recording: FileRecording, out: Path) -> None:
    stop_run(recording, BatchOptions(out_dir=out), at=3)
    assert not (out / "detections.jsonl").exists()
    assert len((out / "detections.jsonl.partial").read_text().splitlines()) == 3
    assert run_json(out)["state"] == "running"


@pytest.mark.parametrize("at", [0, 1, 4])
def test_a_resumed_run_equals_an_uninterrupted_one(
    recording: FileRecording, tmp_path: Path, out: Path, at: int
) -> None:
    run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=tmp_path / "whole", overlays=3, video=True))
    stop_run(recording, BatchOptions(out_dir=out, overlays=3, video=True), at=at)
    detector = DifferenceDetector()
    summary = run_batch(recording, detector, BatchOptions(out_dir=out, overlays=3, video=True, resume=True))
    assert summary.reused == at
    assert len(detector.seen) == 5 - at
    assert detections(out) == detections(tmp_path / "whole")
    for whole in (tmp_path / "whole").rglob("*.png"):
        assert (out / "overlays" / whole.name).read_bytes() == whole.read_bytes()
    assert (out / "overlay.mp4").read_bytes() == (tmp_path / "whole" / "overlay.mp4").read_bytes()
    names = [sorted(path.name for path in folder.iterdir()) for folder in (out, tmp_path / "whole")]
    assert names[0] == names[1] == ["detections.jsonl", "overlay.mp4", "overlays", "run.json"]


@pytest.mark.parametrize(
    "tail", [b'{"source_timestamp_ns":12', b'{"broken":1}\n', b"\0\0\0\n", b"[]\n", b"not json\n", STUMP]
)
def test_a_damaged_end_of_the_journal_is_dropped(
    recording: FileRecording, tmp_path: Path, out: Path, tail: bytes
) -> None:
    run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=tmp_path / "whole"))
    stop_run(recording, BatchOptions(out_dir=out), at=3)
    with (out / "detections.jsonl.partial").open("ab") as journal:
        journal.write(tail)
    assert run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=out, resume=True)).reused == 3
    assert detections(out) == detections(tmp_path / "whole")


def test_resume_in_a_new_directory_starts_there(recording: FileRecording, out: Path) -> None:
    assert run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=out, resume=True)).ok == 5


def test_resume_of_a_finished_run_detects_nothing(recording: FileRecording, out: Path) -> None:
    options = BatchOptions(out_dir=out, overlays=2, video=True)
    run_batch(recording, DifferenceDetector(), options)
    before = (out / "detections.jsonl").read_bytes()
    detector = DifferenceDetector()
    summary = run_batch(recording, detector, options.model_copy(update={"resume": True}))
    assert (summary.reused, detector.seen) == (5, [])
    assert (out / "detections.jsonl").read_bytes() == before


def test_resume_goes_on_behind_an_earlier_limit(recording: FileRecording, out: Path) -> None:
    run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=out, limit=2, video=True))
    detector = DifferenceDetector()
    run_batch(recording, detector, BatchOptions(out_dir=out, resume=True))
    assert (len(detector.seen), len(detections(out))) == (3, 5)


def test_resume_retries_what_failed(recording: FileRecording, world: World, out: Path) -> None:
    recording.frame_paths[0].write_bytes(b"")
    assert run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=out)).failed == 1
    write_png(recording.frame_paths[0], world.images[0])
    summary = run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=out, resume=True))
    assert (summary.ok, summary.failed, summary.reused) == (5, 0, 4)
    assert [line["source_timestamp_ns"] for line in detections(out)] == recording.frame_timestamps_ns[:-1].tolist()


def test_resume_adds_pictures_to_finished_detections(recording: FileRecording, out: Path) -> None:
    run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=out))
    before = (out / "detections.jsonl").read_bytes()
    run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=out, resume=True, overlays=2))
    assert len(list((out / "overlays").iterdir())) == 2
    assert (out / "detections.jsonl").read_bytes() == before


@pytest.mark.parametrize(
    ("detector", "options", "field"),
    [
        (DifferenceDetector(model_info=ModelInfo("other", "1", "cd" * 32)), {}, "model.sha256"),
        (
            DifferenceDetector(config=DetectorConfig(regions=RegionConfig(max_regions=3))),
            {},
            "configuration.detector.regions.max_regions",
        ),
        (
            DifferenceDetector(execution=Execution(Backend("rule", "cpu", "bf16"), None)),
            {},
            "execution.network.precision",
        ),
        (DifferenceDetector(), {"look_ahead": 2}, "options.look_ahead"),
        (DifferenceDetector(), {"tracking": None}, "options.tracking"),
        (DifferenceDetector(), {"tracking": TrackingConfig(max_gap_s=2.0)}, "options.tracking.max_gap_s"),
    ],
)
def test_resume_with_other_settings_is_refused(
    recording: FileRecording, out: Path, detector: DifferenceDetector, options: dict[str, Any], field: str
) -> None:
    run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=out))
    with pytest.raises(InvalidInputError, match=f"expected {field} as in the earlier run") as caught:
        run_batch(recording, detector, BatchOptions(out_dir=out, resume=True, **options))
    assert (caught.value.code, caught.value.field) == ("resume_config_differs", field)


def test_resume_with_another_recording_is_refused(recording: FileRecording, tmp_path: Path, out: Path) -> None:
    run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=out))
    other = in_memory(make_world(start_ns=5 * 10**9), tmp_path / "other")
    with pytest.raises(InvalidInputError, match="5 pairs that are not in it") as caught:
        run_batch(other, DifferenceDetector(), BatchOptions(out_dir=out, resume=True))
    assert caught.value.code == "resume_recording_differs"


def test_resume_of_something_else_is_refused(recording: FileRecording, out: Path) -> None:
    out.mkdir()
    (out / "photo.jpg").write_text("mine")
    with pytest.raises(InvalidInputError, match=r"no run\.json to resume from") as caught:
        run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=out, resume=True))
    assert caught.value.code == "output_not_empty"


@pytest.mark.parametrize("text", ["{", "[]"])
def test_resume_with_an_unreadable_record_is_refused(recording: FileRecording, out: Path, text: str) -> None:
    out.mkdir()
    (out / "run.json").write_text(text)
    with pytest.raises(InvalidInputError, match="expected the record of an earlier run") as caught:
        run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=out, resume=True))
    assert caught.value.code == "resume_run_unreadable"


def test_resume_with_a_record_that_lacks_everything_is_refused(recording: FileRecording, out: Path) -> None:
    out.mkdir()
    (out / "run.json").write_text('{"model": 1}')
    with pytest.raises(InvalidInputError, match=r"model\.sha256"):
        run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=out, resume=True))


# --- tracks


@pytest.fixture
def square(tmp_path: Path) -> FileRecording:
    """Nothing but a square moves: one region a pair."""
    return in_memory(make_world(frames=FRAMES, shift_px=0, square_px=24), tmp_path / "square")


def test_a_mover_keeps_its_number(square: FileRecording, out: Path) -> None:
    tracking = TrackingConfig(confirm_score=1.0)
    run_batch(square, DifferenceDetector(), BatchOptions(out_dir=out, tracking=tracking))
    numbers = [[roi["track_id"] for roi in line["rois"]] for line in detections(out)]
    assert numbers == [[None], [1], [1], [1], [1]]


def test_without_tracking_nothing_is_numbered(recording: FileRecording, tmp_path: Path, out: Path) -> None:
    run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=tmp_path / "tracked"))
    run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=out, tracking=None, overlays=1))
    plain, tracked = detections(out), detections(tmp_path / "tracked")
    assert plain != tracked
    for line in tracked:
        for roi in line["rois"]:
            roi["track_id"] = None
            roi["evidence"] = {name: value for name, value in roi["evidence"].items() if "own_velocity" not in name}
    assert plain == tracked


@pytest.mark.parametrize("persistence", [False, True])
@pytest.mark.parametrize("at", [1, 3])
def test_tracks_of_a_resumed_run_equal_an_uninterrupted_ones(
    recording: FileRecording, tmp_path: Path, out: Path, at: int, persistence: bool
) -> None:
    tracking = TrackingConfig(require_persistence=persistence, confirm_score=1.0)
    options = BatchOptions(out_dir=tmp_path / "whole", overlays="all", tracking=tracking)
    run_batch(recording, DifferenceDetector(), options)
    stop_run(recording, options.model_copy(update={"out_dir": out}), at=at)
    again = options.model_copy(update={"out_dir": out, "resume": True})
    run_batch(recording, DifferenceDetector(), again)
    assert detections(out) == detections(tmp_path / "whole")
    assert any(roi["track_id"] for line in detections(out) for roi in line["rois"])
    for whole in (tmp_path / "whole" / "overlays").iterdir():
        assert (out / "overlays" / whole.name).read_bytes() == whole.read_bytes()
    before = (out / "detections.jsonl").read_bytes()
    run_batch(recording, DifferenceDetector(), again)  # a run that ended is tracked anew from its own lines
    assert (out / "detections.jsonl").read_bytes() == before


def test_tracks_of_pairs_that_failed_at_first_are_those_of_a_whole_run(
    square: FileRecording, tmp_path: Path, out: Path
) -> None:
    run_batch(square, DifferenceDetector(), BatchOptions(out_dir=tmp_path / "whole"))
    image = square.frame_paths[1].read_bytes()
    square.frame_paths[1].write_bytes(b"")
    assert run_batch(square, DifferenceDetector(), BatchOptions(out_dir=out)).failed == 2
    square.frame_paths[1].write_bytes(image)
    run_batch(square, DifferenceDetector(), BatchOptions(out_dir=out, resume=True))
    assert detections(out) == detections(tmp_path / "whole")


def test_pairs_that_overlap_are_tracked(square: FileRecording, out: Path) -> None:
    run_batch(square, DifferenceDetector(), BatchOptions(out_dir=out, look_ahead=2))
    assert [line["rois"][0]["track_id"] for line in detections(out)] == [1] * 4


def test_required_persistence_takes_the_first_sighting_back(square: FileRecording, out: Path) -> None:
    tracking = TrackingConfig(require_persistence=True, confirm_score=1.0)
    run_batch(square, DifferenceDetector(), BatchOptions(out_dir=out, tracking=tracking))
    first, *later = [line["rois"][0] for line in detections(out)]
    assert (first["label"], first["track_id"]) == ("model_error", None)
    assert first["score"] == pytest.approx(first["evidence"]["two_frame_score"] - 0.5)
    assert [(roi["label"], roi["track_id"]) for roi in later] == [("independent_motion", 1)] * 4
    for line in (out / "detections.jsonl").read_text().splitlines():
        jsonschema.validate(json.loads(line), load_detection_schema())


# --- what goes wrong on the way


def test_a_full_disk_ends_the_run_and_keeps_what_is_done(
    recording: FileRecording, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(self: Journal, *line: object) -> None:
        raise OSError(28, "No space left on device")

    stop_run(recording, BatchOptions(out_dir=out), at=2)
    with monkeypatch.context() as patch:
        patch.setattr(Journal, "append", full)
        with pytest.raises(OSError, match="No space left"):
            run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=out, resume=True))
    assert run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=out, resume=True)).reused == 2


def test_errors_of_the_detector_belong_to_the_pair(recording: FileRecording, out: Path) -> None:
    def refuse(pair: FramePair) -> None:
        raise ViflowError("no gravity", code="imu_no_gravity", field="imu")

    summary = run_batch(recording, DifferenceDetector(on_pair=refuse), BatchOptions(out_dir=out))
    assert (summary.ok, summary.failed) == (0, 5)
    assert (out / "detections.jsonl").read_bytes() == b""
    assert summary.failures[0].field == "imu"


# --- pictures


def read_video(path: Path) -> Iterator[np.ndarray[Any, Any]]:
    video = cv2.VideoCapture(str(path))
    while True:
        found, frame = video.read()
        if not found:
            video.release()
            return
        yield frame


def test_overlays_are_named_by_their_source(recording: FileRecording, out: Path) -> None:
    run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=out, overlays="all"))
    names = [f"{stamp}.png" for stamp in recording.frame_timestamps_ns[:-1]]
    assert sorted(path.name for path in (out / "overlays").iterdir()) == names
    assert cv2.imread(str(out / "overlays" / names[0])).ndim == 3


def test_some_overlays_are_spread_over_the_run(recording: FileRecording, out: Path) -> None:
    run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=out, overlays=2))
    stamps = recording.frame_timestamps_ns
    assert sorted(path.stem for path in (out / "overlays").iterdir()) == [str(stamps[0]), str(stamps[4])]


def test_video_has_a_frame_for_every_pair_whatever_its_caption(world: World, tmp_path: Path, out: Path) -> None:
    world.images[3][:] = 0  # its reason adds a line below the picture
    recording = in_memory(world, tmp_path / "dark")
    recording.frame_paths[0].write_bytes(b"")
    run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=out, video=True))
    assert len(list(read_video(out / "overlay.mp4"))) == 4
    capture = cv2.VideoCapture(str(out / "overlay.mp4"))
    assert capture.get(cv2.CAP_PROP_FPS) == pytest.approx(20.0)
    capture.release()
    assert sorted(path.name for path in out.iterdir()) == ["detections.jsonl", "overlay.mp4", "run.json"]


def test_video_of_one_pair(tmp_path: Path, out: Path) -> None:
    recording = in_memory(make_world(frames=2), tmp_path / "two")
    run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=out, video=True))
    assert len(list(read_video(out / "overlay.mp4"))) == 1


def test_video_grows_when_a_resumed_run_adds_pairs(recording: FileRecording, out: Path) -> None:
    run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=out, limit=2, video=True))
    run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=out, resume=True, video=True))
    assert len(list(read_video(out / "overlay.mp4"))) == 5


@pytest.mark.parametrize(
    ("count", "wanted", "indices"),
    [(5, 0, set()), (5, 1, {0}), (5, 2, {0, 4}), (5, 3, {0, 2, 4}), (5, 5, {0, 1, 2, 3, 4}), (2, 9, {0, 1})],
)
def test_spread_indices(count: int, wanted: int, indices: set[int]) -> None:
    assert spread_indices(count, wanted) == indices


def test_journal_syncs_now_and_then(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[int] = []
    monkeypatch.setattr(batch_files.os, "fsync", synced.append)
    monkeypatch.setattr(batch_files, "_SYNC_EVERY_S", -1.0)
    with Journal(tmp_path / "journal") as journal:
        journal.append((1, 2), "ok", "{}")
        assert len(synced) == 1


def test_another_evidence_head_is_another_run(tmp_path: Path) -> None:
    earlier = {"model": {"sha256": "a", "version": "1+head.b"}}
    check_same_run(earlier, earlier, out_dir=tmp_path)
    with pytest.raises(InvalidInputError, match=r"model\.version") as caught:
        check_same_run(earlier, {"model": {"sha256": "a", "version": "1+head.c"}}, out_dir=tmp_path)
    assert caught.value.code == "resume_config_differs"


def test_the_place_stays_taken_until_the_run_says_done(
    recording: FileRecording, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refused: list[str] = []
    write = batch_job.write_json

    def seen(path: Path, values: dict[str, Any]) -> None:
        write(path, values)
        if values["state"] == "done":
            with pytest.raises(InvalidInputError) as caught:
                Journal(out / "detections.jsonl.partial")
            refused.append(caught.value.code)

    monkeypatch.setattr(batch_job, "write_json", seen)
    run_batch(recording, DifferenceDetector(), BatchOptions(out_dir=out))
    assert refused == ["output_in_use"]
    assert not (out / "detections.jsonl.partial").exists()
