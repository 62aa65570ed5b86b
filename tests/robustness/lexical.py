"""Lexical faults: what an editor, another program or a bad disk makes of a file, whatever the file means."""

import re
from collections.abc import Callable

import numpy as np

Random = np.random.Generator

#: In place of a field, a value or a name.
TOKENS = (
    "", " ", "nan", "NaN", "inf", "-inf", "1e999", "-1e999", "1e308", "1e-320", "1_000", "0x10", "1,5", "1.2.3", "--1",
    "+", "-", ".", "e5", "1e", "9" * 400, "0." + "0" * 400 + "1", "-0", "true", "null", "None", "[]", "{}", "[[1]]",
    '"', "'", '""', "a" * 5000, "é", "\uff11\uff12", "\u202e1", "\ufeff", "\u2028", "\x00", "\x1b[2J", "=1+1", "%s%n",
    "../../x",     "1;2", "1\t2", "-9223372036854775809", "18446744073709551616", "1e400", "[bold]", "<script>",
)  # fmt: skip
#: Encodings in which other programs save text.
ENCODINGS = ("utf-16", "utf-16-le", "utf-32", "latin-1", "utf-8-sig", "cp1252")
_TOKEN = re.compile(rb"[-+.\w]+")


def _spot(content: bytes, random: Random) -> int:
    return int(random.integers(len(content) + 1))


def flipped(content: bytes, random: Random) -> bytes:
    """A few bits are others."""
    found = bytearray(content)
    for _ in range(int(random.integers(1, 5))):
        found[_spot(content, random) % len(found)] ^= 1 << int(random.integers(8))
    return bytes(found)


def overwritten(content: bytes, random: Random) -> bytes:
    """A block of bytes is zero, or noise."""
    at, size = _spot(content, random), int(random.integers(1, 600))
    noise = bytes(size) if random.random() < 0.5 else random.bytes(size)
    return content[:at] + noise + content[at + size :]


def inserted(content: bytes, random: Random) -> bytes:
    """A token stands where none was."""
    at = _spot(content, random)
    return content[:at] + TOKENS[random.integers(len(TOKENS))].encode() + content[at:]


def replaced(content: bytes, random: Random) -> bytes:
    """Another token stands in the place of one."""
    found = list(_TOKEN.finditer(content))
    if not found:
        return inserted(content, random)
    one = found[random.integers(len(found))]
    return content[: one.start()] + TOKENS[random.integers(len(TOKENS))].encode() + content[one.end() :]


def exchanged(content: bytes, random: Random) -> bytes:
    """Two tokens have changed places."""
    found = list(_TOKEN.finditer(content))
    if len(found) < 2:
        return inserted(content, random)
    a, b = sorted(random.choice(len(found), 2, replace=False).tolist())
    one, two = found[a], found[b]
    return content[: one.start()] + two[0] + content[one.end() : two.start()] + one[0] + content[two.end() :]


def lines(content: bytes, random: Random) -> bytes:
    """A line is missing, there twice, joined with the next, cut in two, or moved."""
    found = content.split(b"\n")
    at, kind = int(random.integers(len(found))), int(random.integers(5))
    if kind == 0:
        del found[at]
    elif kind == 1:
        found.insert(at, found[at])
    elif kind == 2 and at + 1 < len(found):
        found[at : at + 2] = [found[at] + found[at + 1]]
    elif kind == 3:
        cut = int(random.integers(len(found[at]) + 1))
        found[at : at + 1] = [found[at][:cut], found[at][cut:]]
    else:
        found.insert(int(random.integers(len(found))), found.pop(at))
    return b"\n".join(found)


def punctuated(content: bytes, random: Random) -> bytes:
    """Marks of one kind are others: decimal commas, semicolons, tabs, quotes, brackets, line ends."""
    pairs = (
        (b",", b";"), (b",", b"\t"), (b".", b","), (b"\n", b"\r"), (b"\n", b"\r\n"), (b"\n", b"\n\n"), (b'"', b"'"),
        (b"[", b"("), (b"{", b""), (b"=", b":"), (b":", b"="), (b"-", b"\xe2\x88\x92"), (b",", b",,"), (b"}", b""),
    )  # fmt: skip
    old, new = pairs[random.integers(len(pairs))]
    return content.replace(old, new, -1 if random.random() < 0.5 else 1)


def encoded(content: bytes, random: Random) -> bytes:
    """Text in another encoding."""
    text = content.decode("utf-8", errors="replace")
    return text.encode(ENCODINGS[random.integers(len(ENCODINGS))], errors="replace")


def repeated(content: bytes, random: Random) -> bytes:
    """A piece of the file is there twice, or nested deeply."""
    a, b = sorted((_spot(content, random), _spot(content, random)))
    if random.random() < 0.2:
        return content[:a] + b"[" * 100_000 + content[a:]
    return content[:b] + content[a:b] + content[b:]


#: Faults of text; those of bytes also strike files that hold none.
OF_BYTES: tuple[Callable[[bytes, Random], bytes], ...] = (flipped, overwritten, inserted, repeated)
OF_TEXT = (*OF_BYTES, replaced, replaced, replaced, exchanged, lines, punctuated, encoded)


def faulty(content: bytes, random: Random, *, text: bool) -> tuple[str, bytes]:
    """Name of a fault, and the content with it."""
    kinds = OF_TEXT if text else OF_BYTES
    fault = kinds[random.integers(len(kinds))]
    return fault.__name__, fault(content, random)
