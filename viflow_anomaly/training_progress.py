"""What a person sees of a training: a progress bar, metrics.jsonl, and TensorBoard where it is installed."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from viflow_anomaly.checkpoint_record import write_atomically

LOG_EVERY = 50


def _summary_writer(folder: Path) -> Any | None:
    """TensorBoard's writer, or None: it is an optional extra and a training must not die for want of a picture."""
    try:
        from torch.utils.tensorboard import SummaryWriter  # noqa: PLC0415  # the import is slow and optional
    except ImportError:
        return None
    return SummaryWriter(str(folder))


def _forget_later_steps(path: Path, step: int) -> None:
    """Drop what a killed run logged after its last saved state (a resumed run logs it again), and a torn line."""
    if not path.exists():
        return
    kept = []
    for line in path.read_text(encoding="utf-8").splitlines(keepends=True):
        try:
            if json.loads(line)["step"] <= step and line.endswith("\n"):
                kept.append(line)
        except (ValueError, TypeError, KeyError):
            continue
    write_atomically(path, "".join(kept).encode())


class TrainingProgress:
    """Reports one run; a context manager.

    Args:
        out_dir: where ``metrics.jsonl`` and TensorBoard's events go.
        steps, first_step: of the run.
        visible: draw a progress bar on stderr.
    """

    def __init__(self, out_dir: Path, *, steps: int, first_step: int, visible: bool) -> None:
        self._out_dir = out_dir
        self._steps = steps
        self._first_step = first_step
        self._loss_sum = 0.0
        self._count = 0
        self._wins: list[int] = []
        self._text = ""
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.completed:.0f}/{task.total:.0f}"),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[text]}"),
            console=Console(stderr=True),
            disable=not visible,
        )
        self._loading: TaskID | None = None
        self._training: TaskID | None = None

    def __enter__(self) -> Self:
        self._out_dir.mkdir(parents=True, exist_ok=True)
        path = self._out_dir / "metrics.jsonl"
        _forget_later_steps(path, self._first_step)
        self._metrics = path.open("a", encoding="utf-8")
        self._writer = _summary_writer(self._out_dir)
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()
        self._metrics.close()
        if self._writer is not None:
            self._writer.close()

    def loading(self, done: int, total: int) -> None:
        """A recording was read."""
        if self._loading is None:
            self._loading = self._bar.add_task("reading", total=total, text="")
        self._bar.update(self._loading, completed=done)

    def stepped(self, step: int, loss: float, wins: Sequence[int]) -> None:
        """A step was taken; every 50th is logged with the mean loss and the share of wins of each hypothesis."""
        self._loss_sum += loss
        self._count += 1
        self._wins = [a + b for a, b in zip(self._wins or [0] * len(wins), wins, strict=True)]
        if self._training is None:
            self._training = self._bar.add_task("training", total=self._steps, completed=self._first_step, text="")
        if step % LOG_EVERY == 0 or step == self._steps:
            total = max(1, sum(self._wins))
            shares = [round(wins_of_one / total, 4) for wins_of_one in self._wins]
            mean_loss = self._loss_sum / self._count
            self._log(step, {"loss": round(mean_loss, 6)}, {"wins": shares})
            self._text = f"loss {mean_loss:.4f}  wins {' '.join(f'{share:.0%}' for share in shares)}"
            self._loss_sum, self._count, self._wins = 0.0, 0, []
        self._bar.update(self._training, completed=step, text=self._text)

    def validated(self, step: int, metrics: Mapping[str, float]) -> None:
        """Endpoint errors were measured."""
        self._log(step, metrics, {})
        if self._training is not None and "epe_px" in metrics:
            self._bar.update(
                self._training,
                description=f"training (EPE {metrics['epe_px']:.2f} px of {metrics['identity_epe_px']:.2f})",
            )

    def _log(self, step: int, scalars: Mapping[str, float], lists: Mapping[str, Sequence[float]]) -> None:
        self._metrics.write(json.dumps({"step": step, **scalars, **lists}) + "\n")
        self._metrics.flush()
        if self._writer is None:
            return
        for name, value in scalars.items():
            self._writer.add_scalar(name, value, step)
        for name, values in lists.items():
            for index, value in enumerate(values):
                self._writer.add_scalar(f"{name}/{index}", value, step)
