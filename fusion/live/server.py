"""HTTP side of the live server: receives pushes, serves one page.

    GET  /        the page
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
import gzip
import hmac
import importlib.resources
import io
import json
import logging
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import AbstractAsyncContextManager, suppress
from functools import cache
from html import escape
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from starlette.applications import Starlette
from starlette.authentication import AuthenticationBackend, AuthenticationError
from starlette.middleware import Middleware
from starlette.middleware.authentication import AuthenticationMiddleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import ClientDisconnect, HTTPConnection, Request
from starlette.responses import JSONResponse, Response, StreamingResponse
from starlette.routing import Route

from stario.fusion.live.hub import Hub, Viewer
from stario.fusion.live.payload import number_from, object_from, parse_lines, parse_push
from stario.sequences.arrays import check_choice
from stario.sequences.errors import InputError, StarioError
from stario.sequences.units import ACCEL_UNITS, known_unit

MAX_BYTES = 4 * 1024 * 1024
"""Maximum size of a push [bytes]."""

LOOPBACK = ["localhost", "127.0.0.1", "[::1]"]

COMMANDS = ("start", "stop", "zero", "fix")

MAX_VIEWERS = 50
"""Maximum number of pages that watch at once."""

_MIN_PERIOD = 0.05
_MAX_PERIOD = 1.0
_COOKIE = "stario_token"
_MAX_COORDINATE, _SIGMA_RANGE = 1e6, (0.01, 1e3)
_LINES = "application/x-ndjson"
_SIDES = ("left", "right"), ("bottom", "top")
"""Limits of the map's axes in a request."""

_POLICY = "content-security-policy"
_HEADERS = {
    "cache-control": "no-cache",
    _POLICY: "default-src 'self'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; frame-ancestors 'none'; base-uri 'none'; form-action 'none'",
}

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
    guard = (
        Middleware(AuthenticationMiddleware, backend=TokenCheck(token), on_error=_unauthorised)
        if token
        else Middleware(TrustedHostMiddleware, allowed_hosts=LOOPBACK)
    )
    app = Starlette(
        routes=[
            Route("/", _page),
            Route("/background", _background),
            Route("/live.css", _asset("live.css", "text/css")),
            Route("/live.js", _asset("live.js", "text/javascript")),
            Route("/plotly.js", _plotly),
            Route("/page.svg", _page_code),
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
        if not any(tokens_match(each, self._token) for each in shown):
            raise AuthenticationError(
                "token: missing or wrong; add ?token=..., as the server printed when it started"
            )


def _unauthorised(conn: HTTPConnection, error: Exception) -> Response:
    # Without a token nobody keeps a connection.
    return JSONResponse({"error": str(error)}, 401, {"connection": "close"})


def tokens_match(shown: str, token: str) -> bool:
    """Return whether a token equals the required one, in constant time."""
    return hmac.compare_digest(*(text.encode("utf-8", "surrogatepass") for text in (shown, token)))


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
        hub.refused["http"] += 1
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
    check_choice("command", command, COMMANDS)
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
    tiles = urlsplit(request.app.state.tiles)
    text = _content("live.html").decode()
    text = text.replace("PUSH_URL", escape(_url_for_phones(request, "data")))
    text = text.replace("TILE_SERVER", escape(tiles.hostname or ""))
    headers = dict(_HEADERS)
    if tiles.hostname:
        source = f"img-src {tiles.scheme}://{tiles.netloc} "
        headers[_POLICY] = headers[_POLICY].replace("img-src ", source)
    page = Response(text, media_type="text/html", headers=headers)
    if token := request.app.state.token:
        page.set_cookie(_COOKIE, token, httponly=True, samesite="strict")
    return page


async def _background(request: Request) -> Response:
    """Return the map's tiles between limits of its axes; none before a track is on the earth."""
    from stario.fusion.report.background import tile_images

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


async def _page_code(request: Request) -> Response:
    """Return the page's address for phones as a QR code."""
    import segno

    image = io.BytesIO()
    segno.make(_url_for_phones(request, ""), micro=False).save(image, kind="svg", scale=4)
    return Response(image.getvalue(), media_type="image/svg+xml", headers=_HEADERS)


def _url_for_phones(request: Request, path: str) -> str:
    """Return an address of this server as phones know it, with the token."""
    state = request.app.state
    # A browser elsewhere knows a host that works; one on this computer may know it as localhost.
    known = not state.host or request.url.hostname not in (*LOOPBACK, "::1")
    query = f"?token={state.token}" if state.token else ""
    return f"http://{request.url.netloc if known else state.host}/{path}{query}"


def _asset(name: str, media: str) -> Any:
    content = _content(name)

    async def answer(request: Request) -> Response:
        return Response(content, media_type=media, headers=_HEADERS)

    return answer


def _content(name: str) -> bytes:
    return importlib.resources.files("stario.fusion.live").joinpath(name).read_bytes()


async def _plotly(request: Request) -> Response:
    headers = {"content-encoding": "gzip", "cache-control": "max-age=86400"}
    content = await asyncio.to_thread(_compressed_plotly)
    return Response(content, media_type="text/javascript", headers=headers)


@cache
def _compressed_plotly() -> bytes:
    from plotly.offline import get_plotlyjs

    return gzip.compress(get_plotlyjs().encode(), 6)


async def _bad_request(request: Request, error: Exception) -> Response:
    return JSONResponse({"error": str(error)}, 400)


async def _storage_error(request: Request, error: Exception) -> Response:
    _log.error("a recording cannot be written: %s", error)
    return JSONResponse({"error": f"the recording cannot be written: {error}"}, 507)
