"""The exception that a command turns into one line and exit code 2."""

from __future__ import annotations


class UserError(Exception):
    """Something that the user gave cannot be used; the text says what was given, what is wanted and what to do.

    Example:
      try:
          policy = dipn_jax.load_policy("vpg")
      except dipn_jax.UserError as error:
          print(error)        # --method vpg: needs --value-net; give a run of dipn-train baseline
    """
