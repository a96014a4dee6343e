"""Run by Alembic for every upgrade, on the connection and inside the transaction that ``store.engine`` gives it."""

from __future__ import annotations

from alembic import context

from viflow_anomaly_service.store.tables import METADATA

context.configure(connection=context.config.attributes["connection"], target_metadata=METADATA)
context.run_migrations()
