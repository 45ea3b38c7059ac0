"""Recordings: storage and conversion of messages."""
