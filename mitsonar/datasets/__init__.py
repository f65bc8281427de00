"""Data sets: a recipe becomes labelled frames in a Zarr store, or in memory during training; torch reads them."""
