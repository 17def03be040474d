"""The error by which a lanelet is left out."""


class CannotMendError(Exception):
    """A lanelet has to be left out; the message is the reason, in plain words."""
