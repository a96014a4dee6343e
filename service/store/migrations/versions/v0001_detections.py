"""The tables of the first version."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None


def upgrade() -> None:
    id_type = sa.String(32).with_variant(sa.String(32, collation="C"), "postgresql")
    op.create_table(
        "detections",
        sa.Column("id", id_type, primary_key=True),
        sa.Column("stream_id", sa.String(64)),
        sa.Column("session_id", sa.String(32)),
        sa.Column("source_timestamp_ns", sa.BigInteger, nullable=False),
        sa.Column("target_timestamp_ns", sa.BigInteger, nullable=False),
        sa.Column("size_bytes", sa.Integer, nullable=False),
        sa.Column("body", sa.Text, nullable=False),
    )
    op.create_index("detections_by_stream", "detections", ["stream_id", "id"])
    op.create_index("detections_by_time", "detections", ["source_timestamp_ns"])
    op.create_index("detections_by_size", "detections", ["id", "size_bytes"])
    op.create_table(
        "detection_labels",
        sa.Column("detection_id", id_type, sa.ForeignKey("detections.id", ondelete="CASCADE"), primary_key=True),
        sa.Column("label", sa.String(64), primary_key=True),
        sa.Column("top_score", sa.Float, nullable=False),
    )
    op.create_table(
        "store_probe",
        sa.Column("id", sa.Integer, primary_key=True, autoincrement=False),
        sa.Column("padding", sa.Text, nullable=False),
    )


def downgrade() -> None:
    for table in ("store_probe", "detection_labels", "detections"):
        op.drop_table(table)
