"""All findings about a recording and its track, for the one verdict of every command."""

from __future__ import annotations

from stario.fusion.evaluation.known_positions import position_findings
from stario.fusion.report.health import health_findings
from stario.fusion.values.state import Track
from stario.sequences.findings import Finding, verdict
from stario.sequences.inspection.report import Inspection, inspect_recording
from stario.sequences.sequence import ImuSequence

_LEARNABLE = {
    "network_contradicts",
    "network_sigma",
    "network_direction",
    "track_scale",
    "track_error",
}
"""Codes of contradictions that weights trained on the recording's truth may resolve."""


def recording_verdict(
    sequence: ImuSequence, track: Track | None, found: Inspection | None = None, train: str = ""
) -> list[Finding]:
    """Return the verdict on a recording from inspection, the run's health and known positions.

    Args:
        sequence: the recording.
        track: its main track; None if it is refused.
        found: its inspection, if there is one already.
        train: command that trains weights on it, offered where its truth could teach them.
    """
    findings = [*(found or inspect_recording(sequence)).findings]
    if track is not None:
        findings += health_findings(track.health) if track.health else ()
        findings += position_findings(track, sequence)
    spoilt = any(finding.spoils_truth for finding in findings)
    learnable = any(f.code in _LEARNABLE and f.level == "warning" for f in findings)
    if train and sequence.truth is not None and learnable and not spoilt:
        text = "Its truth can teach the weights this motion."
        findings.append(Finding("train", text, f"Run `{train}`.", level="note"))
    return verdict(findings)
