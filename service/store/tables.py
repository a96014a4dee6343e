"""The tables, as the newest migration leaves them (a test compares the two)."""

from __future__ import annotations

from typing import Final

from sqlalchemy import BigInteger, Column, Float, ForeignKey, Index, Integer, LargeBinary, MetaData, String, Table, Text

ID_CHARACTERS: Final = 32

METADATA: Final = MetaData()
ID_TYPE: Final = String(ID_CHARACTERS).with_variant(String(ID_CHARACTERS, collation="C"), "postgresql")
"""Compared byte by byte everywhere: the order of ids is the order of time."""

DETECTIONS: Final = Table(
    "detections",
    METADATA,
    Column("id", ID_TYPE, primary_key=True),
    Column("stream_id", String(64)),
    Column("session_id", String(ID_CHARACTERS)),
    Column("source_timestamp_ns", BigInteger, nullable=False),
    Column("target_timestamp_ns", BigInteger, nullable=False),
    Column("size_bytes", Integer, nullable=False),
    Column("body", Text, nullable=False),
)
Index("detections_by_stream", DETECTIONS.c.stream_id, DETECTIONS.c.id)
Index("detections_by_time", DETECTIONS.c.source_timestamp_ns)
Index("detections_by_size", DETECTIONS.c.id, DETECTIONS.c.size_bytes)

LABELS: Final = Table(
    "detection_labels",
    METADATA,
    Column("detection_id", ID_TYPE, ForeignKey("detections.id", ondelete="CASCADE"), primary_key=True),
    Column("label", String(64), primary_key=True),
    Column("top_score", Float, nullable=False),
)

THUMBNAILS: Final = Table(
    "thumbnails",
    METADATA,
    Column("detection_id", ID_TYPE, ForeignKey("detections.id", ondelete="CASCADE"), primary_key=True),
    Column("size_bytes", Integer, nullable=False),
    Column("image", LargeBinary, nullable=False),
)
Index("thumbnails_by_size", THUMBNAILS.c.detection_id, THUMBNAILS.c.size_bytes)

PROBE: Final = Table(
    "store_probe",
    METADATA,
    Column("id", Integer, primary_key=True, autoincrement=False),
    Column("padding", Text, nullable=False),
)
"""One row that is written again to see whether the store can be written to."""
