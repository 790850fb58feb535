"""What is reported without a traceback."""


class InputError(Exception):
    """A file or option is at fault; the message names it, what was found and what was expected."""
