"""HTTP side of the live server: receives pushes, serves one page.

    GET  /        the page, with its files below /page
    GET  /events  updates for the page, as server-sent events
    GET  /background?left=-9&right=9&bottom=-9&top=9  map tiles between limits [m], for plotly
    POST /data    a push of Sensor Logger, or lines of JSON (application/x-ndjson)
    POST /command {"device": name, "command": start, stop, zero, or fix with x, y, sigma [m]}

`/data?accel_unit=g` (or -g, -m/s2) gives the unit of a device's accelerometer; the minus is Apple's
sign. An invalid request gets a 4xx with the reason and changes nothing.

A server that others can reach requires its token with every request: in the address
(`?token=...`), as `Authorization: Bearer ...`, or in the cookie that the page sets. One on loopback
needs none but answers only to loopback host names; otherwise any web page that a browser visits
could reach it.
"""

from __future__ import annotations

import asyncio
import hmac
import json
import logging
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import AbstractAsyncContextManager, suppress
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import segno
from starlette.applications import Starlette
from starlette.authentication import AuthenticationBackend, AuthenticationError
from starlette.middleware import Middleware
from starlette.middleware.authentication import AuthenticationMiddleware
from starlette.middleware.gzip import GZipMiddleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import ClientDisconnect, HTTPConnection, Request
from starlette.responses import JSONResponse, Response, StreamingResponse
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles
from starlette.templating import Jinja2Templates

from stario.fusion.live.hub import Hub, Viewer
from stario.fusion.live.payload import number_from, object_from, parse_lines, parse_push
from stario.fusion.report.background import tile_images
from stario.sequences.errors import InputError, StarioError
from stario.sequences.units import ACCEL_UNITS, known_unit

MAX_BYTES = 4 * 1024 * 1024
"""Maximum size of a push [bytes]."""

LOOPBACK = ["localhost", "127.0.0.1", "[::1]"]

MAX_VIEWERS = 50
"""Maximum number of pages that watch at once."""

_MIN_PERIOD = 0.05
_MAX_PERIOD = 1.0
_COOKIE = "stario_token"
_MAX_COORDINATE, _SIGMA_RANGE = 1e6, (0.01, 1e3)
_LINES = "application/x-ndjson"
_SIDES = ("left", "right"), ("bottom", "top")
"""Limits of the map's axes in a request."""

_POLICY = (
    "default-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob: {tiles}; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)
_HERE = Path(__file__).parent
_TEMPLATES = Jinja2Templates(_HERE)

_log = logging.getLogger(__name__)


def live_app(
    hub: Hub,
    token: str = "",
    host: str = "",
    tiles: str = "",
    beside: Callable[[Starlette], AbstractAsyncContextManager[None]] | None = None,
) -> Starlette:
    """Return the web application.

    Args:
        hub: hub of the devices.
        token: token that every request must carry; empty for a server on loopback only.
        host: this computer's name or address and port in its network; empty on loopback.
        tiles: address of a map server's tiles; empty for none.
        beside: context of what runs as long as the server.
    """
    files = _Files(directory=_HERE / "page", packages=[("plotly", "package_data")])
    guard = (
        Middleware(AuthenticationMiddleware, backend=TokenCheck(token), on_error=_unauthorised)
        if token
        else Middleware(TrustedHostMiddleware, allowed_hosts=LOOPBACK)
    )
    app = Starlette(
        routes=[
            Route("/", _page),
            Mount("/page", files, middleware=[Middleware(GZipMiddleware, compresslevel=4)]),
            Route("/background", _background),
            Route("/events", _events),
            Route("/data", _data, methods=["POST"]),
            Route("/command", _command, methods=["POST"]),
        ],
        middleware=[guard],
        exception_handlers={StarioError: _bad_request, OSError: _storage_error},
        lifespan=beside,
    )
    app.state.hub, app.state.token, app.state.host = hub, token, host
    app.state.tiles = tiles
    return app


class _Files(StaticFiles):
    def file_response(self, *arguments: Any, **named: Any) -> Response:
        """Let a browser ask whether what it has is of this version."""
        response = super().file_response(*arguments, **named)
        response.headers["cache-control"] = "no-cache"
        return response


class TokenCheck(AuthenticationBackend):
    """Check that a request has the token.

    Args:
        token: required token, not empty.
    """

    def __init__(self, token: str) -> None:
        self._token = token

    async def authenticate(self, conn: HTTPConnection) -> None:
        """Raise an error if a request has no token."""
        bearer = conn.headers.get("authorization", "").removeprefix("Bearer ")
        shown = (conn.query_params.get("token", ""), bearer, conn.cookies.get(_COOKIE, ""))
        # In constant time; a text that came from outside may hold anything.
        token, *given = (each.encode("utf-8", "surrogatepass") for each in (self._token, *shown))
        if not any(hmac.compare_digest(each, token) for each in given):
            raise AuthenticationError(
                "token: missing or wrong; add ?token=..., as the server printed when it started"
            )


def _unauthorised(conn: HTTPConnection, error: Exception) -> Response:
    # Without a token nobody keeps a connection.
    return JSONResponse({"error": str(error)}, 401, {"connection": "close"})


async def _data(request: Request) -> Response:
    hub: Hub = request.app.state.hub
    try:
        _check_origin(request)
        unit = request.query_params.get("accel_unit", "m/s^2")
        name = known_unit("accel_unit", unit, ACCEL_UNITS)
        coding = request.headers.get("content-encoding", "identity")
        if coding != "identity":
            raise InputError("content-encoding", coding, "identity", "send it uncompressed")
        body = await _body(request)
        # In a thread, so that a large body does not block other requests.
        if request.headers.get("content-type", "").lower().startswith(_LINES):
            sender = f"http {request.client.host if request.client else ''}"
            batches = await asyncio.to_thread(parse_lines, body, sender)
        else:
            batches = [await asyncio.to_thread(parse_push, body)]
    except InputError as error:
        hub.refused += 1
        _log.warning("a message is refused: %s", error)  # few apps show the response
        raise
    return JSONResponse({"samples": await hub.take(*batches, accel_factor=ACCEL_UNITS[name])})


def _check_origin(request: Request) -> None:
    """Refuse requests from other servers' pages, which browsers identify by their origin."""
    origin = request.headers.get("origin")
    if origin is not None and origin.partition("://")[2] != request.headers.get("host"):
        raise InputError("origin", "a page of another server", "this server's page, or an app")


async def _body(request: Request) -> bytes:
    """Read the whole body; refuse one that is too large before it has arrived."""
    parts, size = [], 0
    try:
        async for part in request.stream():
            size += len(part)
            if size > MAX_BYTES:
                raise InputError("body", "a larger body", f"at most {MAX_BYTES} bytes")
            parts.append(part)
    except ClientDisconnect:
        raise InputError("body", "only a part", "a complete body") from None
    return b"".join(parts)


async def _command(request: Request) -> Response:
    hub: Hub = request.app.state.hub
    _check_origin(request)
    message = object_from("body", await _body(request))
    device, command = (str(message.get(key, "")) for key in ("device", "command"))
    await hub.command(device, command, **(_fix_values(message) if command == "fix" else {}))
    return JSONResponse({"done": command})


def _fix_values(message: Mapping[str, Any]) -> dict[str, float]:
    x, y = (_metres(name, message.get(name)) for name in ("x", "y"))
    sigma, (low, high) = number_from("sigma", message.get("sigma")), _SIGMA_RANGE
    if not low <= sigma <= high:
        raise InputError("sigma", f"{sigma:g}", f"{low:g} to {high:g} m")
    return {"x": x, "y": y, "sigma": sigma}


def _metres(name: str, value: Any) -> float:
    """Return a coordinate of the map in a request [m]."""
    metres = number_from(name, value)
    if abs(metres) > _MAX_COORDINATE:
        raise InputError(name, f"{metres:g}", f"up to {_MAX_COORDINATE:g} m")
    return metres


async def _events(request: Request) -> Response:
    hub: Hub = request.app.state.hub
    if hub.viewers >= MAX_VIEWERS:
        raise InputError("page", "one more", f"at most {MAX_VIEWERS} at once", "close others")

    async def messages() -> AsyncIterator[str]:
        viewer = Viewer(hub)
        hub.viewers += 1
        try:
            while not hub.ending:
                waiting = asyncio.create_task(hub.news(_MAX_PERIOD))
                yield f"data: {json.dumps(viewer.message(), separators=(',', ':'))}\n\n"
                await waiting
                await asyncio.sleep(_MIN_PERIOD)
        finally:
            hub.viewers -= 1

    headers = {"cache-control": "no-store", "x-accel-buffering": "no"}
    return StreamingResponse(messages(), media_type="text/event-stream", headers=headers)


async def _page(request: Request) -> Response:
    token, tiles = request.app.state.token, urlsplit(request.app.state.tiles)
    server = f"{tiles.scheme}://{tiles.netloc}" if tiles.hostname else ""
    code = segno.make(_url_for_phones(request, ""), micro=False).svg_data_uri(scale=4)
    known = {"push_url": _url_for_phones(request, "data"), "token": token, "code": code}
    page = _TEMPLATES.TemplateResponse(
        request,
        "live.html",
        {**known, "tile_server": tiles.hostname or ""},
        headers={
            "cache-control": "no-cache",
            "content-security-policy": _POLICY.format(tiles=server),
        },
    )
    if token:
        page.set_cookie(_COOKIE, token, httponly=True, samesite="strict")
    return page


async def _background(request: Request) -> Response:
    """Return the map's tiles between limits of its axes; none before a track is on the earth."""
    limits = np.array([[_limit(request, side) for side in axis] for axis in _SIDES])
    if not (limits[:, 0] < limits[:, 1]).all():
        raise InputError("left, bottom", "not below right, top", "limits of the map's axes")
    place, tiles = request.app.state.hub.earth.georeference, request.app.state.tiles
    return JSONResponse([*tile_images(place, limits, tiles)] if place and tiles else [])


def _limit(request: Request, side: str) -> float:
    """Return a limit of the map's axes in a request [m]."""
    value: Any = request.query_params.get(side, "")
    with suppress(ValueError):  # a text is refused as such
        value = float(value)
    return _metres(side, value)


def _url_for_phones(request: Request, path: str) -> str:
    """Return an address of this server as phones know it, with the token."""
    state = request.app.state
    # A browser elsewhere knows a host that works; one on this computer may know it as localhost.
    known = not state.host or request.url.hostname not in (*LOOPBACK, "::1")
    query = f"?token={state.token}" if state.token else ""
    return f"http://{request.url.netloc if known else state.host}/{path}{query}"


async def _bad_request(request: Request, error: Exception) -> Response:
    return JSONResponse({"error": str(error)}, 400)


async def _storage_error(request: Request, error: Exception) -> Response:
    _log.error("a recording cannot be written: %s", error)
    return JSONResponse({"error": f"the recording cannot be written: {error}"}, 507)
