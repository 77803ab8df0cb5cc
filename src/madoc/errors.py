"""The one exception a user's mistake raises: a sentence saying what, where and what to do."""


class MadocError(ValueError):
    """Bad input or a refused problem. The command line prints its sentence and exits with code 2."""
