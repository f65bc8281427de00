"""Files that are whole or absent, object storage, and the folder of a run."""
