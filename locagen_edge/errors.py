"""What can go wrong, in words that a tired operator can act on.

Every error that a user can cause is a `LocagenError`, and its text says what is wrong, where, and what to
do. The command line prints that text on one line and exits; it never shows a traceback for one of these.
"""


class LocagenError(Exception):
    """Root of all errors that carry a message for the user."""


class SettingsError(LocagenError):
    """Settings that cannot be flown with. The text names every fault, each by `section.key`."""


class SourceError(LocagenError):
    """A sound source that cannot be opened or has failed: a device, a file, a driver."""


class SourceHungError(SourceError):
    """A driver that does not return. Its thread cannot be ended from within: only a new process helps."""


class ModelError(LocagenError):
    """A model file that is missing, altered, or not of the shape the settings ask for."""


class LinkError(LocagenError):
    """A MAVLink link that cannot be opened or has failed."""


class KernelError(LocagenError):
    """The C kernel refused its configuration or its input."""


class DatasetError(LocagenError):
    """A data set that cannot be written, is not complete, or is not what the settings ask for."""


class CalibrationError(LocagenError):
    """A recording from which the array cannot be calibrated. The text says what is missing and what to do."""
