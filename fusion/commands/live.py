"""`stario live`: live tracks of devices that send samples."""

from __future__ import annotations

from pathlib import Path

import typer

from stario.fusion.commands import options


@options.expanded
def live(
    estimating: options.Estimator,
    placing: options.Map,
    port: int = typer.Option(8000, min=0, max=65535, help="Port of page and pushes."),
    host: str = typer.Option(
        "127.0.0.1", help="Address to listen on; 0.0.0.0 admits phones, with a token."
    ),
    phyphox: list[str] | None = typer.Option(
        None, help="Address of a phone running phyphox; repeatable."
    ),
    tiles: options.Tiles = "",
    demo: bool = options.flag(False, "--demo", help="Let a simulated phone walk."),
    out: Path = typer.Option(Path("runs/live"), help="Folder for the recordings."),
) -> None:
    """Show live tracks on a web page, from Sensor Logger, phyphox or any device that posts JSON."""
    from stario.sequences.errors import InputError
    from stario.sequences.lazy import optional_package

    for package in ("starlette", "uvicorn", "jinja2", "plotly", "segno"):
        optional_package(package, "live")
    from stario.fusion import demonstration
    from stario.fusion.evaluation.results import check_folder
    from stario.fusion.live.run import LiveServer
    from stario.fusion.navigator import Navigator

    model, settings = estimating.network(), placing.settings(estimating.settings())
    if settings.place.origin is not None and len(settings.place.origin) > 2:
        fix = "leave it out: satellites, or two places given on the page, turn the track"
        raise InputError("--origin", "a yaw", "LAT,LON: the page has x east", fix)
    if tiles:
        from stario.fusion.report.background import check_tiles

        check_tiles(tiles)
    check_folder(out)
    simulated = demonstration() if demo else None
    server = LiveServer(
        lambda: Navigator(model, settings), out, host, port, phyphox or [], simulated, tiles
    )
    server.run(started=lambda: typer.echo("\n".join(server.addresses()), err=True))
