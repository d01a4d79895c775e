"""`stario compare` and `evaluate`: tracks side by side, and accuracy over many recordings."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stario.fusion.commands import common, options
from stario.sequences.datasets.batch import Skipped, without_skipped
from stario.sequences.errors import InputError

if TYPE_CHECKING:
    import pandas as pd

    from stario.fusion.evaluation.compare import Comparison
    from stario.fusion.evaluation.pedestrian import Model
    from stario.sequences.sequence import ImuSequence

_GROUP, _SET = "{group}", "{set}"

_SHOWN = ("track", "dead_reckoning")
"""Tracks without `--tracks`: what StarIO gives, and what one would have without it."""


@options.expanded
def compare(
    context: typer.Context,
    reading: options.Reading,
    estimating: options.Estimator,
    placing: options.Place,
    paths: options.OptionalPaths = None,
    fixes: options.Fixes = None,
    jobs: options.Jobs = 1,
    out: options.CompareOut = None,
    tracks: str = typer.Option(
        "",
        help="Further tracks, also as a table: filtered, network, network_true_attitude, pdr "
        "(from steps), separated by commas, or all.",
    ),
    report: options.Report = False,
    as_json: options.Json = False,
    explained: options.Explain = False,
) -> None:
    """Compare each recording's track with its truth and with dead reckoning by the IMU alone.

    Without PATH, that of a simulated walk.
    """
    from stario.fusion.evaluation.compare import TRACKS, compare_recordings, demonstration
    from stario.fusion.evaluation.results import metrics_dict, write_comparison
    from stario.fusion.evaluation.scores import joined
    from stario.fusion.values.fix_file import read_fixes
    from stario.sequences.arrays import check_choice
    from stario.sequences.files import check_folder

    if not paths:
        options.refuse(context, "without PATH", "use with a recording to read", *options.READING)
    also = common.further_files(report)
    chosen = TRACKS if tracks == "all" else [*_SHOWN, *(common.names_in(tracks) if tracks else [])]
    for name in chosen:
        check_choice("--tracks", name, TRACKS)
    settings, network = placing.settings(estimating.settings()), estimating.network()
    model = network if jobs == 1 else estimating.model  # each process loads the weights once
    absolute_fixes = [] if fixes is None else read_fixes(fixes)
    files, skipped = reading.recordings(paths or [])
    origin = common.origin_of(files, reading, estimating, network, fixes)
    read: Callable[[Path], ImuSequence] = reading.read
    if not paths:
        files, read = [Path("demonstration")], lambda path: demonstration()
    if fixes is not None and len(files) > 1:
        raise InputError("--fixes", f"{len(files)} recordings", "one recording")
    folder = out or Path("runs") / "compare"
    check_folder(folder)
    with common.progress_bar("compare", 100 * len(files)) as progress:
        outcomes = compare_recordings(
            files, model, settings, read, jobs, absolute_fixes, progress=progress, names=chosen
        )
        train = common.training_command(paths, reading, estimating.model) if paths else ""
        comparisons = [replace(c, train=train) for c in without_skipped(outcomes, skipped)]
    if explained:
        common.explain(as_json)
    if comparisons:
        written = write_comparison(folder, comparisons, settings, origin, also)
        lines = [line for found in comparisons for line in _lines(found, bool(tracks))]
        first = folder / comparisons[0].sequence.name / "plan.png"
        lines.append(f"figures and tracks: {first} and {len(written) - 1} other files")
        if not paths:
            command = "stario" if shutil.which("stario") else sys.argv[0]  # in no PATH: its own
            lines.append(f"next: {command} run FILE --report, with a phone's recording")
        scores = joined(found.scores for found in comparisons)
        common.print_result(as_json, metrics_dict(scores, comparisons[0].words), "\n".join(lines))
    common.exit_if_skipped(skipped)


def _lines(found: Comparison, as_table: bool) -> list[str]:
    """Return how good the track is beside dead reckoning, and perhaps a table of all tracks."""
    from stario.fusion.evaluation.text import error_words, place_words, track_table, track_words
    from stario.sequences.drawing.figures import distance

    alone = found.metrics["dead_reckoning"]
    far = alone["ate_m"] or alone["known_positions_m"]
    far = far or found.tracks["dead_reckoning"].trajectory.path_length()
    words = error_words(found) or place_words(found) or track_words(found)
    line = f"{found.sequence.name}: StarIO's track: {words}; dead reckoning: {distance(far)}"
    table = [track_table(found)] if as_table else []
    return [line, *table, *(finding.line() for finding in found.verdict)]


@dataclass(frozen=True, kw_only=True)
class _Evaluation:
    """What `evaluate` is given."""

    context: typer.Context
    reading: options.Reading
    estimating: options.Estimator
    paths: options.OptionalPaths = None
    data: options.Data = None
    split: Annotated[
        str,
        typer.Option(
            help="With --data: test, validation, training, holdout, all, open, or a list file "
            "with lines of name, group."
        ),
    ] = "test"
    by: Annotated[
        options.Grouping | None,
        typer.Option(
            help="Evaluate the network alone by groups. Ground truth may be poses, positions or "
            "waypoints."
        ),
    ] = None
    against: Annotated[
        str | None,
        typer.Option(
            help="With --by: weights to compare with, or pdr (pedestrian dead reckoning without a "
            "network), by paired error ratios with 95 % intervals. {group} or {set} in a weights "
            "name stands for each recording's group, or its first word: leave-one-out."
        ),
    ] = None
    filtered: Annotated[
        bool, options.flag("--filtered", help="With --by: also report the filter's mean NIS; slow.")
    ] = False
    jobs: options.Jobs = 1
    out: options.EvaluateOut = None
    as_json: options.Json = False

    def refuse_unused(self) -> None:
        """Refuse options that the chosen recordings and kind of evaluation do not use."""
        refuse = partial(options.refuse, self.context)
        if self.paths:
            refuse("with PATH", "one of the two", "data")
        if self.data is None:
            refuse("without --data", "use with --data", "split")
        else:
            refuse("with --data", "use with PATH: name the archive", "where")
        if self.by is None:
            refuse("without --by", "a grouping, such as --by set", "against", "filtered")
        else:
            alone = "use without: the network alone is judged"
            refuse("with --by", alone, "config", "magnetometer", "declination")

    def recordings(self) -> tuple[dict[Path, str], list[Skipped]]:
        """Return the recordings, of a list with their groups, and the skipped paths."""
        from stario.network.training.splits import read_packaged_list

        if self.paths:
            files, skipped = self.reading.recordings(self.paths)
            return dict.fromkeys(files, ""), skipped
        if self.data is None:
            raise InputError("PATH", "none", "recordings", "name some, or pass --data for a split")
        return {e.path: e.group for e in read_packaged_list(self.split, self.data)}, []

    def tracks(self, files: list[Path]) -> list[Skipped]:
        """Print the table of recordings, and write tracks one by one; return those skipped."""
        from stario.fusion.evaluation.compare import compare_recordings
        from stario.fusion.evaluation.results import write_recording, write_summary
        from stario.fusion.evaluation.scores import joined
        from stario.fusion.evaluation.text import summary, summary_table

        settings, network = self.estimating.settings(), self.estimating.network()
        model = network if self.jobs == 1 else self.estimating.model  # loaded once a process
        origin = common.origin_of(files, self.reading, self.estimating, network)
        read, jobs = self.reading.read, self.jobs
        skipped: list[Skipped] = []
        found = []
        with common.progress_bar("evaluate", 100 * len(files)) as progress:
            outcomes = compare_recordings(
                files, model, settings, read, jobs, truth_needed=True, progress=progress
            )
            for comparison in without_skipped(outcomes, skipped):
                if self.out is not None:
                    write_recording(self.out, comparison)
                found.append(comparison.scores)
        if found:
            scores = joined(found)
            if self.out is not None:
                write_summary(self.out, scores, settings, origin)
            common.print_result(self.as_json, summary(scores), summary_table(scores))
        return skipped

    def groups(self, groups: Mapping[Path, str], by: str) -> list[Skipped]:
        """Print and write the table of groups; return the recordings that were skipped."""
        from stario.fusion.evaluation.groups import benchmark, write_benchmark

        ours, theirs = self.estimating.model, self.against
        weights = list(dict.fromkeys([ours, theirs or ours]))
        for name in weights:
            if _GROUP not in name and _SET not in name:
                _for_group(name, "")  # fail on unloadable weights before preparing anything
        judged: dict[str, Any] = {"weights": weights, "filtered": self.filtered}
        work = partial(_alone, reading=self.reading, groups=groups, **judged)
        found, skipped = common.each_used("evaluate", work, groups, self.jobs)
        if found:
            table = benchmark(found, by, ours, theirs)
            if self.out is not None:
                write_benchmark(self.out, table)
            common.print_result(self.as_json, table.as_dict(), table.text())
        return skipped


@options.expanded
def evaluate(given: _Evaluation) -> None:
    """Evaluate accuracy and consistency over recordings with ground truth: medians and means."""
    from stario.network.training.splits import warn_of_learned
    from stario.sequences.files import check_folder

    if given.out is not None:
        check_folder(given.out)
    given.refuse_unused()
    groups, skipped = given.recordings()
    files = [*groups]
    if given.data is not None:
        warn_of_learned([given.estimating.model, given.against or ""], files, given.data)
    if given.by is None:
        skipped += given.tracks(files)
    else:
        skipped += given.groups(groups, given.by)
    common.exit_if_skipped(skipped)


def _alone(
    path: Path, reading: options.Reading, groups: Mapping[Path, str], **judged: Any
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return what `alone_on` does of a path; further processes know it by its name."""
    from stario.fusion.evaluation.groups import alone_on

    return alone_on(reading.read(path), path, groups[path], _for_group, **judged)


def _for_group(name: str, group: str) -> Model:
    """Load weights by name; `{group}` in it stands for the group, with underscores for blanks.

    `{set}` stands for the group's first word.
    """
    from stario.fusion.evaluation.pedestrian import model_named

    name = name.replace(_SET, group.partition(" ")[0])
    return model_named(name.replace(_GROUP, group.replace(" ", "_")))
