"""Evaluate many recordings on a cluster: here two local workers; pass an address for a real one.

joblib distributes the recordings to the backend that `joblib.parallel_config` names: with Ray,
`backend="ray"` after `ray.util.joblib.register_ray()` does the same. The workers must be able to
read the recordings' paths. Needs `pip install '.[cluster]'`.

    python examples/cluster.py
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import joblib
import pandas as pd
from distributed import Client, LocalCluster

from stario.fusion import compare_recordings, summary_table
from stario.sequences import Skipped, generate_walk, simulate_imu, write_csv


def evaluate(paths: list[Path], client: Client) -> tuple[pd.DataFrame, list[Skipped]]:
    """Return the recordings' scores, in their order, and the recordings that were skipped."""
    scores, skipped = [], []
    with joblib.parallel_config(backend="dask", client=client):
        for outcome in compare_recordings(paths, "default", truth_needed=True):
            if isinstance(outcome, Skipped):
                skipped.append(outcome)
            else:
                scores.append(outcome.scores)
    return pd.concat(scores), skipped


def main(folder: Path, seconds: float = 20.0) -> tuple[pd.DataFrame, list[Skipped], set[str]]:
    """Simulate four recordings, corrupt one, and evaluate them on two workers.

    Returns:
        Scores, skipped recordings, and the workers that computed something.
    """
    paths = [folder / f"walk-{seed}.csv" for seed in range(4)]
    for seed, path in enumerate(paths):
        write_csv(path, simulate_imu(generate_walk(seed, seconds), 100.0, seed=seed))
    paths[2].write_text("t,gx,gy,gz,ax,ay,az\n0,0,0,0,0,0\n")
    workers = LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0")
    with workers as cluster, Client(cluster) as client:
        client.get_task_stream()  # from here on the scheduler records which worker computes what
        scores, skipped = evaluate(paths, client)
        tasks = client.get_task_stream()
    return scores, skipped, {task["worker"] for task in tasks}


if __name__ == "__main__":
    argparse.ArgumentParser(description="Evaluate four recordings on two workers.").parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        scores, skipped, workers = main(Path(temporary))
    print(summary_table(scores))
    print(f"computed by {len(workers)} workers; skipped: {skipped[0].reason}")
