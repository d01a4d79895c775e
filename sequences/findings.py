"""What is found about a recording or a run, as data, and the one verdict on it.

A finding is made where it is known, with its numbers. Words for people are part of it; programs
use code and values, and nothing recognises a finding by its words.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

Level = Literal["warning", "good", "note"]
"""Severity: worth acting on, nothing to do, or good to know."""

_ORDER: tuple[Level, ...] = "warning", "good", "note"

TOO_EARLY = "too_early"
"""Code of the finding that there is too little motion to say that all is well."""

_EXPLAINED = {
    "refused": {"gyro_axes", "truth_tilted"},
    "gyro_axes": {"network_contradicts", "network_sigma", "corrections"},
    "mirror_image": {"track_scale", "track_error", "yaw_unknown"},
    "track_scale": {"track_error"},
}
"""Codes whose findings follow from another one: one fault is told once."""

FINDINGS = "stario.findings"
"""Name of the log of findings, for those who see no verdict."""

_log = logging.getLogger(FINDINGS)


@dataclass(frozen=True)
class Finding:
    """One observation that stands out.

    Attributes:
        code: name of its kind, for programs.
        text: what was observed, in words.
        advice: what to do: a command that runs as printed, or words; empty if nothing.
        level: severity.
        values: its numbers, with units in their names.
        spoils_truth: whether a network must not be trained on the recording's truth.
    """

    code: str
    text: str
    advice: str = ""
    level: Level = "warning"
    values: Mapping[str, object] = field(default_factory=dict)
    spoils_truth: bool = False

    def __str__(self) -> str:
        joint = "" if not self.advice else " " if self.text.endswith(".") else ": "
        return f"{self.text}{joint}{self.advice}"

    def line(self) -> str:
        """Return the finding as a line to print; those to act on begin with "!"."""
        return f"{'! ' if self.level == 'warning' else '  '}{self}"


@dataclass(frozen=True)
class Assessment:
    """What one part of an inspection found.

    Attributes:
        figures: what was measured, by name; units are in the names.
        lines: the same as lines to print.
        findings: what stands out.
    """

    figures: dict[str, Any]
    lines: list[str]
    findings: list[Finding]


def verdict(findings: Iterable[Finding]) -> list[Finding]:
    """Return the one verdict on a recording: what to act on first; never empty.

    Of findings of one kind by several inspections the first counts, and what follows from another
    finding is left out. That there is nothing to do is said only if nothing was found to act on and
    there was enough motion to judge.
    """
    first: dict[str, Finding] = {}
    for finding in findings:
        first.setdefault(finding.code, finding)
    explained = {code for known in first for code in _EXPLAINED.get(known, ())}
    told = [finding for code, finding in first.items() if code not in explained]
    if all(found.level == "note" and found.code != TOO_EARLY for found in told):
        words = "Nothing was found and nothing contradicts: nothing to do."
        told.append(Finding("nothing", words, level="good"))
    return sorted(told, key=lambda found: _ORDER.index(found.level))


def warn(name: str, findings: Iterable[Finding]) -> None:
    """Log a warning for each finding about the recording `name`."""
    for finding in findings:
        _log.warning("%s: %s", name, finding)
