"""The formats on disk, data sets and checkpoints, and data sets in object storage."""
