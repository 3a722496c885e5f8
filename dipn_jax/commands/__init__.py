"""What the three commands share: options, progress, one-line errors, HTML, tasks on a cluster."""
