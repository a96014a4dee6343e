"""What a model is called, and what the settings can say of one beside the default."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Annotated, Final

from pydantic import AfterValidator

from viflow_anomaly.config import FrozenConfig, NetworkPrecision, Precision, RuntimeName, UsablePath

if TYPE_CHECKING:
    from viflow_anomaly_service.settings import ServiceSettings

DEFAULT_NAME: Final = "default"
"""The model of the plain settings; another one may take its place as the default."""
MODEL_NAME: Final = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}", re.ASCII)
NAME_RULE: Final = "1 to 64 of A-Z a-z 0-9 . _ -, the first no . or -"


def _is_name(text: str) -> str:
    if MODEL_NAME.fullmatch(text) is None or text == DEFAULT_NAME:
        raise ValueError(f"expected {NAME_RULE}, and not {DEFAULT_NAME!r}, found {text!r:.80}")
    return text


ModelName = Annotated[str, AfterValidator(_is_name)]


class NamedModel(FrozenConfig):
    """``[service.models.NAME]``: what differs from the plain settings; None: it does not.

    A calibration holds for one combination of all the others, so that the plain one is not taken over.
    """

    checkpoint: UsablePath | None = None
    evidence_head: UsablePath | None = None
    calibration: UsablePath | None = None
    runtime: RuntimeName | None = None
    precision: Precision | None = None
    network_precision: NetworkPrecision | None = None

    def applied_to(self, settings: ServiceSettings) -> ServiceSettings:
        """The settings that load this model."""
        given = {name: value for name, value in self if value is not None}
        return settings.model_copy(update={**given, "calibration": self.calibration})
