"""What the project costs, as ratios of two things measured side by side: `python -m benchmarks`."""

import os

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # as `console` sets it for the commands: JAX reads it on import
