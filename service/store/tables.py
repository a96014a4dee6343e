"""The tables, as the newest migration leaves them (a test compares the two)."""

from __future__ import annotations

from typing import Final

from sqlalchemy import (
    BigInteger,
    Column,
    Float,
    ForeignKey,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    String,
    Table,
    Text,
    UniqueConstraint,
)

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

SEQUENCE_TYPE: Final = BigInteger().with_variant(Integer(), "sqlite")
"""SQLite counts rows by itself only under its own name for integers."""

EVENTS: Final = Table(
    "events",
    METADATA,
    Column("seq", SEQUENCE_TYPE, primary_key=True, autoincrement=True),
    Column("event_id", ID_TYPE, nullable=False, unique=True),
    Column("thing_id", String(64), nullable=False),
    Column("kind", String(8), nullable=False),
    Column("stream_id", String(64), nullable=False),
    Column("timestamp_ns", BigInteger, nullable=False),
    Column("body", Text, nullable=False),
    UniqueConstraint("thing_id", "kind", "timestamp_ns", name="events_once"),
    sqlite_autoincrement=True,  # the number of an event that was deleted is never given again
)
"""``seq`` grows in the order of the commits: who has read up to one has missed none before it."""
Index("events_by_stream", EVENTS.c.stream_id, EVENTS.c.seq)
Index("events_by_time", EVENTS.c.timestamp_ns)

OPEN_EVENTS: Final = Table(
    "open_events",
    METADATA,
    Column("thing_id", String(64), primary_key=True),
    Column("stream_id", String(64), nullable=False),
    Column("holder", String(32), nullable=False),
    Column("held_until_ns", BigInteger, nullable=False),
    Column("body", Text, nullable=False),
)
"""What has begun and not ended, with its last message, and which process will end it if it lives."""

DELIVERIES: Final = Table(
    "event_deliveries",
    METADATA,
    Column("event_seq", SEQUENCE_TYPE, ForeignKey("events.seq", ondelete="CASCADE"), primary_key=True),
    Column("sink", String(64), primary_key=True),
    Column("state", String(9), nullable=False),
    Column("attempts", Integer, nullable=False),
    Column("next_attempt_ns", BigInteger, nullable=False),
    Column("last_error", Text),
)
"""What is to be told to whom: a row an event and sink, written with the event."""
Index("event_deliveries_by_state", DELIVERIES.c.sink, DELIVERIES.c.state, DELIVERIES.c.event_seq)

SINKS: Final = Table(
    "event_sinks",
    METADATA,
    Column("sink", String(64), primary_key=True),
    Column("holder", String(32), nullable=False),
    Column("held_until_ns", BigInteger, nullable=False),
)
"""Which process delivers to a sink."""
