"""The errors that a person can mend."""

from __future__ import annotations


class InputError(ValueError):
    """Input that cannot be used: the message says what is wrong and what to do.

    Command lines print the message alone, without a traceback, and exit with code 2.
    """


class MissingExtra(InputError):
    """An optional package that is not installed; the message names the extra to install."""
