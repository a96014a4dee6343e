"""Detections that stay: SQLite or PostgreSQL behind the answers, and the endpoints that read them."""
