"""``python -m viflow_anomaly_service``: the server with its settings from the environment."""

from __future__ import annotations

import sys

from viflow_anomaly.errors import ViflowError
from viflow_anomaly_service.server import run
from viflow_anomaly_service.settings import load_settings


def main() -> int:
    """Exit status: 0 after a shutdown on request, 2 for settings or a checkpoint that cannot be used."""
    try:
        run(load_settings())
    except ViflowError as err:
        sys.stderr.write(f"error: {err.message}\n")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
