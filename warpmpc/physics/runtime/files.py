# SPDX-License-Identifier: Apache-2.0
"""Files of results: written whole or not at all and tried beforehand; what may be read and shown.

Files of arrays that come from elsewhere: they may be anything, or cut off.
"""

from __future__ import annotations

import errno
import io
import os
import tempfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np

SPACES = "\n\t\u00a0\u202f\u2009"
"""What is not called printable and steers nothing: lines, tabs, and spaces that people write."""


class Unwritable(OSError):
    """A file that could not be written; its text is one line that names it."""


@contextmanager
def writing(path: str | Path) -> Iterator[None]:
    """Errors of what writes a file name that file.

    Raises:
        Unwritable: If it cannot be written.
    """
    try:
        yield
    except (Unwritable, BrokenPipeError):
        raise
    except OSError as error:
        raise Unwritable(f"cannot write '{path}': {reason(error)}") from error


def reason(error: OSError) -> str:
    """What is wrong, in words, without file and number."""
    return os.strerror(error.errno) if error.errno else " ".join(str(error).split())


class Output(io.TextIOWrapper):
    """Standard output as text; an error says that it was standard output."""

    def write(self, text: str) -> int:
        """Write a text."""
        with writing("standard output"):
            return super().write(text)

    def flush(self) -> None:
        """Hand over what was written."""
        with writing("standard output"):
            super().flush()


@contextmanager
def replacing(path: Path, mode: str = "w", **keys: Any) -> Iterator[IO]:
    """Open a file beside another, whose place it takes once it is whole; what was there stays until then.

    Args:
        path: The file that is replaced; where a symbolic link leads.
        mode: ``w`` or ``wb``.

    Raises:
        Unwritable: If it cannot be written; the old file is as it was.
    """
    with writing(path):
        target = Path(os.path.realpath(path))
        part = target.with_name(f".{zlib.crc32(os.fsencode(target.name)):08x}.{os.getpid()}")  # short, as names end
        try:
            with open(part, mode, **keys) as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            if target.exists():
                part.chmod(target.stat().st_mode)
            part.replace(target)
        finally:
            part.unlink(missing_ok=True)


def append_line(path: Path, line: bytes) -> None:
    """Append a line to a file, on disk before this returns; a last line that was cut off is dropped.

    Raises:
        Unwritable: If it cannot be written; whole lines stay.
    """
    with writing(path), open(path, "ab+", buffering=0) as file:
        if os.name == "posix":
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX)  # another run may do the same
        whole = file.seek(0, os.SEEK_END)
        file.seek(max(whole - 1, 0))
        if whole and file.read() != b"\n":
            file.seek(0)
            whole = file.read().rfind(b"\n") + 1
            file.truncate(whole)
        try:
            data = memoryview(line + b"\n")
            while data:
                data = data[file.write(data) :]
            os.fsync(file.fileno())
        except OSError:
            file.truncate(whole)
            raise


def take(file: IO) -> bool:
    """Lock an open file until it is closed; returns False where another run has locked it."""
    if os.name == "posix":
        import fcntl

        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError:  # a file system without locks
            pass
    return True


def try_file(path: Path) -> None:
    """Refuse a file that could not be written; nothing is changed.

    Raises:
        OSError: If it could not.
    """
    try:
        if os.path.exists(path) and not path.is_file():
            raise OSError(f"cannot write '{path}': there is something that is no file; give another name")
        if os.path.exists(path) and not os.access(path, os.W_OK):
            raise OSError(f"cannot write '{path}': it is read-only; give another name")
        if os.path.exists(path):
            with open(path, "ab") as file:
                if not take(file):
                    raise OSError(f"cannot write '{path}': another run is writing it; give another name")
        target = Path(os.path.realpath(path))
        if not os.path.exists(target):  # a name that is too long, or a link that leads to itself, shows when it is made
            os.close(os.open(target, os.O_CREAT | os.O_EXCL | os.O_WRONLY))
            target.unlink()
        tempfile.TemporaryFile(dir=target.parent).close()
    except OSError as error:
        if error.errno is None:
            raise
        why = "it is a link that leads to itself" if error.errno == errno.EEXIST else reason(error)
        raise OSError(f"cannot write '{path}': {why}; give another name, or a file in another folder") from None


def require_regular(path: Path) -> None:
    """Refuse to read a device or a pipe, which has no end.

    Raises:
        ValueError: If a path is one.
    """
    if os.path.exists(path) and not path.is_file():
        raise ValueError(f"is {'a folder' if path.is_dir() else 'no regular file'}")


def plain(text: str) -> str:
    """A text from elsewhere as a terminal may show it: what would steer the terminal is shown as its escape."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in SPACES else c.encode("unicode_escape").decode() for c in text)


def require_space(path: Path, more: int) -> None:
    """Refuse what would not fit on the disk, for libraries that fail badly where it is full.

    Args:
        path: The file, there or not.
        more: What will be added to it [bytes].

    Raises:
        Unwritable: If it does not fit.
    """
    if hasattr(os, "posix_fallocate"):
        with writing(path), tempfile.TemporaryFile(dir=path.absolute().parent) as file:
            os.posix_fallocate(file.fileno(), path.stat().st_size if path.exists() else 0, more)


@contextmanager
def read_npz(path: str | Path) -> Iterator[np.lib.npyio.NpzFile]:
    """Open an ``.npz`` file; arrays are read from it inside the context.

    Raises:
        ValueError: If it is damaged or something else, or lacks what is read from it.
        OSError: If it cannot be read.
    """
    import numpy as np  # loading a scene needs none

    try:
        with np.load(path, allow_pickle=False) as data:
            yield data
    except (OSError, ValueError):
        raise
    except Exception as error:  # zipfile, zlib, struct and NumPy have a dozen for what is damaged
        raise ValueError(f"is damaged, or no such file of arrays: {error}") from error
