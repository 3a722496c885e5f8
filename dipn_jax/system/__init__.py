"""Files, processes and signals: what holds on every machine."""
