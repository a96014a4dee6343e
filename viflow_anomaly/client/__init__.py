"""Asks a viflow-anomaly service for detections: ``Client``, and ``AsyncClient`` for asyncio (extra ``client``)."""

from viflow_anomaly.client.api_key import read_api_key
from viflow_anomaly.client.calling import AsyncClient, Client
from viflow_anomaly.client.encoded_pair import EncodedPair
from viflow_anomaly.client.retry_policy import RetryPolicy
from viflow_anomaly.client.service_errors import (
    ServiceBusyError,
    ServiceError,
    ServiceFaultError,
    ServiceRefusedError,
    ServiceUnreachableError,
)

__all__ = [
    "AsyncClient",
    "Client",
    "EncodedPair",
    "RetryPolicy",
    "ServiceBusyError",
    "ServiceError",
    "ServiceFaultError",
    "ServiceRefusedError",
    "ServiceUnreachableError",
    "read_api_key",
]
