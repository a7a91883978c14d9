"""Errors that a user can act on."""


class InputError(Exception):
    """Unusable input: the message is one line that says what is wrong and what to do. Commands print it and exit with status 2."""


class Cancelled(Exception):
    """The user asked to stop; what was finished stays valid."""
