"""What produced a folder of results."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from stario.fusion.commands.options import EstimatorOptions, ReadingOptions

if TYPE_CHECKING:
    from stario.network.model import DisplacementModel


def origin_of(
    backends: Iterable[str],
    paths: Sequence[Path],
    reading: ReadingOptions,
    estimating: EstimatorOptions,
    network: DisplacementModel,
    fixes: Path | None = None,
) -> dict[str, object]:
    """Return the content of `run.json`; the settings are in `config.json`.

    Args:
        backends: estimators that are run.
        paths: recordings, or the folders or list files that were given.
        reading: options for reading recordings; those that differ from the defaults are named.
        estimating: options of the estimator.
        network: the network that they name.
        fixes: file of absolute fixes.
    """
    from importlib.metadata import version

    default = asdict(ReadingOptions())
    return {
        "stario": version("stario"),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "model": estimating.model,
        "weights_sha256": network.card.sha256 or None,
        "backends": list(backends),
        "inputs": [str(path.absolute()) for path in paths],
        "reading": {k: v for k, v in asdict(reading).items() if v != default[k]},
        "fixes": fixes and str(fixes.absolute()),
    }
