"""Recordings of phone apps."""
