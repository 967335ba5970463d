"""The server of a page, which answers that page alone, and pages in files, which load nothing.

Any page that the user has open may send requests to servers on this machine. viser answers all of
them, and its pages offer to make the server public. Here requests must name this machine as their
host (DNS rebinding), requests from pages must come from the page of the same server (RFC 6455,
section 10.2), and nothing makes the server public.
"""

from __future__ import annotations

import ipaddress
import socket
import threading
from collections.abc import Callable
from functools import partial
from typing import Any
from urllib.parse import urlsplit

from diffcloth_torch.errors import InvalidInput

__all__ = ["guarded_server", "offline"]

_STARTING = threading.Lock()
_FORBIDDEN = 403  # HTTP status

# All content is part of the page itself.
_POLICY = "default-src data: blob: 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval'"

Answer = Callable[[Any, Any], Any]


def guarded_server(viser: Any, host: str, port: int) -> Any:
    """Start a server of viser that answers its own page alone.

    Args:
        viser: The module.
        host: Address of the server.
        port: Port of the server, or the next free one.

    Raises:
        InvalidInput: If this version of viser cannot be guarded.
    """
    import websockets.asyncio.server as sockets

    real, guarded = sockets.serve, []

    def serve(*arguments: Any, process_request: Answer, **options: Any) -> Any:
        guarded.append(True)
        answer = partial(_answer, host, process_request)
        return real(*arguments, process_request=answer, **options)

    # viser has no hook for requests; it looks up `serve` when it starts.
    with _STARTING:
        sockets.serve = serve  # type: ignore[assignment,misc]
        try:
            server = viser.ViserServer(host, port, verbose=False)
        finally:
            sockets.serve = real  # type: ignore[misc]
    if not guarded:
        server.stop()
        raise InvalidInput(
            f"show: viser {viser.__version__} would answer any page: install an earlier version, "
            "or write the page to a file, show(scene, states, 'motion.html')"
        )
    messages = viser._messages
    for message in (messages.ShareUrlRequest, messages.ShareUrlDisconnect):
        server._websock_server.unregister_handler(message)
    server.gui.configure_theme(show_share_button=False)
    return server


def _answer(host: str, process_request: Answer, connection: Any, request: Any) -> Any:
    """The response to a request; None allows a websocket to open."""
    problem = _problem(host, request.headers)
    if problem:
        return connection.respond(_FORBIDDEN, f"{problem}\n")
    response = process_request(connection, request)
    if response is not None:
        response.headers["Content-Security-Policy"] = "frame-ancestors 'self'"
    return response


def _problem(host: str, headers: Any) -> str:
    """The reason to refuse a request; empty if it is accepted."""
    hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
    if len(hosts) != 1 or not _is_own(host, hosts[0]):
        return f"the host must be this machine, got {hosts}"
    own = [f"{scheme}://{hosts[0]}".lower() for scheme in ("http", "https")]
    # Browsers name the origin of each websocket, and of requests by scripts of other pages.
    from_page = len(origins) == 1 and origins[0].lower() in own
    if (origins or headers.get_all("Upgrade")) and not from_page:
        return f"the origin must be the page of this server, got {origins}"
    return ""


def _is_own(host: str, given: str) -> bool:
    """Return whether a host of a request, with or without a port, is the server's own.

    Ports may differ, for example with a tunnel.
    """
    try:
        name = urlsplit(f"//{given}").hostname or ""
    except ValueError:
        return False
    if name == "localhost" or _is_loopback(name):
        return True
    if _is_loopback(host) or host == "localhost":
        return False
    # No other page has an address as its name; other names may belong to anyone.
    return _is_address(name) or name in {host.lower(), socket.gethostname(), socket.getfqdn()}


def _is_loopback(name: str) -> bool:
    return _is_address(name) and ipaddress.ip_address(name).is_loopback


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def offline(page: str) -> str:
    """Forbid a page to load anything that is not a part of it."""
    head, tag, rest = page.partition("<head>")
    assert tag
    policy = f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
    return f"{head}{tag}{policy}{rest}"
