"""A model with a motor stream behind the service: ``motor_command`` is wanted, and looked at."""

from __future__ import annotations

from pathlib import Path

from service_world import assert_problem, json_request, live_server

from viflow_anomaly.checkpoint import save_checkpoint
from viflow_anomaly.config import ModelConfig, MotorConfig
from viflow_anomaly.detector import AnomalyDetector
from viflow_anomaly.model.builder import build_model


def test_the_service_takes_a_command(tmp_path: Path) -> None:
    motor = MotorConfig(mean=(10.0,), deviation=(2.0,))
    model = ModelConfig(preset="compact", hypotheses=4, motion_inputs="imu+motor", motor=motor)
    path = save_checkpoint(tmp_path / "m.safetensors", build_model(model, seed=1), model, name="speed", version="1")
    with live_server(lambda settings: AnomalyDetector.from_checkpoint(path)) as server:
        answer = server.post_json(json_request(motor_command=[12.5]))
        assert answer.status_code == 200, answer.text
        for command, code in [(None, "motor_command_missing"), ([1.0, 2.0], "motor_command_length")]:
            assert_problem(server.post_json(json_request(motor_command=command)), 422, code, "motor_command")
