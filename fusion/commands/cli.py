"""Command-line interface: the `stario` command.

Heavy packages are imported inside the commands, so that `stario --help` is instant. Exit status: 0
success, 1 known error (one line on stderr), 2 wrong usage; a bug gives a traceback.
"""

from __future__ import annotations

import logging
import sys
from collections import deque
from collections.abc import Callable
from typing import Annotated

import typer

from stario.fusion.commands import checks, options
from stario.fusion.commands.compare import compare, evaluate
from stario.fusion.commands.convert import convert, simulate
from stario.fusion.commands.run import inspect, live, run
from stario.fusion.commands.train import export, train
from stario.sequences.errors import StarioError
from stario.sequences.findings import FINDINGS

app = typer.Typer(add_completion=False, no_args_is_help=True, pretty_exceptions_enable=False)


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(version("stario-nav"))
        raise typer.Exit


@app.callback()
def _stario(
    printed: Annotated[
        bool, options.flag("--version", callback=_print_version, is_eager=True, help="The version.")
    ] = False,
) -> None:
    """Inertial navigation: fused trajectories from IMU recordings."""


for command in (run, live, compare, evaluate, inspect, convert, train, simulate, export):
    app.command()(command)

check = typer.Typer(no_args_is_help=True, help="Check estimators and networks on this machine.")
for command in checks.COMMANDS:
    check.command()(command)
app.add_typer(check, name="check")


def _once() -> Callable[[logging.LogRecord], bool]:
    """Return a filter that passes each message once: a command may look at a recording repeatedly.

    It remembers the newest thousand: a server that runs for months may see any number.
    """
    seen: deque[str] = deque(maxlen=1000)

    def passes(record: logging.LogRecord) -> bool:
        text = record.getMessage()
        if text in seen:
            return False
        seen.append(text)
        return True

    return passes


def main() -> None:
    """Entry point of the `stario` command."""
    shown = logging.StreamHandler(sys.stderr)
    shown.addFilter(_once())
    if {"run", "compare", "inspect"} & set(sys.argv[1:2]):  # these print the verdict on findings
        shown.addFilter(lambda record: record.name != FINDINGS)
    logging.basicConfig(level=logging.WARNING, format="stario: %(message)s", handlers=[shown])
    try:
        app()
    except StarioError as error:
        typer.echo(f"stario: {error}", err=True)
        sys.exit(1)
