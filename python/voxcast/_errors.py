"""Exceptions and warnings. The text of each is the line that the command line prints."""

from __future__ import annotations


class Error(Exception):
    """What voxcast raises. `path` is the file that it is about, where there is one."""

    path: str | None

    def __init__(self, line: str, path: str | None = None) -> None:
        super().__init__(line)
        self.path = path


class FileError(Error, OSError):
    """The system refused a read, a write or a mapping."""


class FormatError(Error, ValueError):
    """Bytes are not what the format says: cut short, damaged, of the wrong type, out of range."""


class MismatchError(Error, ValueError):
    """Well-formed input that belongs to something else: a rig of another network, an image of another size."""


class UnsupportedError(Error, RuntimeError):
    """The request is understood and not supported, by this build or this machine."""


class TooLargeError(Error, MemoryError):
    """The request needs more memory than there is, or than the formats can address."""


class BusyError(Error, RuntimeError):
    """Another thread is using the object."""


class Note(UserWarning):
    """What a file says that is not obeyed, or is hardly ever meant. Not an error; `warnings` decides what becomes of it."""
