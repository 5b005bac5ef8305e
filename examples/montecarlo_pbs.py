"""A Monte Carlo study on a cluster with PBS or Slurm: run it on the login node, or as a small job of its own.

For TLS (docs/monte-carlo.md) add ``protocol="tls://"`` and ``security=distributed.Security()`` to the cluster.
"""

import subprocess

from dask_jobqueue import PBSCluster  # for Slurm: SLURMCluster

if __name__ == "__main__":
    cluster = PBSCluster(
        cores=32,
        processes=32,
        memory="32GB",
        walltime="02:00:00",
        queue="normal",
        worker_extra_args=["--lifetime", "110m"],  # workers leave before the queue ends them
        job_script_prologue=["export DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED=False"],
    )
    # Slurm: SLURMCluster(cores=32, processes=32, memory="32GB", walltime="02:00:00", queue="normal", account="...")
    cluster.scale(jobs=8)  # 256 workers
    command = ["postflight", "montecarlo", "run", "irve2_reference", "study", "--flights", "1000000"]
    subprocess.run([*command, "--scheduler", cluster.scheduler_address], check=True)
