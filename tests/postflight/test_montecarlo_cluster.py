"""The same bytes from a Dask cluster of three worker processes, also when one of them is killed."""

import os
import signal

import pytest

from flightmodel.checks import ConfigError
from postflight.montecarlo import execution, running
from postflight.montecarlo.chunks import chunk_from_rows
from postflight.montecarlo.merge import merge, write_merged
from postflight.montecarlo.running import Wanted
from postflight.montecarlo.study import read_study

from .short_flights import write_short
from .test_montecarlo import content, fly, quiet

distributed = pytest.importorskip("distributed", reason="Dask distributed is not installed: postflight[cluster]")
FLIGHTS = 96


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return write_short(tmp_path_factory.mktemp("study"))


@pytest.fixture(scope="module")
def reference(path, tmp_path_factory):
    folder = tmp_path_factory.mktemp("reference") / "study"
    fly(path, folder, flights=FLIGHTS)
    return content(folder)


@pytest.fixture(scope="module")
def cluster():
    with distributed.LocalCluster(n_workers=3, threads_per_worker=1, processes=True, dashboard_address=None) as found:
        yield found


@pytest.mark.slow
def test_three_workers_make_the_same_bytes(reference, path, cluster, tmp_path):
    fly(path, tmp_path / "study", flights=FLIGHTS, scheduler=cluster.scheduler_address)
    assert content(tmp_path / "study") == reference


@pytest.mark.slow
def test_a_killed_worker_costs_its_chunk_only(reference, path, cluster, tmp_path, monkeypatch):
    study, folder, come = read_study(str(path)), tmp_path / "study", []

    def killing(*arguments):
        for number, chunk in execution.fly_jobs(*arguments):
            come.append(number)
            if len(come) == 3:
                with distributed.Client(cluster.scheduler_address, set_as_default=False) as client:
                    os.kill(min(client.run(os.getpid).values()), signal.SIGKILL)
            yield number, chunk

    monkeypatch.setattr(running, "fly_jobs", killing)
    count = running.run(study, folder, Wanted(FLIGHTS, scheduler=cluster.scheduler_address), quiet)
    write_merged(folder, merge(study, folder, count))
    assert content(folder) == reference
    # every chunk came once: what the dead worker had was flown again by others, the rest was not
    assert sorted(come) == list(range(study.chunks(FLIGHTS)))


def test_a_scheduler_that_is_not_there_is_a_message(path, tmp_path, monkeypatch):
    monkeypatch.setattr(execution, "CONNECT_S", 0.3)
    with pytest.raises(ConfigError, match="no scheduler answers there"):
        fly(path, tmp_path / "study", flights=8, scheduler="tcp://127.0.0.1:9")


def test_a_chunk_can_travel(path):
    """What is sent to workers and back survives its pickling."""
    import pickle

    study = pickle.loads(pickle.dumps(read_study(str(path))))
    _, chunk = pickle.loads(pickle.dumps(execution.fly_chunk(study, (0, [0, 1]))))
    again = chunk_from_rows(execution.fly_runs(study.plan, [0, 1], study.draws_of), study.plan.scalars)
    assert chunk.scalars.tobytes() == again.scalars.tobytes()
