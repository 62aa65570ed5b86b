"""The ``fpcal`` program: which commands there are, and what every one of them does about errors."""

import argparse
import contextlib
import errno
import gc
import io
import os
import shlex
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from importlib import import_module
from keyword import iskeyword
from typing import Any, NoReturn

from fpcal_bayes.cli.arguments import COMMANDS, add_command
from fpcal_bayes.core.errors import InputError, reason
from fpcal_bayes.core.resources import command_file
from fpcal_bayes.core.version import __version__


class _Completion(argparse.Action):
    """Print a script that completes commands and options in a shell."""

    def __call__(self, parser: argparse.ArgumentParser, *parts: Any) -> NoReturn:
        print(_load("shtab").complete(parser, shell=parts[1]))
        parser.exit(0)


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, like every other error of the program."""

    def error(self, message: str) -> NoReturn:
        """Refuse the command line."""
        raise InputError(f"{message} (see {self.prog} --help)")


def make_parser(named: str | None = None) -> Parser:
    """Build the parser of all commands, or of the one `named`."""
    stated = command_file("fpcal")
    parser = Parser(
        prog="fpcal",
        description=stated["summary"],
        epilog=stated["help"],
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"fpcal {__version__}")
    parser.add_argument("--traceback", action="store_true", help="show where in the program an internal error arose")
    parser.add_argument(
        "--print-completion",
        action=_Completion,
        choices=("bash", "zsh", "tcsh"),
        help="print a script that completes commands and options in this shell",
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True, parser_class=Parser)
    for name in COMMANDS:
        # The other commands are known by their names alone.
        add_command(commands, name) if named is None or name == named else commands.add_parser(name)
    return parser


def _load(name: str) -> Any:
    """The only import that waits: what a command runs takes many times as long to import as the options of all."""
    # Modules live as long as the process: looking for garbage among their objects takes a fifth of the time.
    gc.disable()
    try:
        return import_module(name)
    finally:
        gc.enable()


class _Terminal:
    """A stream that shows any text in any encoding, and falls silent when its disk is full or its reader is gone."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream
        self.failure = ""
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write, or do nothing."""
        self._try(lambda: self._stream.write(text))
        return len(text)

    def flush(self) -> None:
        """Flush, or do nothing."""
        self._try(self._stream.flush)

    def _try(self, act: Callable[[], Any]) -> None:
        try:
            act()
        except OSError as error:
            if error.errno != errno.EPIPE:
                self.failure = self.failure or reason(error)
            # Else Python would write once more what is still to be written, and complain.
            os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())


@contextlib.contextmanager
def _guarded() -> Iterator[_Terminal]:
    """Output that never ends a command, and requests to end that do what Ctrl-C does; gives the standard output."""

    def interrupt(number: int, _: Any) -> NoReturn:
        raise SystemExit(128 + number)

    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            # A file opened next would take its place, and what is printed would end there.
            os.open(os.devnull, os.O_RDWR)
    out: Any = _Terminal(sys.stdout or io.StringIO())
    errors: Any = _Terminal(sys.stderr or io.StringIO())
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(errors), contextlib.ExitStack() as after:
        for stream in (out, errors):
            after.callback(stream.flush)
        for name in ("SIGTERM", "SIGHUP") if threading.current_thread() is threading.main_thread() else ():
            asked = getattr(signal, name, signal.SIGTERM)
            # Whoever started this may have asked that a signal does nothing.
            if signal.getsignal(asked) is signal.SIG_DFL:
                after.callback(signal.signal, asked, signal.signal(asked, interrupt))
        yield out


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command, by default the process's own `arguments`; the exit status, as the help of ``fpcal`` says."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    with _guarded() as out:
        try:
            try:
                status = _run(words, alone=arguments is None)
            except SystemError as error:
                # So a compiled kernel ends that was asked to end.
                raise error.__cause__ or error from None
        except (KeyboardInterrupt, SystemExit) as ended:
            status = 130 if isinstance(ended, KeyboardInterrupt) else int(ended.code or 0)
            if status < 128:
                raise
            print("fpcal: interrupted", file=sys.stderr)
        except InputError as error:
            print(f"fpcal: error: {error}", file=sys.stderr)
            status = 2
        except Exception as error:
            if words[:1] == ["--traceback"]:
                raise
            place = f"{error.filename}: " if isinstance(error, OSError) and error.filename else ""
            report = InputError(f"{place}{reason(error)}; to report it: fpcal --traceback {shlex.join(words)}")
            print(f"fpcal: error: {report}", file=sys.stderr)
            status = 2
        out.flush()
        if out.failure:
            print(f"fpcal: error: the standard output cannot be written ({out.failure})", file=sys.stderr)
            status = 2
    if arguments is None:
        # The process ends, and its memory with it: looking for garbage once more takes as long as all of numpy.
        gc.freeze()
    return status


def _run(words: list[str], *, alone: bool) -> int:
    for word in words:
        if any("\ud800" <= letter <= "\udfff" for letter in word):
            raise InputError(f"{word!a}: expected a name in {sys.getfilesystemencoding()}")
    options = make_parser(words[0] if words and words[0] in COMMANDS else None).parse_args(words)
    name = options.command.replace("-", "_")
    command = _load(f"fpcal_bayes.cli.{name}{'_' * iskeyword(name)}")
    if alone:
        gc.freeze()
        if not sys.warnoptions:
            # What a user can do about a result stands in the program's own warnings.
            warnings.simplefilter("ignore")
    common = _load("fpcal_bayes.cli.common")
    common.check_outputs(options)
    # A cell that is looked at may be one that all others refuse.
    status: int = command.run(options) if name == "cell" else command.run(options, common.cell_of(options))
    return status
