"""`stario evaluate`: accuracy over many recordings with ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stario.fusion.commands.common import exit_if_skipped, print_json, progress_bar
from stario.fusion.commands.judging import evaluate_by_group
from stario.fusion.commands.options import (
    EstimatorOptions,
    JobsOption,
    JsonOption,
    OutOption,
    PathsArgument,
    ReadingOptions,
    expand_option_groups,
)
from stario.sequences.errors import InputError

if TYPE_CHECKING:
    from stario.fusion.config import NavigatorConfig
    from stario.sequences.datasets.batch import Skipped
    from stario.sequences.datasets.splits import ListEntry


@expand_option_groups
def evaluate(
    reading: ReadingOptions,
    estimating: EstimatorOptions,
    paths: PathsArgument = None,
    data: Annotated[
        Path | None, typer.Option(help="Folder of the development recordings, used without PATH.")
    ] = None,
    split: Annotated[
        str,
        typer.Option(
            help="With --data: test, validation, training, holdout, all, open, or a list file "
            "with lines of name, group."
        ),
    ] = "test",
    by: Annotated[
        str | None,
        typer.Option(
            "--by",
            help="Evaluate the network alone by set, group, person, device, place or carry. "
            "Ground truth may be poses, positions or waypoints.",
        ),
    ] = None,
    against: Annotated[
        str | None,
        typer.Option(
            help="With --by: weights to compare with, or pdr (pedestrian dead reckoning without a "
            "network), by paired error ratios with 95 % intervals. {group} in a weights name "
            "stands for each recording's group: leave-one-group-out."
        ),
    ] = None,
    ekf: Annotated[
        bool, typer.Option("--ekf", help="With --by: also report the mean NIS of the EKF; slow.")
    ] = False,
    models: Annotated[
        str | None,
        typer.Option(
            "--models",
            help="Networks to compare, separated by commas: names from `stario check models`, "
            "default, or weights files; several weights of one network are averaged.",
        ),
    ] = None,
    runs: Annotated[
        Path, typer.Option(help="Folder of training runs in which named networks are found.")
    ] = Path("runs"),
    convention: Annotated[
        str | None,
        typer.Option(help="How --models averages position errors: rms (default), ronin or mean."),
    ] = None,
    jobs: JobsOption = 1,
    out: OutOption = None,
    as_json: JsonOption = False,
) -> None:
    """Evaluate accuracy and consistency over recordings with ground truth: medians and means."""
    from stario.fusion.evaluation.many import compare_recordings
    from stario.fusion.evaluation.results import write_recording, write_summary
    from stario.fusion.evaluation.summary import scores_of, summary, summary_table
    from stario.sequences.datasets.batch import Skipped

    if by is not None:
        listed, skipped = _listed(reading, paths or [], data, split)
        skipped += evaluate_by_group(
            listed, reading, by, estimating.model, against, ekf, jobs, out, as_json
        )
        exit_if_skipped(skipped)
        return
    if against is not None:
        raise InputError("--against", f"{against} without --by", "a grouping", "add --by set")
    listed, skipped = _listed(reading, paths or [], data, split)
    files = [entry.path for entry in listed]
    if models is not None:
        names, settings = [name.strip() for name in models.split(",")], estimating.settings()
        averaging = convention or "rms"
        skipped += _networks(names, runs, files, settings, reading, averaging, jobs, out, as_json)
        exit_if_skipped(skipped)
        return
    if convention is not None:
        raise InputError(
            "--convention", f"{convention} without --models", "networks", "name them with --models"
        )
    settings, network = estimating.settings(), estimating.network_for(jobs)
    recordings = []
    with progress_bar("evaluate", 100 * len(files)) as progress:
        for outcome in compare_recordings(
            files, network, settings, reading.read, jobs, truth_needed=True, progress=progress
        ):
            if isinstance(outcome, Skipped):
                skipped.append(outcome)
                continue
            if out is not None:
                write_recording(out, outcome, settings)
            recordings.append(scores_of(outcome))
    if recordings and out is not None:
        write_summary(out, recordings, settings)
    if recordings and as_json:
        print_json(summary(recordings))
    elif recordings:
        typer.echo(summary_table(recordings))
    exit_if_skipped(skipped)


def _listed(
    reading: ReadingOptions, paths: list[Path], data: Path | None, split: str
) -> tuple[list[ListEntry], list[Skipped]]:
    """Return the named recordings, or else those of the split, and the skipped paths."""
    from stario.network.training.splits import read_packaged_list
    from stario.sequences.datasets.splits import ListEntry

    if paths:
        files, skipped = reading.recordings(paths)
        return [ListEntry(path, "") for path in files], skipped
    if data is None:
        raise InputError("PATH", "none", "recordings", "name some, or pass --data for a split")
    if reading.where:
        raise InputError(
            "--where", "use with --data", "use with PATH", "name the archive instead of --data"
        )
    return read_packaged_list(split, data), []


def _networks(
    names: list[str],
    runs: Path,
    files: list[Path],
    settings: NavigatorConfig,
    reading: ReadingOptions,
    convention: str,
    jobs: int,
    out: Path | None,
    as_json: bool,
) -> list[Skipped]:
    """Write and print the table of networks; return the recordings that were skipped."""
    from stario.fusion.evaluation.figures import write_table
    from stario.fusion.evaluation.results import make_folder
    from stario.fusion.evaluation.tables import (
        compare_networks,
        table_dict,
        table_text,
    )
    from stario.network.model import load_model, weights_named
    from stario.sequences.accuracy.metrics import check_convention

    networks = {name: load_model(weights_named(name, runs)) for name in names}
    if out is not None:
        make_folder(out)
    with progress_bar("evaluate", 100 * len(files)) as progress:
        table, skipped = compare_networks(
            files,
            list(networks.items()),
            settings,
            reading.read,
            check_convention(convention),
            jobs,
            progress=progress,
        )
    if table.entries:
        if out is not None:
            write_table(out, table)
        if as_json:
            print_json(table_dict(table))
        else:
            typer.echo(table_text(table))
    return skipped
