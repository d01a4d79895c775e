"""`stario live`: live tracks of devices that send samples."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stario.fusion.commands.options import EstimatorOptions, expand_option_groups


@expand_option_groups
def live(
    estimating: EstimatorOptions,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of page and pushes.")] = 8000,
    host: Annotated[
        str, typer.Option(help="Address to listen on; 0.0.0.0 admits phones, with a token.")
    ] = "127.0.0.1",
    lines_port: Annotated[
        int | None,
        typer.Option(
            min=0, max=65535, help="Port for lines of JSON over TCP and UDP. Default: --port + 1."
        ),
    ] = None,
    phyphox: Annotated[
        list[str] | None, typer.Option(help="Address of a phone running phyphox; repeatable.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the recordings.")] = Path("runs/live"),
) -> None:
    """Show live tracks on a web page, from Sensor Logger, phyphox or lines of JSON."""
    from stario.sequences.lazy import optional_package

    for package in ("starlette", "uvicorn", "plotly"):
        optional_package(package, "live")
    from stario.fusion.evaluation.folders import check_folder
    from stario.fusion.live.run import LiveServer
    from stario.fusion.navigator import Navigator

    model, settings = estimating.network(), estimating.settings()
    check_folder(out)
    if lines_port is None:
        lines_port = port + 1 if 0 < port < 65535 else 0
    server = LiveServer(
        lambda: Navigator(model, settings), out, host, port, lines_port, phyphox or []
    )
    server.run(started=lambda: typer.echo("\n".join(server.addresses()), err=True))
