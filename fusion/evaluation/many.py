"""Comparison of many recordings in parallel, skipping those that cannot be used."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

from stario.fusion.config import NavigatorConfig
from stario.fusion.evaluation.compare import Comparison, compare
from stario.fusion.evaluation.tracks import true_poses
from stario.fusion.fixes import Fix, fix_list
from stario.fusion.imu.stateful import Predictor
from stario.fusion.recording import Progress, silent
from stario.network.model import load_model
from stario.sequences.arrays import shown
from stario.sequences.datasets.batch import Skipped, each
from stario.sequences.errors import InputError
from stario.sequences.files import unused_name
from stario.sequences.readers import read_recording
from stario.sequences.sequence import ImuSequence


def compare_recordings(
    paths: Iterable[Path],
    model: Predictor | str,
    config: NavigatorConfig | None = None,
    read: Callable[[Path], ImuSequence] = read_recording,
    jobs: int | None = None,
    fixes: Iterable[Fix] = (),
    truth_needed: bool = False,
    progress: Progress = silent,
) -> Iterator[Comparison | Skipped]:
    """Compare the tracks of each recording, in the order of the paths.

    Comparisons are yielded one by one, so that they need not all be in memory, under distinct
    names: a second `walk` is `walk-2`.

    Args:
        paths: paths of the recordings.
        model: network, or name of weights, which each process loads once: faster than passing the
            network with every recording.
        config: configuration of the navigator; None has its defaults.
        read: function that reads a path; must be picklable.
        jobs: number of processes, as for `stario.sequences.datasets.batch.each`.
        fixes: fixes given to EKF and graph for every recording.
        truth_needed: whether to skip recordings without ground truth.
        progress: called with the share of the work done; with a single process also within a
            recording.

    Raises:
        InputError: `paths` is a single path, or an argument has the wrong type.
    """
    if isinstance(paths, str | Path):
        remedy = "find_recordings(path) returns one"
        raise InputError("paths", shown(paths), "a list of paths", remedy)
    paths, done = list(paths), 0

    def report_share(share: float) -> None:
        progress((done + share) / len(paths))

    work = partial(
        _compare,
        model=model,
        config=config,
        read=read,
        fixes=fix_list(fixes),
        truth_needed=truth_needed,
        progress=report_share if jobs == 1 else silent,
    )
    names: set[str] = set()
    for outcome in each(work, paths, jobs):
        done += 1
        report_share(0.0)
        if isinstance(outcome, Comparison):
            name = distinct_name(outcome.sequence.name, names)
            outcome = replace(outcome, sequence=replace(outcome.sequence, name=name))
        yield outcome


def distinct_name(name: str, taken: set[str]) -> str:
    """Return the name, or the first of name-2, name-3, ... not in `taken`, and add it there.

    It is also the name of a folder: an archive's `..` would be the one above.
    """
    found = unused_name(name if name.strip(".") else "recording", taken)
    taken.add(found)
    return found


def _compare(
    path: Path,
    model: Predictor | str,
    config: NavigatorConfig | None,
    read: Callable[[Path], ImuSequence],
    fixes: Sequence[Fix],
    truth_needed: bool,
    progress: Progress,
) -> Comparison:
    sequence = read(path)
    if truth_needed:
        true_poses(sequence)
    network = _loaded(model) if isinstance(model, str) else model
    return compare(network, sequence, config, progress, fixes)


_loaded = cache(load_model)
