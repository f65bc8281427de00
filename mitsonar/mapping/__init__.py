"""Motions become a path, frames and a path become a mosaic."""
