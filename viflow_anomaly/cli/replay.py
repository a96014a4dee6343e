"""``viflow-anomaly replay``: a recording, sent to a running service as a camera would send it."""

from __future__ import annotations

import re
import signal
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated

import typer

from viflow_anomaly.cli.options import EXIT_SOME_FAILED, CameraName, KeyFile, RecordingFolder
from viflow_anomaly.cli.progress import stderr_progress

if TYPE_CHECKING:
    from viflow_anomaly.client import StreamAnswer
    from viflow_anomaly.detection import Reason

LOCAL_SERVICE = "http://127.0.0.1:8000"
MAX_STREAM_NAME = 64


def replay(
    directory: RecordingFolder,
    url: Annotated[str, typer.Option(metavar="URL", help="Of the service.")] = LOCAL_SERVICE,
    stream: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Under which the service knows it; default: the recording's name."),
    ] = None,
    key_file: KeyFile = None,
    speed: Annotated[float, typer.Option(help="Times as fast as it was recorded; 0: as fast as answers come.")] = 1.0,
    layout: Annotated[
        str | None, typer.Option("--format", metavar="NAME", help="As of `batch`; default by content.")
    ] = None,
    camera: CameraName = None,
    keep: Annotated[bool, typer.Option("--keep", help="Leave the stream in the service at the end.")] = False,
) -> int:
    """Send a recording to a service, frame by frame, as its camera and IMU would have sent it.

    Prints a detection a line (ROI JSON) as they come. The service's dashboard shows the stream, and its events begin
    and end. Exit code 3 when something of the recording was left out; stderr says what. Needs the extra `client`.

    [bold]Examples[/bold]

      viflow-anomaly replay samples/drone

      viflow-anomaly replay V1_01_easy --url http://10.0.0.7:8000 --key-file key.txt --stream drone7 --speed 0.5
    """
    from viflow_anomaly.client import Client, read_api_key
    from viflow_anomaly.client import replay as send_all
    from viflow_anomaly.datasets.registry import open_recording
    from viflow_anomaly.detection import to_json

    recording = open_recording(directory, format=layout, camera=camera)
    name, counted = _required_name(stream) or stream_name(recording.name), _Counted()
    key = None if key_file is None else read_api_key(key_file)
    try:
        with _ended_in_order(), stderr_progress() as progress, Client(url, api_key=key) as client:
            task = progress.add_task(name, total=len(recording))
            with client.stream(name, camera=recording.camera, keep=keep) as sending:
                for answer in send_all(recording, sending, speed=speed):
                    for detection in answer:
                        print(to_json(detection), flush=True)
                    for fault in counted.add(answer):
                        print(f"{fault.code}: {fault.message}", file=sys.stderr)
                    progress.advance(task)
    finally:
        if counted.calls:
            print(f"{url}, stream {name}: {counted}", file=sys.stderr)
    return 0 if counted.whole else EXIT_SOME_FAILED


@contextmanager
def _ended_in_order() -> Iterator[None]:
    """Inside, SIGTERM ends the program as Ctrl-C does: the service is told to forget the stream."""

    def end(number: int, frame: object) -> None:
        raise SystemExit(128 + number)

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


class _Counted:
    """What a replay came to."""

    def __init__(self) -> None:
        self.calls = 0
        self._judged = self._moving = self._abstained = self._waiting = self._begun = self._lost = 0
        self._left_out: Counter[str] = Counter()

    def add(self, answer: StreamAnswer) -> list[Reason]:
        """The faults of kinds that were not there before."""
        new = [fault for fault in answer.faults if fault.code not in self._left_out]
        self.calls += 1
        self._judged += len(answer)
        self._moving += sum(any(roi.label == "independent_motion" for roi in one.rois) for one in answer)
        self._abstained += sum(one.status == "abstained" for one in answer)
        self._left_out.update(fault.code for fault in answer.faults)
        self._waiting = answer.waiting_frames
        self._begun += answer.begun
        self._lost += answer.answer_lost
        return list({fault.code: fault for fault in reversed(new)}.values())

    @property
    def whole(self) -> bool:
        """Nothing of the recording was left out."""
        return not (self._left_out or self._waiting or self._lost or self._begun > 1)

    def __str__(self) -> str:
        parts = [f"{self._judged} pairs, in {self._moving} something moves by itself"]
        if self._abstained:
            parts.append(f"{self._abstained} could not be judged")
        if self._left_out:
            codes = (f"{count} x {code}" for code, count in sorted(self._left_out.items()))
            parts.append(f"left out: {', '.join(codes)}")
        if self._waiting:
            parts.append(f"{self._waiting} frames wait for IMU samples that did not come")
        if self._begun > 1:
            parts.append(f"the service forgot the stream and began it anew {self._begun - 1} times")
        if self._lost:
            parts.append(f"{self._lost} answers were lost on their way")
        return "; ".join(parts)


def stream_name(recording: str) -> str:
    """The recording's name with what a stream's name may not hold replaced."""
    name = re.sub(r"[^A-Za-z0-9._-]+", "-", recording)[:MAX_STREAM_NAME]
    return "recording" if name in ("", ".", "..") else name


def _required_name(stream: str | None) -> str | None:
    if stream is not None and stream != stream_name(stream):
        raise typer.BadParameter(f"expected 1 to 64 of A-Z a-z 0-9 . _ -, found {stream!r}", param_hint="--stream")
    return stream


def register(app: typer.Typer) -> None:
    app.command(no_args_is_help=True)(replay)
