"""Unsupervised training: the reconstruction of the source image is the teacher; hypotheses compete for each example.

A step's data are a pure function of (seed, step), and the state on disk is exact, so that a killed and resumed run
gives the weights of an uninterrupted one (on a CPU, with the same number of threads).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import nn

from viflow_anomaly import __version__
from viflow_anomaly.batch import Batch, require_device
from viflow_anomaly.checkpoint import load_training_state, save_checkpoint, save_training_state
from viflow_anomaly.checkpoint_record import source_commit
from viflow_anomaly.config import ModelConfig, MotorConfig, TrainingConfig, loss_of_preset
from viflow_anomaly.errors import ConfigError
from viflow_anomaly.evaluation.endpoint_error import EndpointErrors, measure_endpoint_errors, require_ground_truth
from viflow_anomaly.losses import LossResult, photometric_loss, squared_error_loss
from viflow_anomaly.model.builder import build_model
from viflow_anomaly.model.calibrated import CalibratedViflow
from viflow_anomaly.model.outputs import ViflowOutput
from viflow_anomaly.rigid_losses import corrected_loss
from viflow_anomaly.runtime.torch_runtime import TorchRuntime
from viflow_anomaly.training_data import TrainingData, load_training_data
from viflow_anomaly.training_init import read_initial_weights
from viflow_anomaly.training_progress import TrainingProgress
from viflow_anomaly.training_state import learning_rate, require_same_run, resume_state, state_tensors


class TrainingRun:
    """Network, optimiser and step counter of one run, and their exact way to disk and back."""

    def __init__(
        self,
        *,
        model: ModelConfig,
        training: TrainingConfig,
        device: str,
        weights: Mapping[str, torch.Tensor] | None = None,
    ) -> None:
        self.model_config = model
        self.config = training
        self.loss = _loss_name(model, training)
        self.device = device
        network = build_model(model, seed=training.seed)
        if weights is not None:
            network.load_state_dict(weights)
        network = network.to(device)
        self.network: nn.Module = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.optimizer = torch.optim.AdamW(
            self.network.parameters(), lr=training.learning_rate, weight_decay=training.weight_decay
        )
        self.step = 0

    def train_step(self, data: TrainingData) -> tuple[float, torch.Tensor]:
        """One optimiser step; the loss and the wins of each hypothesis [K].

        Raises:
            ConfigError: ``training_diverged``.
        """
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate(self.config, self.step)
        batch = data.sample(
            seed=self.config.seed, step=self.step, batch_size=self.config.batch_size, device=self.device
        )
        source = self._relit(batch.source).contiguous(memory_format=torch.channels_last)
        with torch.autocast(torch.device(self.device).type, dtype=torch.bfloat16, enabled=self.config.autocast):
            output = self.network(source, batch.motion, batch.interval_s, batch.motor)
        output = output._replace(flow_px=output.flow_px.float())
        if not bool(torch.isfinite(output.flow_px).all()):
            raise self._diverged()
        loss, winners = self._loss(output, batch)
        if not math.isfinite(float(loss.detach())):
            raise self._diverged()
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self.network.parameters(), self.config.gradient_clip)
        self.optimizer.step()
        self.step += 1
        return float(loss.detach()), torch.bincount(winners, minlength=self.model_config.hypotheses)

    def _diverged(self) -> ConfigError:
        return ConfigError(
            f"step {self.step}: expected finite flow and a finite loss, found others: the training has diverged; "
            "a smaller training.learning_rate, and motor values of usual size, help",
            code="training_diverged",
            field="training.learning_rate",
        )

    def _relit(self, source: torch.Tensor) -> torch.Tensor:
        """What the network is shown: another exposure, contrast and noise than the loss sees, by the step's number."""
        strength = self.config.relighting
        if not strength:
            return source
        generator = torch.Generator().manual_seed(self.config.seed * 1_000_003 + self.step)
        shape = (len(source), 1, 1, 1)
        gain, offset, noise = (torch.rand(shape, generator=generator) for _ in range(3))
        grain = torch.randn(source.shape, generator=generator) * (0.04 * strength * noise)
        gain, offset = 1 + strength * (gain - 0.5), strength * 0.4 * (offset - 0.5)
        relit = (source - 0.5) * gain.to(source.device) + 0.5 + (offset + grain).to(source.device)
        return relit.clamp(0, 1)

    def _loss(self, output: ViflowOutput, batch: Batch) -> LossResult:
        relaxation = self.config.relaxation
        if self.loss == "corrected":
            assert isinstance(self.network, CalibratedViflow)
            rays = self.network.rays(batch.source)
            return corrected_loss(output, batch, rays, focal_px=self.network.focal_px, relaxation=relaxation)
        if self.loss == "squared":
            return squared_error_loss(output, batch.source, batch.target)
        return photometric_loss(output, batch.source, batch.target, relaxation=relaxation)

    def save(self, folder: Path, fingerprint: Mapping[str, Any]) -> None:
        """Write the whole state atomically."""
        tensors = state_tensors(self.network, self.optimizer)
        fitted = {"motor": self.model_config.motor.model_dump(mode="json")}
        save_training_state(folder, tensors, {"step": self.step, **fitted, **fingerprint})

    def restore(self, folder: Path, fingerprint: Mapping[str, Any]) -> bool:
        """Take up the state in ``folder``; False where there is none. Errors as ``resume_state``."""
        step = resume_state(self.network, self.optimizer, folder, fingerprint)
        if step is None:
            return False
        self.step = step
        return True


def train(
    data: Sequence[Path],
    out_dir: Path,
    *,
    model: ModelConfig,
    training: TrainingConfig,
    init: Path | None = None,
    validation: Sequence[Path] = (),
    device: str = "cpu",
    resume: bool = False,
    progress: bool = True,
) -> Path:
    """Train on recordings of any known layout.

    Args:
        data: recordings to learn from, in any order: they are taken by name.
        out_dir: gets ``state.safetensors`` (exact, for resuming), ``model.safetensors`` + ``model.json``,
            ``metrics.jsonl`` and TensorBoard's ``events.*``.
        init: the tensor file of a checkpoint to start from. The model is the checkpoint's, its fitted motor stream
            too; what is set in ``model`` must agree with it.
        validation: recordings with ground truth to measure on, never to learn from.
        resume: go on from ``out_dir``; a fresh directory starts anew.

    Returns:
        The path of the finished ``model.safetensors``.

    Raises:
        ConfigError: ``training_exists``, ``resume_config_differs``, ``device_unavailable``, ``config_invalid`` (a loss
            that does not fit the model), ``init_model_differs``.
        DatasetError: as ``load_training_data`` and, before anything is learnt, ``require_ground_truth``.
        CheckpointError: ``checkpoint_corrupt`` for the state to go on from; as ``load_checkpoint`` for ``init``.
    """
    require_device(device)
    initial = None if init is None else read_initial_weights(init, model)
    model = model if initial is None else initial.model
    loss = _loss_name(model, training)
    require_ground_truth(validation, model)
    torch.set_num_threads(training.threads)
    data = sorted(data, key=lambda path: (path.name, path))  # what a step draws depends on their order
    fingerprint = {
        "init": None if initial is None else initial.origin["sha256"],
        "model": model.model_dump(mode="json"),
        "training": training.model_dump(mode="json"),
        "recordings": [path.name for path in data],
        "validation": sorted(path.name for path in validation),
    }
    first_step, model = _going_on(out_dir, fingerprint, model, resume=resume)
    with TrainingProgress(out_dir, steps=training.steps, first_step=first_step, visible=progress) as reporter:
        training_data = load_training_data(
            data,
            model,
            training.look_aheads,
            measure=loss == "corrected",
            seed=training.seed,
            split=training.split,
            on_progress=reporter.loading,
        )
        weights = None if initial is None else initial.weights
        run = TrainingRun(model=training_data.model, training=training, device=device, weights=weights)
        if resume:
            run.restore(out_dir, fingerprint)
        if initial is not None and validation and run.step == 0:
            reporter.validated(0, _validate(run, validation).summary())
        errors = _run_steps(run, training_data, validation, out_dir, fingerprint, reporter)
    provenance = {
        "package_version": __version__,
        "commit": source_commit(),
        "torch_version": torch.__version__,
        "device": device,
        **({} if initial is None else {"init": initial.origin}),
        "training": fingerprint["training"],
        "data": {
            "recordings": len(data),
            "names": fingerprint["recordings"],
            "pairs": training_data.pair_count,
            "excluded": training_data.excluded,
        },
        "metrics": _provenance_metrics(errors),
    }
    name = f"viflow-{model.preset}"
    path = out_dir / "model.safetensors"
    return save_checkpoint(path, run.network, run.model_config, name=name, version=__version__, provenance=provenance)


def _going_on(
    out_dir: Path, fingerprint: Mapping[str, Any], model: ModelConfig, *, resume: bool
) -> tuple[int, ModelConfig]:
    """At which step a run goes on, and its model with the motor stream as it was fitted when the run began.

    Found out before minutes of loading, as is a state that it cannot go on from.
    """
    loaded = load_training_state(out_dir)
    if loaded is None:
        return 0, model
    if not resume:
        raise ConfigError(
            f"{out_dir}: expected a directory without a training run, found one; --resume goes on with it",
            code="training_exists",
            field="out",
        )
    record = loaded[1]
    require_same_run(out_dir, record, fingerprint)
    step = record.get("step")
    if "motor" in record:
        motor = MotorConfig.from_mapping(record["motor"], where=str(out_dir / "state.safetensors"))
        model = model.model_copy(update={"motor": motor})
    return step if isinstance(step, int) else 0, model


def _run_steps(
    run: TrainingRun,
    data: TrainingData,
    validation: Sequence[Path],
    out_dir: Path,
    fingerprint: Mapping[str, Any],
    reporter: TrainingProgress,
) -> EndpointErrors | None:
    """All steps that are left; the endpoint errors after the last one, None without validation recordings."""
    config = run.config
    errors: EndpointErrors | None = None
    run.network.train()
    while run.step < config.steps:
        loss, wins = run.train_step(data)
        reporter.stepped(run.step, loss, wins.tolist())
        last = run.step == config.steps
        if validation and (last or run.step % config.validate_every == 0):
            errors = _validate(run, validation)
            reporter.validated(run.step, errors.summary())
        if last or run.step % config.checkpoint_every == 0:
            run.save(out_dir, fingerprint)
    if errors is None and validation:
        errors = _validate(run, validation)
    return errors


def _loss_name(model: ModelConfig, training: TrainingConfig) -> str:
    """The loss that fits the preset; "auto" names it, another one is refused."""
    fitting = loss_of_preset(model.preset)
    if training.loss not in ("auto", fitting):
        raise ConfigError(
            f"training.loss: expected 'auto' or {fitting!r} for the preset {model.preset!r}, found {training.loss!r}",
            code="config_invalid",
            field="training.loss",
        )
    return fitting


def _provenance_metrics(errors: EndpointErrors | None) -> dict[str, Any]:
    if errors is None:
        return {}
    return {**errors.summary(), "groups": {name: group.summary() for name, group in errors.per_group().items()}}


def _validate(run: TrainingRun, validation: Sequence[Path]) -> EndpointErrors:
    run.network.eval()
    runtime = TorchRuntime(run.network, device=run.device)
    errors = measure_endpoint_errors(runtime, run.model_config, validation, max_pairs=run.config.validation_pairs)
    run.network.train()
    return errors
