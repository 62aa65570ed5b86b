"""Runs the replicates of a study that its file lacks, and keeps each as soon as it is there.

The file has a line of JSON that says what the study is, and a line for each replicate. A line that a kill cut short
counts as missing. At the end the lines stand in the order of their numbers: the file depends neither on the order in
which replicates came nor on how often the study was stopped.
"""

import contextlib
import json
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor, as_completed
from multiprocessing import active_children, get_context, parent_process
from pathlib import Path

import numpy as np

from fpcal_bayes.core.errors import InputError, reason
from fpcal_bayes.core.files import exclusive, read_text, require_writable, write_text
from fpcal_bayes.core.version import __version__
from fpcal_bayes.study.base import Results, Study

#: More replicates are refused: such numbers are mistyped more often than meant.
MOST = 1_000_000


def run_study(
    study: Study,
    path: Path,
    replicates: int,
    *,
    workers: int,
    anew: bool = False,
    progress: Callable[[int], None] = lambda done: None,
) -> tuple[Results, int]:
    """All of the first `replicates`, in the order of their numbers, and how many of them were not in the file.

    Those are run by so many processes, or by this one if `workers` is 0; `progress` is told how many are there.
    `InputError` if the file is of another study, or a replicate fails; what came before it stays in the file.
    """
    if replicates > MOST:
        raise InputError(f"{replicates} replicates: expected at most {MOST}")
    require_writable(path)
    head = _head(study)
    if anew or not path.exists():
        write_text(path, head)
    with exclusive(path, in_place=True):
        lines, length = _known(path, study)
        missing = [number for number in range(replicates) if number not in lines]
        if missing:
            try:
                os.truncate(path, length)
                with path.open("ab", buffering=0) as file:
                    for came, (number, line) in enumerate(_run(study, missing, workers), start=1):
                        file.write(line.encode())
                        lines[number] = line
                        progress(replicates - len(missing) + came)
                    os.fsync(file.fileno())
            except OSError as error:
                raise InputError(f"{path}: cannot be written ({reason(error)})") from error
            write_text(path, head + "".join(lines[number] for number in sorted(lines)))
    rows = [json.loads(lines[number])["values"] for number in range(replicates)]
    return {name: np.array([row[name] for row in rows], float) for name in study.shapes()}, len(missing)


def _run(study: Study, missing: list[int], workers: int) -> Iterator[tuple[int, str]]:
    """Numbers and lines of replicates as they end."""
    if workers == 0:
        yield from ((number, _line(study, number)) for number in missing)
        return
    # Processes that are forked would hold the locks of libraries that have threads.
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_begin_worker) as pool:
        given = {pool.submit(_line, study, number): number for number in missing}
        try:
            for future in as_completed(given):
                yield given.pop(future), future.result()
        except BrokenExecutor as error:
            raise InputError(
                "a worker died; it may need more memory than there is: run again, with fewer --workers, to go on"
            ) from error
        finally:
            if given:
                pool.shutdown(wait=False, cancel_futures=True)
                for process in active_children():
                    process.terminate()


def _begin_worker() -> None:
    """Leave Ctrl-C to the process that gives out the work, and end with it, however that ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()

    def wait() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def _line(study: Study, number: int) -> str:
    """One replicate as a line of the file, in which null stands for NaN."""
    try:
        values = study.replicate(number)
    except Exception as error:
        raise InputError(f"replicate {number}: {type(error).__name__}: {error}") from error
    # In place of NaN, which JSON does not know, stands null, an object among floats.
    numbers = {
        name: np.where(np.isnan(value), np.array(None), value.astype(object)).tolist() for name, value in values.items()
    }
    return json.dumps({"replicate": number, "values": numbers}, allow_nan=False) + "\n"


def _head(study: Study) -> str:
    """The first line of the file: all that the replicates depend on."""
    identity = {
        "study": study.name,
        "cell_name": study.cell.name,
        "cell_sha256": study.cell.sha256,
        "settings": study.settings() | {"seed": study.seed},
        "program_version": __version__,
    }
    return json.dumps({"schema": "fpcal-study/2"} | identity) + "\n"


def _known(path: Path, study: Study) -> tuple[dict[int, str], int]:
    """Lines of the replicates in a file by their numbers, and the length in bytes of the lines that are whole."""
    text = read_text(path)
    head, *lines = text[: text.rfind("\n") + 1].splitlines(keepends=True) or [""]
    if head != _head(study):
        raise _differs(path, head, study)
    known = {}
    for row, line in enumerate(lines, start=2):
        with contextlib.suppress(ValueError, KeyError, TypeError, RecursionError):
            found = json.loads(line)
            number, values = found["replicate"], found["values"]
            if isinstance(number, int) and all(
                np.array(values[name], float).shape == shape for name, shape in study.shapes().items()
            ):
                known[number] = line
                continue
        raise InputError(f"{path}: row {row}: expected a replicate of the study; --anew replaces the file")
    return known, len("".join([head, *lines]).encode())


def _differs(path: Path, head: str, study: Study) -> InputError:
    """What a file holds in place of the study."""
    try:
        found, own = json.loads(head), json.loads(_head(study))
        name = next(name for name in own if found[name] != own[name])
    except (ValueError, KeyError, TypeError, RecursionError, StopIteration):
        return InputError(f"{path}: row 1: expected what fpcal study writes; give another name with -o")
    return InputError(
        f"{path}: holds replicates of {name} {found[name]!r:.300}, expected {own[name]!r:.300}; "
        "give another name with -o, or --anew to replace it"
    )
