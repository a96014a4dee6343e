"""A pair looked at closely in a worker's thread: what it would be judged under other options, and what decided."""

from __future__ import annotations

import json
from typing import Any

from pydantic import ValidationError

from viflow_anomaly.config import DetectorConfig
from viflow_anomaly.config_changes import ChangedValue, as_environment, as_toml, changed_values
from viflow_anomaly.detection import to_json
from viflow_anomaly.errors import ViflowError
from viflow_anomaly.inspection import flow_arrows, pair_signs, view_hypotheses
from viflow_anomaly.sensor_data import FramePair
from viflow_anomaly.settings import ENVIRONMENT_PREFIX
from viflow_anomaly_service.detection_request import validated
from viflow_anomaly_service.detector_pool import Job
from viflow_anomaly_service.json_body import parse_json
from viflow_anomaly_service.live.pair_memory import JudgedPair, RememberedPair
from viflow_anomaly_service.live.pictures import analyzing
from viflow_anomaly_service.models.table import LoadedModel
from viflow_anomaly_service.pair_work import PairWork
from viflow_anomaly_service.problems import Problem, problem_of_error, problem_of_validation
from viflow_anomaly_service.schemas import OptionsPart, WireModel
from viflow_anomaly_service.settings import ServiceSettings


class InspectRequest(WireModel):
    """What a remembered pair is to be judged under; ``view``: with hypotheses and flow arrows."""

    options: OptionsPart | None = None
    view: bool = True


class InspectionWork:
    """A remembered pair under other options.

    Args:
        remembered: the pair.
        body: of the request.
        settings: limits.
    """

    def __init__(self, remembered: RememberedPair, body: bytes, settings: ServiceSettings) -> None:
        self._judged = remembered.judged
        self._body = body
        self._settings = settings

    def __call__(self, job: Job[bytes]) -> bytes:
        """The answer's JSON.

        Raises:
            Problem: 422 for options that do not exist or are out of range; 501 ``maps_unavailable``.
        """
        request = validated(InspectRequest, parse_json(self._body or b"{}", max_values=self._settings.max_json_values))
        detector = self._judged.detector
        config = wanted_config(request.options, detector.config)
        job.require_wanted()
        try:
            members, _ = inspect_pair(self._judged.model, self._judged.pair, config, view=request.view)
        except ViflowError as err:
            raise problem_of_error(err) from err
        return json_object({**members, **described_changes(detector.config, config)})


class UploadWork(PairWork):
    """A pair that was sent to be looked at: decoded, judged, and handed back to be remembered."""

    def __call__(self, job: Job[tuple[dict[str, str], JudgedPair]]) -> tuple[dict[str, str], JudgedPair]:
        """The answer's members and what is to be remembered.

        Raises:
            Problem: whatever is wrong with the request.
            AbandonedError: the client has gone.
        """
        sent = self._decoded(job)
        with self._judging(sent):
            members, judged = inspect_pair(sent.model, sent.pair, sent.config, view=True)
        self._tell(judged.detection, sent)
        return {**members, **described_changes(sent.model.detector.config, sent.config)}, judged


def wanted_config(options: OptionsPart | None, config: DetectorConfig) -> DetectorConfig:
    """The configuration with the options over it.

    Raises:
        Problem: 422 naming the setting; ``model_not_selectable``: the model that judged a pair judges it again.
    """
    if options is not None and options.model is not None:
        detail = "options.model: expected none for a pair that was judged already, found one"
        raise Problem(422, code="model_not_selectable", detail=detail, field="options.model")
    try:
        return config if options is None else options.applied_to(config)
    except ValidationError as err:
        raise problem_of_validation(err, "options.regions") from err


def inspect_pair(
    model: LoadedModel, pair: FramePair, config: DetectorConfig, *, view: bool
) -> tuple[dict[str, str], JudgedPair]:
    """Members of the answer, each as JSON, and the judged pair.

    Raises:
        InvalidInputError: as ``detect``.
        Problem: 501 ``maps_unavailable``.
    """
    wanted = model.detector.with_config(config)
    analysis = analyzing(wanted).analyze(pair)
    detection, signs = analysis.detection, pair_signs(pair, analysis.predicted)
    body = to_json(detection)
    members = {"detection": body, "signs": _json(signs._asdict())}
    if view:
        members["hypotheses"] = _json(view_hypotheses(analysis.predicted, analysis.model_input)._asdict())
        members["flow_arrows"] = _json(flow_arrows(analysis.flow_px, analysis.inside))
    return members, JudgedPair(pair, model, wanted, detection, body, signs)


def described_changes(before: DetectorConfig, after: DetectorConfig) -> dict[str, str]:
    """What differs, and how to say so in a configuration file or the environment."""
    changes = [one for one in changed_values(before, after, section="detector") if not _is_output_only(one)]
    configuration = {"toml": as_toml(changes), "environment": as_environment(changes, prefix=ENVIRONMENT_PREFIX)}
    return {"changed": _json([change._asdict() for change in changes]), "configuration": _json(configuration)}


def json_object(members: dict[str, str]) -> bytes:
    """An object whose members are JSON already."""
    return ("{" + ",".join(f'"{name}":{value}' for name, value in members.items()) + "}").encode()


def _is_output_only(change: ChangedValue) -> bool:
    return change.name == "detector.include_masks"


def _json(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"), allow_nan=False)
