"""A photodiode behind a program of the user's: any that writes a trace file.

The program is started for each sweep with ``{trace}``, ``{seconds}``, ``{joint}``, ``{start}`` and ``{end}`` filled in.
It prints a line once it takes samples, writes the trace (CSV with the columns ``t_s,joint,irradiance_v``) when its
standard input is closed or the seconds are over, and ends with status 0.
"""

import select
import shlex
import subprocess
import time
from pathlib import Path

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.io.traces import read_trace
from fpcal_bayes.measure.traces import Trace
from fpcal_bayes.rig.clock import Halt
from fpcal_bayes.rig.drivers.interface import CommandLog, DeviceError


class PhotodiodeProgram:
    """A program that records the photodiode, started anew for each sweep."""

    def __init__(self, command: str, folder: Path, timeout_s: float, halt: Halt, log: CommandLog) -> None:
        self.name = "photodiode"
        self._words = shlex.split(command)
        self._folder = folder
        self._timeout_s = timeout_s
        self._halt = halt
        self._log = log
        self._process: subprocess.Popen[bytes] | None = None
        self._trace = folder / "none"
        self._count = 0
        if not any("{trace}" in word for word in self._words):
            raise InputError(f"record = {command!r:.60}: expected a command in which {{trace}} stands for its file")

    def start(self, seconds: float, joint: int, start: float, end: float) -> None:
        """Start the program and wait until it says that samples are taken; joint values as people read them."""
        self._count += 1
        self._trace = self._folder / f"{self._count:04d}.csv"
        self._trace.unlink(missing_ok=True)
        words = self._words
        filled = {"trace": str(self._trace), "seconds": f"{seconds:.6g}", "joint": f"q{joint + 1}"}
        for field, value in (filled | {"start": f"{start:.9g}", "end": f"{end:.9g}"}).items():
            words = [word.replace(f"{{{field}}}", value) for word in words]
        self._log.write(self.name, ">", shlex.join(words))
        try:
            self._process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        except OSError as error:
            raise self._error(f"cannot be started ({error.strerror})") from error
        out = self._process.stdout
        if out is None:
            raise self._error("has no output")
        ready, _, _ = select.select([out.fileno(), self._halt.fileno()], [], [], self._timeout_s)
        self._halt.check()
        if not ready or not out.readline().strip():
            raise self._error(f"printed no line within {self._timeout_s:g} s, expected one when samples are taken")

    def finish(self, scale: float) -> Trace:
        """Close the program's input, wait for its end, read its file; `scale` is um or rad per shown unit."""
        process = self._process
        if process is None or process.stdin is None:
            raise self._error("does not run")
        process.stdin.close()
        end = time.monotonic() + self._timeout_s
        while process.poll() is None:
            if time.monotonic() > end:
                raise self._error(f"did not end within {self._timeout_s:g} s of the end of its input")
            self._halt.wait(0.002)
        if process.returncode != 0:
            raise self._error(f"ended with status {process.returncode}")
        self._forget()
        try:
            trace = read_trace(self._trace, scale)
        except InputError as error:
            raise self._error(str(error).removeprefix(f"{self._trace}: ")) from error
        self._log.write(self.name, "<", f"{self._trace.name}: {len(trace)} samples")
        return trace

    def abandon(self) -> None:
        """End the program, unread."""
        if self._process is not None and self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        self._forget()

    def _forget(self) -> None:
        if self._process is not None:
            for pipe in (self._process.stdin, self._process.stdout):
                if pipe is not None:
                    pipe.close()
        self._process = None

    def _error(self, what: str) -> DeviceError:
        self.abandon()
        return DeviceError(self.name, "record", shlex.join(self._words), what)
