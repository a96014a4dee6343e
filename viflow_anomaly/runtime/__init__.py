"""Backends that run a network: one small interface, numpy in and numpy out."""
