"""Whether there is a store, before anything of it is imported: its packages are an extra."""

from __future__ import annotations

from typing import TYPE_CHECKING

from viflow_anomaly.errors import MissingDependencyError
from viflow_anomaly_service.metrics import ServiceMetrics
from viflow_anomaly_service.settings import ServiceSettings

if TYPE_CHECKING:
    from viflow_anomaly_service.store.keeper import ResultKeeper


def configured_keeper(settings: ServiceSettings, metrics: ServiceMetrics) -> ResultKeeper | None:
    """The keeper that the settings ask for, not yet started; None without ``store_url``.

    Raises:
        ConfigError: ``store_url_invalid``.
        MissingDependencyError: ``store_missing``.
    """
    if settings.store_url is None:
        return None
    try:
        from viflow_anomaly_service.store.detection_store import DetectionStore  # noqa: PLC0415
        from viflow_anomaly_service.store.keeper import ResultKeeper  # noqa: PLC0415

        store = DetectionStore(settings.store_url.get_secret_value())
    except ImportError as err:
        raise MissingDependencyError(
            f"store_url: expected the packages of the extra `store`, found no {err.name}: "
            "pip install 'viflow-anomaly[store]'",
            code="store_missing",
            field="store_url",
        ) from err
    return ResultKeeper(store, settings, metrics)
