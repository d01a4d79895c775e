"""What inspection and health say, in words, for tests of what a user reads."""

from stario.fusion.health import Health
from stario.fusion.report.health import health_findings
from stario.sequences.findings import Finding, verdict
from stario.sequences.inspection.report import inspect_recording
from stario.sequences.sequence import ImuSequence


def told(sequence: ImuSequence) -> list[str]:
    """Return what an inspection finds."""
    return [str(found) for found in inspect_recording(sequence).findings]


def health_verdict(health: Health | None) -> list[Finding]:
    """Return the verdict on a run's health alone."""
    assert health is not None
    return verdict(health_findings(health))


def health_lines(health: Health | None) -> list[str]:
    """Return that verdict as the lines of a terminal."""
    return [finding.line() for finding in health_verdict(health)]
