"""Atomic file writing, object storage, and run folders."""
