"""Files written whole or not at all, and hashes that identify their content."""

import contextlib
import hashlib
import json
import os
import re
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from fpcal_bayes.core.errors import InputError

try:
    import fcntl
except ImportError:
    # Windows: there an open file cannot be replaced, so that the lock is a file of its own.
    import filelock

    _HAS_FLOCK = False
else:
    _HAS_FLOCK = True

#: On Windows a file that somebody reads cannot be replaced: how often this is tried, and the seconds between.
_TRIES, _BETWEEN_TRIES = 20, 0.05


#: Key of a JSON file under which the hash of all the rest stands.
CONTENT_HASH = "content_sha256"
#: Lists of numbers stand on one line; no text in JSON holds a line end.
_NUMBERS = re.compile(r"\[\n[-+0-9.eE,\s]+\]")


def require_readable(path: Path) -> None:
    """Raise `InputError` unless `path` is an existing, readable, non-empty file."""
    try:
        if path.is_dir():
            raise InputError(f"{path}: is a folder, expected a file")
        if not path.exists():
            raise InputError(f"{path}: no such file")
        if path.stat().st_size == 0:
            raise InputError(f"{path}: the file is empty")
        with path.open("rb"):
            pass
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: cannot be read ({_reason(error)})") from error


def require_writable(path: Path) -> None:
    """Raise `InputError` unless a file can be put at `path`; nothing is left behind."""
    folder = path.parent
    if path.is_dir():
        raise InputError(f"{path}: is a folder, expected the name of a file to write")
    if not folder.is_dir():
        raise InputError(f"{path}: the folder {folder} does not exist")
    try:
        handle, probe = tempfile.mkstemp(dir=folder, prefix=".fpcal-")
    except OSError as error:
        raise InputError(f"{path}: the folder {folder} is not writable ({_reason(error)})") from error
    os.close(handle)
    Path(probe).unlink()


def make_folder(folder: Path) -> None:
    """Make `folder` unless it is there; `InputError` if that fails."""
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: expected a folder that can be made ({_reason(error)})") from error


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a temporary name beside `path`; on success it takes the place of `path`.

    The content reaches the disk before the rename, so a reader sees the old file or the new one.

    Raises
    ------
    InputError
        If the folder is missing or not writable, or the disk refuses the content.
    """
    require_writable(path)
    # The name is hidden and unique: two writers never share a temporary file.
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}-", suffix=".tmp")
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        with temporary.open("rb+") as written:
            os.fsync(written.fileno())
        mask = os.umask(0)
        os.umask(mask)
        temporary.chmod(0o666 & ~mask)
        _replace(temporary, path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({_reason(error)})") from error
    finally:
        temporary.unlink(missing_ok=True)


def _replace(temporary: Path, path: Path) -> None:
    """Rename; where a reader forbids it, wait for the reader."""
    for _ in range(0 if _HAS_FLOCK else _TRIES):
        with contextlib.suppress(PermissionError):
            temporary.replace(path)
            return
        time.sleep(_BETWEEN_TRIES)
    temporary.replace(path)


@contextlib.contextmanager
def exclusive(path: Path) -> Iterator[Callable[[], None]]:
    """Be the only writer of an existing file; the lock ends with the process, however that ends.

    Gives a function that raises `InputError` if another program has put another file in its place meanwhile.

    Raises
    ------
    InputError
        If another process holds the file, or it cannot be opened.
    """
    with contextlib.ExitStack() as held:
        try:
            with contextlib.ExitStack() as opened:
                handle = os.open(path, os.O_RDONLY)
                opened.callback(os.close, handle)
                before = os.fstat(handle)
                if _HAS_FLOCK:
                    # As long as the file is open, no other one has its number.
                    held.push(opened.pop_all())
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({_reason(error)})") from error

        def require_same() -> None:
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(before, path.stat()):
                    return
            raise InputError(f"{path}: another program replaced or removed this file meanwhile: run the command again")

        try:
            if _HAS_FLOCK:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            else:
                lock = filelock.FileLock(path.with_name(f".{path.name}.lock"), timeout=0)
                held.enter_context(lock)
        except (BlockingIOError, TimeoutError) as error:
            raise InputError(f"{path}: another fpcal is writing this file: wait until it has ended") from error
        except OSError:
            # Some shared drives have no locks; that the file is still the same is checked all the same.
            pass
        require_same()
        yield require_same


def write_text(path: Path, text: str) -> None:
    """Write `text` as UTF-8 with Unix line ends, whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_bytes(text.encode())


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write `content` and its hash as JSON; NaN and infinity are refused, since JSON has neither."""
    text = json.dumps(content | {CONTENT_HASH: content_sha256(content)}, indent=1, allow_nan=False)
    write_text(path, _NUMBERS.sub(lambda found: " ".join(found[0].split()), text) + "\n")


def read_text(path: Path) -> str:
    """Read a UTF-8 text file.

    Raises
    ------
    InputError
        If the file is missing, a folder, empty, or not UTF-8 text.
    """
    require_readable(path)
    try:
        return path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = path.read_bytes()[: error.start].count(b"\n") + 1
        byte = error.object[error.start]
        raise InputError(f"{path}: row {line}: expected UTF-8 text, found byte 0x{byte:02x}") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({_reason(error)})") from error


def require_line_end(path: Path, text: str) -> None:
    """Raise `InputError` unless the last line of a text has an end: without it, its last value may be cut short."""
    if text and not text.endswith(("\n", "\r")):
        row = len(text.splitlines())
        raise InputError(f"{path}: row {row}: expected a line end after the last row, the file may be cut short")


def file_sha256(path: Path) -> str:
    """Hash of a file's bytes, as 64 hexadecimal digits."""
    with path.open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def content_sha256(content: Any) -> str:
    """Hash of a JSON-like value: equal content gives equal hashes, whatever its layout in a file."""
    return hashlib.sha256(json.dumps(content, sort_keys=True, allow_nan=False).encode()).hexdigest()


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)
