"""What inspection and health say, in words, for tests of what a user reads."""

from dataclasses import replace

import numpy as np
import pytest

from stario.fusion.report.health import health_findings
from stario.fusion.values.health import Health
from stario.sequences.errors import InputError
from stario.sequences.findings import Finding, verdict
from stario.sequences.inspection.checks import check_units
from stario.sequences.inspection.report import inspect_recording
from stario.sequences.sequence import STANDARD_GRAVITY, ImuSequence

UP = np.array([0.0, 0.0, STANDARD_GRAVITY])


def told(sequence: ImuSequence) -> list[str]:
    return [str(found) for found in inspect_recording(sequence).findings]


def health_verdict(health: Health | None) -> list[Finding]:
    assert health is not None
    return verdict(health_findings(health))


def health_lines(health: Health | None) -> list[str]:
    return [finding.line() for finding in health_verdict(health)]


def refusal(sequence: ImuSequence) -> str:
    """Return the error of a recording that was read from a file."""
    with pytest.raises(InputError) as caught:
        check_units(replace(sequence, source="generic CSV"))
    text = str(caught.value)
    assert "\n" not in text
    assert text.startswith(sequence.name)
    return text
