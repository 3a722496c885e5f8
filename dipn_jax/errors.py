"""The exceptions that a command turns into one line and exit code 2."""

from __future__ import annotations


class UserError(Exception):
    """Something that the user gave cannot be used; the text says what was given, what is wanted and what to do.

    Example:
      try:
          policy = dipn_jax.load_policy("vpg")
      except dipn_jax.UserError as error:
          print(error)        # --method vpg: needs --value-net; give a run of dipn-train baseline
    """

    def __init__(self, text: str) -> None:
        """Keep the text on one line: what cannot be printed, as a line break in the name of a file, is shown as ?."""
        text = text.encode("utf-8", "backslashreplace").decode()
        super().__init__("".join(c if c.isprintable() else "?" for c in text))


class InUse(UserError):
    """Another process has a folder; it may be free later, also where that process was on a machine that is lost."""
