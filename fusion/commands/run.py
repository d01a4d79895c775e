"""`stario run`: fuse recordings into tracks."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

from stario.fusion.commands import common, options

if TYPE_CHECKING:
    from stario.fusion.evaluation.compare import Comparison
    from stario.sequences.sequence import ImuSequence


@options.expanded
def run(
    paths: options.Paths,
    reading: options.Reading,
    estimating: options.Estimator,
    placing: options.Place,
    fixes: options.Fixes = None,
    out: options.RunOut = None,
    filtered: bool = options.flag(
        False, "--filtered", help="Also write the filter's track, as a stream gives it."
    ),
    report: options.Report = False,
    tiles: options.Tiles = "",
    view: bool = options.flag(
        False, "--view", help="Open the rerun 3-D viewer; its file is kept in --out."
    ),
    as_json: options.Json = False,
    explained: options.Explain = False,
) -> None:
    """Fuse each recording into a smooth track with attitude, velocity, biases and covariance."""
    from stario.fusion.evaluation.compare import measured
    from stario.fusion.evaluation.results import write_run
    from stario.fusion.navigator import Navigator
    from stario.fusion.values.fix_file import check_within, read_fixes

    also = common.further_files(report, tiles, view)
    network = estimating.network()
    navigator = Navigator(network, placing.settings(estimating.settings()))
    given = [] if fixes is None else read_fixes(fixes)
    if explained:
        common.explain()
    origin = common.origin_of(paths, reading, estimating, network, fixes)
    train = common.training_command(paths, reading)

    def fuse(sequence: ImuSequence, folder: Path) -> tuple[dict[str, object], str]:
        """Write one recording's track; return its record and a summary."""
        check_within(given, sequence)
        with common.progress_bar(f"run {sequence.name}") as progress:
            track = navigator.run(sequence, progress, given)
        tracks = {"track": track}
        if filtered and track.filtered is not None:
            tracks["filtered"] = track.filtered
        found = replace(measured(sequence, tracks, navigator.config.place), train=train)
        written = write_run(folder, found, navigator.config, origin, also)
        if view:
            from stario.fusion.report.view import open_view

            open_view(folder / "track.rrd")
        record: dict[str, object] = {"recording": sequence.name, **found.metrics}
        record |= {"verdict": [asdict(f) for f in found.verdict], "folder": str(folder)}
        lines = [*_lines(found), f"{folder}: {', '.join(path.name for path in written)}"]
        return record, "\n".join(lines)

    common.process_each(reading, paths, out, fuse, as_json, "--fixes" if fixes else "")


def _lines(found: Comparison) -> list[str]:
    """Return what was recorded, the track, its errors and the verdict, a fact per line."""
    from stario.fusion.evaluation.text import error_words, place_words, track_words

    lines = [found.sequence.summary(), f"track: {track_words(found)}"]
    lines += [f"place: {words}"] if (words := place_words(found)) else []
    for name in found.tracks:
        if words := error_words(found, name):
            lines.append(f"{'error' if name == 'track' else f'{name}, error'}: {words}")
    return [*lines, *(finding.line() for finding in found.verdict)]
