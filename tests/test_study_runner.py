"""Studies on workers that are processes of their own, one of which dies."""

import os
import signal
import sys

import pytest
from toy_study import ToyStudy

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import file_sha256
from fpcal_bayes.study import runner as cluster_module
from fpcal_bayes.study.runner import Progress, run_alone, run_on_cluster
from fpcal_bayes.study.store import StudyStore


@pytest.fixture(scope="module")
def address():
    """A scheduler with four workers."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=4, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=50
    ) as cluster:
        yield cluster.scheduler_address


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
class TestCluster:
    def test_a_killed_worker_loses_nothing(self, address, femto, tmp_path):
        import distributed

        study = ToyStudy(cell=femto, seconds=0.02)
        alone, store = (StudyStore(tmp_path / name, study) for name in ("alone.h5", "store.h5"))
        run_alone(ToyStudy(cell=femto), alone, 120)
        with distributed.Client(address) as client:
            processes = client.run(os.getpid)
        assert len(set(processes.values())) == 4
        killed, seen = [], []

        def kill(state: Progress) -> None:
            seen.append(state)
            if not killed:
                killed.append(next(iter(processes.values())))
                os.kill(killed[0], signal.SIGKILL)

        state = run_on_cluster(study, store, 120, workers=1, scheduler=address, progress=kill)
        assert killed
        assert (state.done, state.came) == (120, 120)
        assert [s.done for s in seen] == sorted(s.done for s in seen)
        assert seen[-1].seconds_left == 0.0
        assert file_sha256(store.path) == file_sha256(alone.path)
        # A second run has nothing left to do.
        assert run_on_cluster(study, store, 120, workers=1, scheduler=address).came == 0

    def test_a_replicate_that_kills_its_worker_once_is_given_out_again(self, address, femto, tmp_path):
        study = ToyStudy(cell=femto, deadly=(3, tmp_path / "died"))
        store = StudyStore(tmp_path / "store.h5", study)
        assert run_on_cluster(study, store, 6, workers=1, scheduler=address).came == 6
        assert (tmp_path / "died").exists()

    def test_a_failing_replicate_ends_the_study_and_the_others_stay(self, address, femto, tmp_path):
        store = StudyStore(tmp_path / "store.h5", ToyStudy(cell=femto))
        study = ToyStudy(cell=femto, failing=17)
        with pytest.raises(InputError, match=r"replicate.* 17.*ZeroDivisionError: one over nothing"):
            run_on_cluster(study, store, 18, workers=1, scheduler=address)
        assert store.done().sum() > 0
        assert not store.done()[17]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_no_scheduler_is_one_line(femto, tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(cluster_module, "CONNECT_SECONDS", 1)
    study = ToyStudy(cell=femto)
    with pytest.raises(InputError, match=r"--scheduler tcp://127.0.0.1:9: expected the address"):
        run_on_cluster(study, StudyStore(tmp_path / "s.h5", study), 3, workers=1, scheduler="tcp://127.0.0.1:9")


def test_without_dask_one_line_says_what_to_install(femto, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    study = ToyStudy(cell=femto)
    with pytest.raises(InputError, match=r"distributed is not installed: pip install 'fpcal-bayes\[cluster\]'"):
        run_on_cluster(study, StudyStore(tmp_path / "s.h5", study), 3, workers=1)


def test_time_left():
    assert Progress(10, 30, 5, 10.0, 2).seconds_left == 40.0
    assert Progress(10, 30, 0, 0.0, 2).seconds_left is None
