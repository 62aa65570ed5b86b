"""Workers of Dask: a cluster on this machine, or one that runs already."""

import contextlib
import logging
import tempfile
from collections.abc import Iterator
from typing import Any

from fpcal_bayes import __version__
from fpcal_bayes.errors import InputError

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

    Raises
    ------
    InputError
        If Dask is not installed, or nothing answers at the address.
    """
    try:
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
    for name in ("distributed", "distributed.nanny", "distributed.scheduler", "tornado.application"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    with contextlib.ExitStack() as open_until_end, dask.config.set(settings):
        if scheduler is None:
            folder = open_until_end.enter_context(tempfile.TemporaryDirectory(ignore_cleanup_errors=True))
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
