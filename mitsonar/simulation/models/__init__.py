"""Models of a ping behind one protocol: ``thesis``, ``physical`` and ``coherent``."""
