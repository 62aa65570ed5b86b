"""Runs the replicates of a study that are missing in its store, on the workers of a cluster."""

import contextlib
import logging
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.version import __version__
from fpcal_bayes.study.base import Study
from fpcal_bayes.study.store import StudyStore, packed

#: A worker that dies takes a replicate with it; this many deaths are a worker's fault, more are the replicate's.
ALLOWED_DEATHS = 10
#: How long a scheduler may take to answer, and to show its first worker, in s.
CONNECT_SECONDS = 15
WORKER_SECONDS = 60

#: Each replicate has one core: libraries that start threads of their own are held to one.
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), 1)
#: Arrays of some megabytes come and go by the hundred: glibc keeps their memory, in place of clearing pages anew.
#: More than 2**25 bytes it does not take.
_KEEP_MEMORY = dict.fromkeys(("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_", "MALLOC_TOP_PAD_"), 2**25)

#: What Dask would watch many times a second, on the cores that the replicates need.
_UNWATCHED = (
    "distributed.worker.profile.enabled",
    *(f"distributed.worker.memory.{limit}" for limit in ("target", "spill", "pause", "terminate")),
)


@contextlib.contextmanager
def connected(scheduler: str | None, workers: int) -> Iterator[Any]:
    """A client of the cluster at `scheduler`, or of a new one of `workers` processes on this machine.

    Dask hands functions and values on as pickles: give the address of a cluster that you trust only.
    """
    try:
        # An optional extra, which only studies need.
        import dask
        import distributed
    except ImportError as error:
        raise InputError(
            f"studies run on Dask, of which {error.name} is not installed: pip install 'fpcal-bayes[cluster]'"
        ) from error

    settings = {
        "distributed.nanny.pre-spawn-environ": _ONE_THREAD | _KEEP_MEMORY,
        "distributed.scheduler.allowed-failures": ALLOWED_DEATHS,
        **dict.fromkeys(_UNWATCHED, False),
        "distributed.admin.system-monitor.interval": "10s",
        # A worker that dies is known by its connection; by the clock it would die when the clock is set.
        "distributed.scheduler.worker-ttl": None,
    }
    # Workers that come and go are news to Dask; here they are expected.
    for name in ("distributed", "distributed.nanny", "distributed.scheduler", "tornado.application", "asyncio"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    with contextlib.ExitStack() as open_until_end:
        folder = open_until_end.enter_context(tempfile.TemporaryDirectory(ignore_cleanup_errors=True))
        open_until_end.enter_context(dask.config.set({**settings, "temporary-directory": folder}))
        if scheduler is None:
            address = open_until_end.enter_context(
                distributed.LocalCluster(
                    n_workers=workers,
                    threads_per_worker=1,
                    processes=True,
                    # No dashboard; the address keeps the server of its port apart from those of other studies.
                    dashboard_address="127.0.0.1:0",
                    scheduler_kwargs={"dashboard": False},
                    silence_logs=logging.CRITICAL,
                    local_directory=folder,
                )
            )
        else:
            address = scheduler
        try:
            client = open_until_end.enter_context(distributed.Client(address, timeout=CONNECT_SECONDS))
        except (OSError, ValueError, TypeError) as error:
            raise InputError(f"--scheduler {scheduler}: expected the address of a Dask scheduler ({error})") from error
        _check_workers(client, scheduler)
        yield client


def _check_workers(client: Any, scheduler: str | None) -> None:
    """Wait for a worker, and refuse workers with another version of this program."""
    # An optional extra, which only studies need.
    import distributed

    try:
        client.wait_for_workers(1, timeout=WORKER_SECONDS)
        versions = client.run(_version, on_error="return")
    except (TimeoutError, distributed.client.TimeoutError) as error:
        raise InputError(f"--scheduler {scheduler}: no worker within {WORKER_SECONDS} s") from error
    for worker, version in versions.items():
        if version != __version__:
            found = version if isinstance(version, str) else f"none ({version})"
            raise InputError(f"worker {worker}: expected fpcal_bayes {__version__}, found {found}")


def _version() -> str:
    return __version__


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
    """How far a study is."""

    # done, replicates: how many are in the store, and how many are wanted
    done: int
    replicates: int
    came: int  # how many of them this run has brought
    seconds: float  # since the first worker stood ready
    workers: int  # that are there now

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

    `replicates` are wanted in all. The cluster has `workers` processes on this machine, unless `scheduler` is the
    address of one that runs already. `anew` forgets what the store holds; `progress` is called after each task.
    `InputError` if Dask is not installed or the cluster cannot be reached, if the store is another one, or if a
    replicate fails.
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
    # An optional extra, which only studies need.
    from threadpoolctl import threadpool_limits

    if version != __version__:
        raise InputError(f"a worker has fpcal_bayes {__version__}, expected {version}")
    began = time.monotonic()
    with threadpool_limits(1):
        rows = [packed(study, study.replicate(number)) for number in numbers]
    return rows, time.monotonic() - began


def _collected(client: Any, study: Study, missing: list[int]) -> Iterator[tuple[list[int], list[bytes]]]:
    """Numbers and rows of tasks as they end; as many replicates a task as make it worth handing out."""
    # An optional extra, which only studies need.
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
    # An optional extra, which only studies need.
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
