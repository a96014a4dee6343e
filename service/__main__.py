"""``python -m viflow_anomaly_service``: the server with its settings from the environment."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from viflow_anomaly.errors import ConfigError, ViflowError
from viflow_anomaly_service.server import run
from viflow_anomaly_service.settings import load_settings


def main(arguments: Sequence[str] = ()) -> int:
    """Exit status: 0 after a shutdown on request, 2 for arguments, settings or a checkpoint that cannot be used."""
    try:
        _require_no_arguments(arguments)
        run(load_settings())
    except ViflowError as err:
        sys.stderr.write(f"error: {err.message}\n")
        return 2
    return 0


def _require_no_arguments(found: Sequence[str]) -> None:
    if found:
        raise ConfigError(
            f"expected no arguments: settings are variables of the environment (VIFLOW_...), found {found[0]!r:.80}; "
            "`viflow-anomaly serve --help` has options",
            code="arguments_unknown",
        )


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
