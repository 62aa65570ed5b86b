"""Files appear whole or not at all."""

import errno
import hashlib
import json
import os
import stat
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from fpcal_bayes.core import files
from fpcal_bayes.core.errors import InputError


def test_content_is_what_was_written(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    files.write_text(path, "L = 920 µm\n")
    assert path.read_bytes() == "L = 920 µm\n".encode()
    assert files.read_text(path) == "L = 920 µm\n"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_reader_never_sees_half_a_file(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    contents = {letter * 300_000 for letter in "ab"}
    path.write_text("a" * 300_000)
    seen, done = set(), threading.Event()

    def read() -> None:
        while not done.is_set():
            seen.add(path.read_text())

    reader = threading.Thread(target=read)
    reader.start()
    for turn in range(60):
        files.write_text(path, "ab"[turn % 2] * 300_000)
    done.set()
    reader.join()
    assert seen
    assert seen <= contents


def test_old_file_stands_until_the_block_ends(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")
    with files.replacing(path) as temporary:
        temporary.write_text("new")
        assert path.read_text() == "old"
        assert temporary.parent == tmp_path
        assert temporary.name.startswith(".")
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("error", [RuntimeError("stop"), KeyboardInterrupt()])
def test_failure_leaves_the_old_file_and_no_temporary(tmp_path: Path, error: BaseException) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")

    def fail() -> None:
        with files.replacing(path) as temporary:
            temporary.write_text("half")
            raise error

    with pytest.raises(type(error)):
        fail()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_full_disk_is_an_input_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    path = tmp_path / "a.txt"
    path.write_text("old")
    monkeypatch.setattr(os, "fsync", refuse)
    with pytest.raises(InputError, match=r"a\.txt: cannot be written \(No space left on device\)"):
        files.write_text(path, "new")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_permissions_are_those_of_a_plain_file(tmp_path: Path) -> None:
    plain, ours = tmp_path / "plain", tmp_path / "ours"
    plain.write_text("x")
    files.write_text(ours, "x")
    assert stat.S_IMODE(ours.stat().st_mode) == stat.S_IMODE(plain.stat().st_mode)


@pytest.mark.parametrize("write", [lambda p: files.write_text(p, "x"), files.require_writable])
def test_missing_folder(tmp_path: Path, write: Callable[[Path], None]) -> None:
    with pytest.raises(InputError, match="does not exist"):
        write(tmp_path / "missing" / "a.txt")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("write", [lambda p: files.write_text(p, "x"), files.require_writable])
def test_target_is_a_folder(tmp_path: Path, write: Callable[[Path], None]) -> None:
    with pytest.raises(InputError, match="is a folder"):
        write(tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("write", [lambda p: files.write_text(p, "x"), files.require_writable])
def test_folder_of_the_target_is_a_file(tmp_path: Path, write: Callable[[Path], None]) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="does not exist"):
        write(tmp_path / "file" / "a.txt")


def test_folder_without_permission(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    # The refusal itself is made up: root may write everywhere.
    monkeypatch.setattr(os, "open", refuse)
    with pytest.raises(InputError, match=r"not writable \(Permission denied\)"):
        files.require_writable(tmp_path / "a.txt")


def test_require_writable_leaves_an_old_file_alone(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")
    files.require_writable(path)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_reading_what_cannot_be_read(tmp_path: Path) -> None:
    empty, binary = tmp_path / "empty", tmp_path / "binary"
    empty.write_bytes(b"")
    binary.write_bytes(b"one\ntwo \xff\n")
    for path, message in [
        (tmp_path / "missing", "no such file"),
        (tmp_path, "is a folder"),
        (empty, "is empty"),
        (binary, "row 2: expected UTF-8 text, found byte 0xff"),
        (tmp_path / ("x" * 5000), "cannot be read"),
        (empty / "below", "no such file"),
    ]:
        with pytest.raises(InputError, match=message) as caught:
            files.read_text(path)
        assert str(path) in str(caught.value)


def test_byte_order_mark_is_not_content(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_bytes(b"\xef\xbb\xbfname")
    assert files.read_text(path) == "name"


def test_json(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    files.write_json(path, {"a": [1.5, None]})
    written = {"a": [1.5, None], "content_sha256": files.content_sha256({"a": [1.5, None]})}
    assert json.loads(path.read_text()) == written
    with pytest.raises(ValueError, match="JSON"):
        files.write_json(path, {"a": float("nan")})
    assert json.loads(path.read_text()) == written


def test_hashes(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"content")
    assert files.file_sha256(path) == hashlib.sha256(b"content").hexdigest()
    assert files.content_sha256({"a": 1, "b": 2}) == files.content_sha256({"b": 2, "a": 1})
    assert files.content_sha256({"a": 1}) != files.content_sha256({"a": 2})
    with pytest.raises(ValueError, match="JSON"):
        files.content_sha256({"a": float("inf")})
