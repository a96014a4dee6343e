"""One root exception and its few children.

Libraries raise these; only the command line and the HTTP service translate them (to an exit code, to an RFC 9457
problem). A message says what was expected, what was found and where.
"""

from __future__ import annotations


class ViflowError(Exception):
    """Root of every error this package raises on purpose.

    Attributes:
        code: stable, machine-readable name of the fault (``"imu_unsorted"``).
        field: the input at fault in dotted form (``"imu.timestamps_ns"``), or None.
    """

    def __init__(self, message: str, *, code: str, field: str | None = None) -> None:
        super().__init__(message)
        self.code = code
        self.field = field

    def __reduce__(self) -> tuple[object, ...]:
        """Pickled with code and field: an error raised in a worker process reaches its parent whole."""
        return _rebuilt, (type(self), self.message, self.code, self.field)

    @property
    def message(self) -> str:
        return str(self.args[0])


class InvalidInputError(ViflowError):
    """A value that contradicts itself or cannot be used (images, IMU samples, camera)."""


class TooLargeError(InvalidInputError):
    """More bytes, pixels or samples than the stated limit allows."""


class UnsupportedImageError(InvalidInputError):
    """The bytes are not a PNG or JPEG at all."""


class DatasetError(ViflowError):
    """A recording that cannot be read: unknown layout, malformed file (named with its line), missing file."""


class ConfigError(ViflowError):
    """A configuration with unknown keys or values outside their range."""


class CheckpointError(ViflowError):
    """A checkpoint that is truncated, of another version, or not one of ours."""


class MissingDependencyError(ViflowError):
    """An optional package is needed; the message gives the install line."""


def _rebuilt(kind: type[ViflowError], message: str, code: str, field: str | None) -> ViflowError:
    return kind(message, code=code, field=field)
