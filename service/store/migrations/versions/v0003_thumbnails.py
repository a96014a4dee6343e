"""Thumbnails beside detections."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None


def upgrade() -> None:
    id_type = sa.String(32).with_variant(sa.String(32, collation="C"), "postgresql")
    op.create_table(
        "thumbnails",
        sa.Column("detection_id", id_type, sa.ForeignKey("detections.id", ondelete="CASCADE"), primary_key=True),
        sa.Column("size_bytes", sa.Integer, nullable=False),
        sa.Column("image", sa.LargeBinary, nullable=False),
    )
    op.create_index("thumbnails_by_size", "thumbnails", ["detection_id", "size_bytes"])


def downgrade() -> None:
    op.drop_table("thumbnails")
