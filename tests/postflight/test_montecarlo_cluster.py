"""The same bytes from a Dask cluster of three worker processes, also when one of them is killed."""

import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest

from flightmodel.checks import ConfigError
from postflight.montecarlo import execution
from postflight.montecarlo.bands import chunk_from_rows, merge, write_merged
from postflight.montecarlo.execution import Wanted
from postflight.montecarlo.study import read_study
from tests.documents import ROOT
from tests.refusing import printed_codes

from .short_flights import content, fly, quiet

distributed = pytest.importorskip("distributed", reason="Dask distributed is not installed: postflight[cluster]")
FLIGHTS = 96  # of the reference, too


@pytest.fixture(scope="module")
def cluster():
    with distributed.LocalCluster(n_workers=3, threads_per_worker=1, processes=True, dashboard_address=None) as found:
        yield found


@pytest.mark.slow
def test_three_workers_make_the_same_bytes(reference, study_path, cluster, tmp_path):
    fly(study_path, tmp_path / "study", flights=FLIGHTS, scheduler=cluster.scheduler_address)
    assert content(tmp_path / "study") == reference


@pytest.mark.slow
def test_a_killed_worker_costs_its_chunk_only(reference, study_path, cluster, tmp_path, monkeypatch):
    study, folder, come = read_study(str(study_path)), tmp_path / "study", []
    fly_jobs = execution.fly_jobs

    def killing(*arguments):
        for number, chunk in fly_jobs(*arguments):
            come.append(number)
            if len(come) == 3:
                with distributed.Client(cluster.scheduler_address, set_as_default=False) as client:
                    os.kill(min(client.run(os.getpid).values()), signal.SIGKILL)
            yield number, chunk

    monkeypatch.setattr(execution, "fly_jobs", killing)
    count = execution.run(study, folder, Wanted(FLIGHTS, scheduler=cluster.scheduler_address), quiet)
    write_merged(folder, merge(study, folder, count))
    assert content(folder) == reference
    # every chunk came once: what the dead worker had was flown again by others, the rest was not
    assert sorted(come) == list(range(study.chunks(FLIGHTS)))


def test_a_scheduler_that_is_not_there_is_a_message(study_path, tmp_path, monkeypatch):
    monkeypatch.setattr(execution, "CONNECT_S", 0.3)
    with pytest.raises(ConfigError) as refusal:
        fly(study_path, tmp_path / "study", flights=8, scheduler="tcp://127.0.0.1:9")
    assert refusal.value.codes == ("scheduler-unreachable",)


def test_a_chunk_can_travel(study_path):
    """What is sent to workers and back survives its pickling."""
    import pickle

    study = pickle.loads(pickle.dumps(read_study(str(study_path))))
    _, chunk = pickle.loads(pickle.dumps(execution.fly_chunk(study, (0, [0, 1]))))
    again = chunk_from_rows(execution.fly_runs(study.plan, [0, 1], study.draws_of), study.plan.scalars)
    assert chunk.scalars.tobytes() == again.scalars.tobytes()


# a queue that has room: what is submitted is copied and runs at once, in a session of its own
SUBMIT = """#!/bin/sh
for script; do :; done
cp "$script" {folder}/job.sh
setsid bash {folder}/job.sh >/dev/null 2>&1 &
echo "{answer}"
echo $! > {folder}/job
"""
CANCEL = """#!/bin/sh
kill -- -$(cat {folder}/job)
"""
QUEUES = {"PBS": ("qsub", "qdel", "17.queue"), "SLURM": ("sbatch", "scancel", "Submitted batch job 17")}


@pytest.mark.long
@pytest.mark.parametrize("kind", QUEUES)
def test_the_example_for_a_queue_runs(kind: str, tmp_path: Path) -> None:
    """examples/montecarlo_pbs.py with fewer workers and flights, under a queue's own commands."""
    pytest.importorskip("dask_jobqueue", reason="dask-jobqueue is not installed: postflight[cluster]")
    script = (ROOT / "examples" / "montecarlo_pbs.py").read_text()
    if kind == "SLURM":
        slurm = re.search(r"# Slurm: (SLURMCluster\(.*\))\n", script)[1]
        script = re.sub(r"PBSCluster\(.*?\n    \)\n", f"{slurm}\n", script, flags=re.DOTALL)
        script = script.replace("import PBSCluster", "import SLURMCluster")
    for many, few in (
        ("cores=32", "cores=2"),
        ("processes=32", "processes=2"),
        ("32GB", "4GB"),
        ("jobs=8", "jobs=1"),
        ("1000000", "192"),
    ):
        assert many in script
        script = script.replace(many, few)
    (tmp_path / "script.py").write_text(script)
    submit, cancel, answer = QUEUES[kind]
    for name, text in ((submit, SUBMIT), (cancel, CANCEL)):
        (tmp_path / "bin").mkdir(exist_ok=True)
        (tmp_path / "bin" / name).write_text(text.format(answer=answer, folder=tmp_path))
        (tmp_path / "bin" / name).chmod(0o755)
    path = os.pathsep.join([str(tmp_path / "bin"), str(Path(sys.executable).parent), os.environ["PATH"]])
    done = subprocess.run(
        [sys.executable, "script.py"],
        cwd=tmp_path,
        env={**os.environ, "PATH": path},
        timeout=300,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "job").exists()
    flown = pd.read_csv(tmp_path / "study" / "flights.csv")
    assert len(flown) == 192
    assert flown.reason.isna().all()


@pytest.mark.parametrize(
    ("address", "is_open"),
    [("tcp://127.0.0.1:8786", False), ("tcp://localhost:8786", False), ("tls://node7:8786", False),
     ("tcp://[::1]:8786", False), ("tcp://node7:8786", True), ("node7:8786", True), ("tcp://0.0.0.0:8786", True)],
)  # fmt: skip
def test_an_open_scheduler_is_known(address, is_open):
    assert execution.is_open(address) == is_open


def test_an_open_scheduler_is_named(study_path, tmp_path, monkeypatch, command):
    monkeypatch.setattr(execution, "CONNECT_S", 0.3)
    for address, codes in (("tcp://0.0.0.0:9", ["scheduler-unreachable"]), ("tcp://127.0.0.1:9", [])):
        done = command("montecarlo", "run", study_path, tmp_path / "study", "--flights", "8", "--scheduler", address)
        assert printed_codes(done.stdout) == codes
        assert printed_codes(done.stderr) == ["scheduler-unreachable"]


@pytest.mark.long
def test_a_cluster_with_tls_makes_the_same_bytes(reference, study_path, tmp_path, monkeypatch):
    """With certificates from the environment's settings, as the page has it; one without is not let in."""
    dask = pytest.importorskip("dask")
    if shutil.which("openssl") is None:
        pytest.skip("no openssl to make a certificate")
    own, key = tmp_path / "own.pem", tmp_path / "own.key"
    make = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj", "/CN=test"]
    subprocess.run([*make, "-keyout", key, "-out", own], check=True, capture_output=True)
    where, roles = "distributed.comm.tls", ("scheduler", "worker", "client")
    tls = {f"{where}.ca-file": str(own), "distributed.comm.require-encryption": True}
    tls |= {f"{where}.{role}.{part}": str(file) for role in roles for part, file in (("cert", own), ("key", key))}
    bare = {f"{where}.{part}": None for part in ("ca-file", "client.cert", "client.key")}
    monkeypatch.setattr(execution, "CONNECT_S", 5)
    with dask.config.set(tls):
        options = {"threads_per_worker": 1, "processes": True, "dashboard_address": None, "protocol": "tls://"}
        with distributed.LocalCluster(n_workers=2, security=distributed.Security(), **options) as found:
            fly(study_path, tmp_path / "study", flights=FLIGHTS, scheduler=found.scheduler_address)
            assert found.scheduler_address.startswith("tls://")
            with dask.config.set(bare), pytest.raises(ConfigError) as refusal:
                fly(study_path, tmp_path / "other", flights=8, scheduler=found.scheduler_address)
    assert refusal.value.codes == ("scheduler-unreachable",)
    assert content(tmp_path / "study") == reference
