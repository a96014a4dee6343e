"""Events, what is open of them, and their deliveries."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None


def upgrade() -> None:
    id_type = sa.String(32).with_variant(sa.String(32, collation="C"), "postgresql")
    sequence_type = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
    op.create_table(
        "events",
        sa.Column("seq", sequence_type, primary_key=True, autoincrement=True),
        sa.Column("event_id", id_type, nullable=False, unique=True),
        sa.Column("thing_id", sa.String(64), nullable=False),
        sa.Column("kind", sa.String(8), nullable=False),
        sa.Column("stream_id", sa.String(64), nullable=False),
        sa.Column("timestamp_ns", sa.BigInteger, nullable=False),
        sa.Column("body", sa.Text, nullable=False),
        sa.UniqueConstraint("thing_id", "kind", "timestamp_ns", name="events_once"),
        sqlite_autoincrement=True,
    )
    op.create_index("events_by_stream", "events", ["stream_id", "seq"])
    op.create_index("events_by_time", "events", ["timestamp_ns"])
    op.create_table(
        "open_events",
        sa.Column("thing_id", sa.String(64), primary_key=True),
        sa.Column("stream_id", sa.String(64), nullable=False),
        sa.Column("holder", sa.String(32), nullable=False),
        sa.Column("held_until_ns", sa.BigInteger, nullable=False),
        sa.Column("body", sa.Text, nullable=False),
    )
    op.create_table(
        "event_deliveries",
        sa.Column("event_seq", sequence_type, sa.ForeignKey("events.seq", ondelete="CASCADE"), primary_key=True),
        sa.Column("sink", sa.String(64), primary_key=True),
        sa.Column("state", sa.String(9), nullable=False),
        sa.Column("attempts", sa.Integer, nullable=False),
        sa.Column("next_attempt_ns", sa.BigInteger, nullable=False),
        sa.Column("last_error", sa.Text),
    )
    op.create_index("event_deliveries_by_state", "event_deliveries", ["sink", "state", "event_seq"])
    op.create_table(
        "event_sinks",
        sa.Column("sink", sa.String(64), primary_key=True),
        sa.Column("holder", sa.String(32), nullable=False),
        sa.Column("held_until_ns", sa.BigInteger, nullable=False),
    )


def downgrade() -> None:
    for table in ("event_sinks", "event_deliveries", "open_events", "events"):
        op.drop_table(table)
