"""What a service said instead of an answer, or that it said nothing."""

from __future__ import annotations

from viflow_anomaly.errors import ViflowError


class ServiceError(ViflowError):
    """Root of what goes wrong between a client and a service.

    Attributes:
        status: of the HTTP answer, or None where there was none.
        request_id: under which the service's log has the request, or None.
        retry_after_s: seconds after which the service wants to be asked again, or None.
    """

    def __init__(
        self,
        message: str,
        *,
        code: str,
        field: str | None = None,
        status: int | None = None,
        request_id: str | None = None,
        retry_after_s: float | None = None,
    ) -> None:
        super().__init__(message, code=code, field=field)
        self.status = status
        self.request_id = request_id
        self.retry_after_s = retry_after_s

    def __reduce__(self) -> tuple[object, ...]:
        more = (self.status, self.request_id, self.retry_after_s)
        return _rebuilt, (type(self), self.message, self.code, self.field, *more)


class ServiceUnreachableError(ServiceError):
    """No answer: no connection, a broken one, or none in time (``service_unreachable``, ``service_timeout``)."""


class ServiceRefusedError(ServiceError):
    """The request or its key is at fault; ``code`` and ``field`` are the service's."""


class ServiceBusyError(ServiceError):
    """The service or the key's allowance is used up for now (429, 503); ``code`` is the service's."""


class ServiceFaultError(ServiceError):
    """The service failed, or what answered is none (``service_answer_unreadable``)."""


def _rebuilt(
    kind: type[ServiceError],
    message: str,
    code: str,
    field: str | None,
    status: int | None,
    request_id: str | None,
    retry_after_s: float | None,
) -> ServiceError:
    return kind(message, code=code, field=field, status=status, request_id=request_id, retry_after_s=retry_after_s)
