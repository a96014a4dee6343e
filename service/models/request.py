"""What ``/models`` is told: wire shapes, and a client's file names made into paths inside one folder."""

from __future__ import annotations

from pathlib import Path, PurePosixPath
from typing import Final, TypeVar

from fastapi import Request
from pydantic import Field

from viflow_anomaly.config import NetworkPrecision, Precision, RuntimeName
from viflow_anomaly_service.detection_request import validated
from viflow_anomaly_service.json_body import parse_json
from viflow_anomaly_service.models.named import NamedModel
from viflow_anomaly_service.problems import Problem
from viflow_anomaly_service.request_body import RequestBody
from viflow_anomaly_service.schemas import WireModel
from viflow_anomaly_service.settings import ServiceSettings

MAX_BODY_BYTES: Final = 16 * 1024
_MAX_VALUES: Final = 64
_FILES: Final = ("checkpoint", "evidence_head", "calibration")
_FILE: Final = "inside the service's VIFLOW_MODEL_DIR, such as day/network.safetensors"

Shape = TypeVar("Shape", bound=WireModel)


class ModelLoad(WireModel):
    """Which files become a model; what is left out is the service's own."""

    checkpoint: str = Field(description=f"network, {_FILE}")
    sha256: str | None = Field(
        default=None, pattern="^[0-9a-f]{64}$", description="of that file; another one is refused"
    )
    evidence_head: str | None = Field(default=None, description=f"head, {_FILE}")
    calibration: str | None = Field(default=None, description="file of `viflow-anomaly calibrate` in the same folder")
    runtime: RuntimeName | None = None
    precision: Precision | None = None
    network_precision: NetworkPrecision | None = None

    def model_in(self, folder: Path) -> NamedModel:
        """As the settings would name it.

        Raises:
            Problem: 422 ``model_path_invalid``.
        """
        given = self.model_dump(exclude={"sha256"}, exclude_none=True)
        return NamedModel.model_validate(
            given | {name: inside(folder, given[name], field=name) for name in _FILES if name in given}
        )


class DefaultModel(WireModel):
    """Which model answers those that ask for none."""

    name: str


def inside(folder: Path, name: str, *, field: str) -> Path:
    """The file of that name below the folder; the way there may not leave it, by links neither.

    Raises:
        Problem: 422 ``model_path_invalid``.
    """
    steps = PurePosixPath(name)
    plain = name.isprintable() and "\\" not in name and 0 < len(name) <= 512
    if plain and not steps.is_absolute() and ".." not in steps.parts and steps.parts:
        root = folder.resolve()
        path = (root / steps).resolve()
        if path.is_relative_to(root) and path != root and (path.is_file() or not path.exists()):
            return path  # no pipe or device, whose reading would not end
    detail = f"{field}: expected the name of a file {_FILE}, found {name!r:.80}"
    raise Problem(422, code="model_path_invalid", detail=detail, field=field)


async def read_shape(request: Request, body: RequestBody, shape: type[Shape], settings: ServiceSettings) -> Shape:
    """A small JSON body.

    Raises:
        Problem: 400, 408, 413, 415, 422.
    """
    header = request.headers.get("content-type", "")
    if header.partition(";")[0].strip().lower() != "application/json":
        detail = f"expected Content-Type application/json, found {header or 'none'!r:.80}"
        raise Problem(415, code="media_type_unsupported", detail=detail, field="Content-Type")
    data = await body.read(max_bytes=MAX_BODY_BYTES, timeout_s=settings.body_timeout_s)
    return validated(shape, parse_json(data, max_values=_MAX_VALUES))
