"""The one exception that a command turns into one line and exit code 2."""

from __future__ import annotations


class UserError(Exception):
    """Something a user gave cannot be used: what came, what was wanted, what to do."""
