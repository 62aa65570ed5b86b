"""Runs the replicates of a study that are missing in its store, on the workers of a cluster."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np

from fpcal_bayes import __version__
from fpcal_bayes.errors import InputError
from fpcal_bayes.study.base import Study
from fpcal_bayes.study.cluster import connected
from fpcal_bayes.study.store import StudyStore, packed

#: Tasks of each worker that are handed out at most: enough that it never waits, few enough that the size of the later
#: ones follows from how long the first ones took.
TASKS_OF_WORKER = 4
#: Time of a task in s that is aimed at, as far as one can tell from the first: handing one out takes some milliseconds.
TASK_SECONDS = 1.0
#: Replicates of a task at most; they are lost with their worker.
MOST_IN_TASK = 64
#: Seconds between two looks at which workers are there.
_BETWEEN_LOOKS = 2.0
#: How often a replicate is given out again whose workers died.
_NEW_TRIES = 2


@dataclass(frozen=True)
class Progress:
    """How far a study is.

    Attributes
    ----------
    done, replicates
        How many are in the store, and how many are wanted.
    came
        How many of them this run has brought.
    seconds
        Since the first worker stood ready.
    workers
        That are there now.
    """

    done: int
    replicates: int
    came: int
    seconds: float
    workers: int

    @property
    def seconds_left(self) -> float | None:
        """At the speed so far, or None before the first replicate."""
        return None if self.came == 0 else self.seconds / self.came * (self.replicates - self.done)


def run_alone(study: Study, store: StudyStore, replicates: int) -> None:
    """Run the missing replicates one after the other in this process."""
    with store.appending(replicates) as appender:
        for number in np.flatnonzero(~store.done()[:replicates]).tolist():
            appender.put(number, packed(study, study.replicate(number)))


def run_on_cluster(
    study: Study,
    store: StudyStore,
    replicates: int,
    *,
    workers: int,
    scheduler: str | None = None,
    anew: bool = False,
    progress: Callable[[Progress], None] = lambda _: None,
) -> Progress:
    """Run the missing replicates on a cluster of Dask; each is in the store as soon as it comes.

    Parameters
    ----------
    replicates
        How many are wanted in all.
    workers
        Processes of the cluster on this machine.
    scheduler
        Address of a cluster that runs already, in place of one on this machine.
    anew
        Forget what the store holds.
    progress
        Called with what has come, after each task.

    Raises
    ------
    InputError
        If Dask is not installed or the cluster cannot be reached; if the store is another one; if a replicate fails.
    """
    with store.appending(replicates, anew=anew) as appender:
        missing = np.flatnonzero(~store.done()[:replicates]).tolist()
        state = Progress(replicates - len(missing), replicates, 0, 0.0, 0)
        if not missing:
            return state
        with connected(scheduler, workers) as client:
            began, came = time.monotonic(), 0
            n_workers, looked = 0, -np.inf
            for numbers, rows in _collected(client, study, missing):
                for number, row in zip(numbers, rows, strict=True):
                    appender.put(number, row)
                came += len(numbers)
                seconds = time.monotonic() - began
                if seconds - looked > _BETWEEN_LOOKS:
                    n_workers, looked = len(client.nthreads()), seconds
                state = Progress(replicates - len(missing) + came, replicates, came, seconds, n_workers)
                progress(state)
    return state


def replicates_of(study: Study, numbers: list[int], version: str) -> tuple[list[bytes], float]:
    """Some replicates as rows, run by a worker, and the seconds that they took."""
    from threadpoolctl import threadpool_limits

    if version != __version__:
        raise InputError(f"a worker has fpcal_bayes {__version__}, expected {version}")
    began = time.monotonic()
    with threadpool_limits(1):
        rows = [packed(study, study.replicate(number)) for number in numbers]
    return rows, time.monotonic() - began


def _collected(client: Any, study: Study, missing: list[int]) -> Iterator[tuple[list[int], list[bytes]]]:
    """Numbers and rows of tasks as they end; as many replicates a task as make it worth handing out."""
    import distributed

    left, given, size = iter(missing), {}, 1

    def hand_out(numbers: list[int], tries: int) -> Any:
        # A new key each time: Dask must not take an earlier failure for the result.
        key = f"{study.name}-{numbers[0]}-{tries}-{time.monotonic_ns()}"
        future = client.submit(replicates_of, study, numbers, __version__, key=key, pure=False)
        given[future.key] = numbers, tries
        return future

    n_workers, looked = max(1, len(client.nthreads())), time.monotonic()
    first = [hand_out([number], 0) for number in islice(left, 2 * n_workers)]
    ending = distributed.as_completed(first)
    for future in ending:
        numbers, tries = given.pop(future.key)
        if future.status == "finished":
            rows, seconds = future.result()
            size = max(size, min(MOST_IN_TASK, int(TASK_SECONDS * len(numbers) / max(seconds, 1e-6))))
            yield numbers, rows
        else:
            ending.add(hand_out(numbers, _next_try(client, future, numbers, tries)))
        if time.monotonic() - looked > _BETWEEN_LOOKS:
            n_workers, looked = max(1, len(client.nthreads())), time.monotonic()
        while len(given) < TASKS_OF_WORKER * n_workers and (more := list(islice(left, size))):
            ending.add(hand_out(more, 0))


def _next_try(client: Any, future: Any, numbers: list[int], tries: int) -> int:
    """Number of the next try of a task that failed; `InputError` if there is none."""
    import distributed

    where = f"replicate {numbers[0]}" if len(numbers) == 1 else f"replicates {numbers[0]} to {numbers[-1]}"
    if future.status == "error":
        error = future.exception()
        if not isinstance(error, distributed.scheduler.KilledWorker):
            raise InputError(f"{where}: {type(error).__name__}: {error}") from error
    # A task that dies with its worker may also end as cancelled; so do all tasks when the scheduler is gone.
    if future.status == "error" or client.status == "running":
        if tries == _NEW_TRIES:
            raise InputError(f"{where}: every worker that took it died; it may need more memory than a worker has")
        return tries + 1
    raise InputError(f"{where}: the connection to the scheduler was lost; run again to go on where the study stopped")
