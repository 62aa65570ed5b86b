"""Files written whole or not at all, and hashes that identify their content."""

import contextlib
import errno
import hashlib
import json
import os
import platform
import re
import secrets
import shutil
import stat
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from fpcal_bayes.core.errors import HeldError, InputError, reason

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
#: Temporary files of this machine begin so; on another machine whoever made one may live. A day later nobody does.
_TEMPORARY, _STALE_S = f".fpcal-{platform.node()}-", 86400.0
#: Files that this process holds alone, by their real path, each with the check that it is still the same.
_HELD: dict[str, Callable[[], None]] = {}
#: Words of a command line that tell this program, installed, as a module or in a script.
_OWN_WORDS = re.compile(r"(?:^|/)fpcal$|^fpcal_bayes$|(?:from|import) fpcal_bayes")


#: Key of a JSON file under which the hash of all the rest stands.
CONTENT_HASH = "content_sha256"


def require_readable(path: Path) -> None:
    """Raise `InputError` unless `path` is an existing, readable, non-empty file."""
    try:
        found = path.stat()
        if stat.S_ISREG(found.st_mode):
            path.open("rb").close()
    except (FileNotFoundError, NotADirectoryError, ValueError) as error:
        raise InputError(f"{path}: no such file") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({reason(error)})") from error
    if not stat.S_ISREG(found.st_mode):
        kind = "a folder" if stat.S_ISDIR(found.st_mode) else "a device or a pipe"
        raise InputError(f"{path}: is {kind}, expected a file")
    if found.st_size == 0:
        raise InputError(f"{path}: the file is empty")


def require_writable(path: Path) -> Path:
    """Where content for `path` goes, links followed; `InputError` unless there can be a file, a device or a stream."""
    try:
        target = _destination(path)
        kind = stat.S_IFMT(target.stat().st_mode) if target.exists() else stat.S_IFREG
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be written ({reason(error)})") from error
    folder = target.parent
    if _stream(target) is not None:
        return target
    if kind == stat.S_IFDIR:
        raise InputError(f"{path}: is a folder, expected the name of a file to write")
    if kind in (stat.S_IFIFO, stat.S_IFSOCK):
        raise InputError(f"{path}: is a pipe or a socket, expected the name of a file to write")
    if not folder.is_dir():
        raise InputError(f"{path}: the folder {folder} does not exist")
    try:
        if kind == stat.S_IFREG:
            with _temporary(folder):
                pass
    except OSError as error:
        raise InputError(f"{path}: the folder {folder} is not writable ({reason(error)})") from error
    return target


def _destination(path: Path) -> Path:
    """The name to which links lead, or that of a stream of this process."""
    for _ in range(40):
        if _stream(path) is not None or not path.is_symlink():
            return path
        path = path.parent / path.readlink()
    raise OSError(errno.ELOOP, os.strerror(errno.ELOOP))


def _stream(path: Path) -> int | None:
    """Number of the open stream that a name stands for; None for the names of files."""
    name = os.path.abspath(path)
    numbered = re.fullmatch(r"(?:/dev|/proc/self)/fd/([0-9]{1,9})", name)
    return int(numbered[1]) if numbered else {"/dev/stdout": 1, "/dev/stderr": 2}.get(name)


def make_folder(folder: Path) -> None:
    """Make `folder` unless it is there; `InputError` if that fails."""
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: expected a folder that can be made ({reason(error)})") from error


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary name that on success takes the place of `path`, links followed; devices and streams are written."""
    target = require_writable(path)
    try:
        through = _stream(target) is not None or (target.exists() and not target.is_file())
        with _temporary(Path(tempfile.gettempdir()) if through else target.parent) as temporary:
            yield temporary
            if through:
                _write_through(temporary, target)
                return
            with temporary.open("rb+") as written:
                os.fsync(written.fileno())
            mask = os.umask(0)
            os.umask(mask)
            temporary.chmod(stat.S_IMODE(target.stat().st_mode) if target.exists() else 0o666 & ~mask)
            same = _HELD.get(os.path.realpath(target))
            with contextlib.ExitStack() as lock:
                if same is None and target.exists():
                    same = lock.enter_context(_locked(target, shared=True))
                if same is not None:
                    same()
                _replace(temporary, target)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({reason(error)})") from error


@contextlib.contextmanager
def _temporary(folder: Path) -> Iterator[Path]:
    """A temporary file in a folder, where those of processes that have ended are removed."""
    for left in folder.glob(".fpcal-*.tmp"):
        with contextlib.suppress(OSError, ValueError):
            here = _HAS_FLOCK and left.name.startswith(_TEMPORARY)
            if time.time() - left.stat().st_mtime > _STALE_S or (here and not _is_alive(int(left.name.split("-")[-2]))):
                left.unlink()
    path = folder / f"{_TEMPORARY}{os.getpid()}-{secrets.token_hex(8)}.tmp"
    try:
        os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600))
        yield path
    finally:
        path.unlink(missing_ok=True)


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except OSError as error:
        return error.errno != errno.ESRCH
    return True


def _write_through(temporary: Path, target: Path) -> None:
    """Write content to a device, or to a stream behind what was printed there; a reader may be gone."""
    number = _stream(target)
    if number is None:
        with temporary.open("rb") as content, target.open("wb") as device:
            shutil.copyfileobj(content, device)
        return
    for printed in (sys.stdout, sys.stderr):
        printed.flush()
    with contextlib.suppress(BrokenPipeError), temporary.open("rb") as content, open(os.dup(number), "wb") as stream:
        shutil.copyfileobj(content, stream)


def _replace(temporary: Path, path: Path) -> None:
    """Rename; where a reader forbids it, wait for the reader."""
    for _ in range(0 if _HAS_FLOCK else _TRIES):
        with contextlib.suppress(PermissionError):
            temporary.replace(path)
            return
        time.sleep(_BETWEEN_TRIES)
    temporary.replace(path)


@contextlib.contextmanager
def exclusive(path: Path, *, in_place: bool = False) -> Iterator[Callable[[], None]]:
    """Be the only writer of an existing file or folder; the lock ends with the process, however that ends.

    Gives a check that nobody else changed the file (`in_place`: but this process), which `replacing` makes last.
    """
    name = os.path.realpath(path)
    if name in _HELD:
        raise HeldError(f"{path}: another fpcal is writing this file: wait until it has ended")
    with _locked(path, in_place=in_place) as require_same:
        _HELD[name] = require_same
        try:
            yield require_same
        finally:
            del _HELD[name]


@contextlib.contextmanager
def _locked(path: Path, *, shared: bool = False, in_place: bool = False) -> Iterator[Callable[[], None]]:
    """Hold a lock on a file; that of whoever only puts another in its place is `shared` by all who do."""
    with contextlib.ExitStack() as held:
        try:
            if _HAS_FLOCK:
                # As long as the file is open, no other one has its number. A pipe does not wait for its other end.
                handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
                held.callback(os.close, handle)
                before = os.fstat(handle)
            else:
                before = path.stat()
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({reason(error)})") from error

        def require_same() -> None:
            with contextlib.suppress(FileNotFoundError):
                now = path.stat()
                if os.path.samestat(before, now) and (in_place or shared or _version(before) == _version(now)):
                    return
            raise InputError(f"{path}: another program replaced or removed this file meanwhile: run the command again")

        try:
            if _HAS_FLOCK:
                fcntl.flock(handle, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
            else:
                held.enter_context(filelock.FileLock(path.with_name(f".{path.name}.lock"), timeout=0))
        except (BlockingIOError, TimeoutError) as error:
            raise HeldError(f"{path}: {_holder(before)}") from error
        except OSError:
            # Some shared drives have no locks; that the file is still the same is checked all the same.
            pass
        require_same()
        yield require_same


def _version(found: os.stat_result) -> tuple[int, int]:
    return found.st_mtime_ns, found.st_size


def require_quiet(path: Path) -> None:
    """Raise `InputError` if another program is writing a file, so that what stands there may be half of it."""
    if _HAS_FLOCK and os.path.realpath(path) not in _HELD:
        with _locked(path, shared=True):
            pass


def _holder(found: os.stat_result) -> str:
    """Who has locked a file, and what to do about it; Linux tells which program that is."""
    if not _HAS_FLOCK:
        return "another fpcal is writing this file: wait until it has ended"
    who = "another program"
    with contextlib.suppress(OSError, ValueError, IndexError, StopIteration):
        # A line: 1: FLOCK  ADVISORY  WRITE 1234 08:01:42 0 EOF
        lines = [line.split() for line in Path("/proc/locks").read_text().splitlines()]
        number = next(int(f[4]) for f in lines if f[1] == "FLOCK" and f[5].endswith(f":{found.st_ino}"))
        words = Path(f"/proc/{number}/cmdline").read_text(errors="replace").split("\0")
        if any(_OWN_WORDS.search(word) for word in words[1:]):
            return "another fpcal is writing this file: wait until it has ended"
        who = f"another program ({Path(words[0]).name}, process {number})"
    return f"{who} has this file open: close it there, or wait until it has ended"


def write_text(path: Path, text: str) -> None:
    """Write `text` as UTF-8 with Unix line ends, whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_bytes(text.encode())


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write `content` and its hash as JSON; NaN and infinity are refused, since JSON has neither."""
    write_text(path, _laid_out(content | {CONTENT_HASH: content_sha256(content)}) + "\n")


def _laid_out(value: Any, line: str = "\n") -> str:
    """A value as JSON, a line per entry, but lists of numbers on one; `line` ends a line and indents the next."""
    inner = f"{line} "
    if isinstance(value, dict) and value:
        entries = (f"{inner}{json.dumps(key)}: {_laid_out(each, inner)}" for key, each in value.items())
        return f"{{{','.join(entries)}{line}}}"
    if isinstance(value, list | tuple) and value:
        if all(issubclass(kind, int | float) and kind is not bool for kind in set(map(type, value))):
            return f"[ {json.dumps(value, allow_nan=False)[1:-1]} ]"
        return f"[{','.join(inner + _laid_out(each, inner) for each in value)}{line}]"
    return json.dumps(value, allow_nan=False)


def read_text(path: Path) -> str:
    """Read a UTF-8 text file; `InputError` if it is missing, a folder, empty, or not UTF-8 text."""
    require_readable(path)
    try:
        return path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = path.read_bytes()[: error.start].count(b"\n") + 1
        byte = error.object[error.start]
        raise InputError(f"{path}: row {line}: expected UTF-8 text, found byte 0x{byte:02x}") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({reason(error)})") from error


def require_suffix(path: Path | None, *suffixes: str) -> None:
    """Raise `InputError` where the name of a file, if there is one, says none of these formats."""
    if path is not None and path.suffix.lower() not in suffixes:
        ends = " or ".join(filter(None, (", ".join(suffixes[:-1]), suffixes[-1])))
        raise InputError(f"{path}: expected a file name that ends in {ends}")


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
