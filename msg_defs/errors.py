"""The one exception family for what a user can mend."""


class InputError(ValueError):
    """Bad input: the message names the value and the remedy. Commands exit with code 2 on it."""
