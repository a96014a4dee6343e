"""Asks a viflow-anomaly service for detections: ``Client``, and ``AsyncClient`` for asyncio (extra ``client``)."""

from viflow_anomaly.client.api_key import read_api_key
from viflow_anomaly.client.async_calling import AsyncClient
from viflow_anomaly.client.calling import Client
from viflow_anomaly.client.encoded_pair import EncodedPair
from viflow_anomaly.client.live_events import LiveEvent
from viflow_anomaly.client.replaying import replay
from viflow_anomaly.client.retry_policy import RetryPolicy
from viflow_anomaly.client.service_errors import (
    ServiceBusyError,
    ServiceError,
    ServiceFaultError,
    ServiceRefusedError,
    ServiceUnreachableError,
)
from viflow_anomaly.client.streaming import AsyncClientStream, ClientStream, EncodedFrame, StreamAnswer

__all__ = [
    "AsyncClient",
    "AsyncClientStream",
    "Client",
    "ClientStream",
    "EncodedFrame",
    "EncodedPair",
    "LiveEvent",
    "RetryPolicy",
    "ServiceBusyError",
    "ServiceError",
    "ServiceFaultError",
    "ServiceRefusedError",
    "ServiceUnreachableError",
    "StreamAnswer",
    "read_api_key",
    "replay",
]
