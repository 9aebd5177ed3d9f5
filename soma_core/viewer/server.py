"""The server of the page: an address of its own, and an end by Ctrl-C."""

from __future__ import annotations

import contextlib
import errno
import io
import logging
import socket
from typing import TYPE_CHECKING, Any

from soma_core._lazy import needed
from soma_core.errors import InputError

if TYPE_CHECKING:
    from soma_core.viewer.page import Page

__all__ = ["close", "open_server", "serve"]

_log = logging.getLogger(__name__)

_NEXT_PORTS = 20


def open_server(host: str, port: int) -> Any:
    """Start viser at an address, or at the next port that is free.

    Raises:
        InputError: viser is not installed; no such address of this machine, or none of the ports is free.
    """
    viser = needed("viser", setting="soma view", pip="[view]")
    found = _free_port(host, port)
    if found != port and port:
        _log.info("port %d is taken; this is the next", port)
    with contextlib.redirect_stdout(io.StringIO()):  # its own banner
        return viser.ViserServer(host=host, port=found, verbose=False)


def _free_port(host: str, port: int) -> int:
    """The first port from `port` on that nobody has.

    Raises:
        InputError: no such address, a port that may not be used, or none that is free.
    """
    if not 0 <= port < 65536:
        raise InputError("port", got=port, expected="a number from 0 to 65535", fix="Pass port=8080.")
    for number in range(port, min(port + _NEXT_PORTS, 65536)) if port else (0,):
        try:
            return _bound(host, number)
        except PermissionError as error:
            raise InputError(
                "port", got=number, expected="one that you may use", fix="Pass port=8080."
            ) from error
        except (OSError, UnicodeError) as error:
            if getattr(error, "errno", None) != errno.EADDRINUSE:
                raise InputError(
                    "host", got=host, expected="an address of this machine",
                    fix="Leave it out for this machine alone, or pass host=0.0.0.0 for all of its addresses.",
                ) from error  # fmt: skip
    raise InputError(
        "port", got=f"{port} and the next {_NEXT_PORTS - 1}, all taken", expected="a free one",
        fix="Pass port=9000, or port=0 for any.",
    )  # fmt: skip


def _bound(host: str, port: int) -> int:
    """A port that can be listened on, by trying to."""
    family, kind, _, _, place = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    with socket.socket(family, kind) as one:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        one.bind(place)
        return int(one.getsockname()[1])


def close(server: Any) -> None:
    """End a server without its own words."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def serve(page: Page) -> None:
    """Serve until Ctrl-C."""
    server = page.server
    host, port = server.get_host(), server.get_port()
    address = "localhost" if host in ("0.0.0.0", "::") else host  # noqa: S104 - asked for
    if address != host:
        _log.warning(
            "host=%s: everybody who reaches this machine can use the page and read motions here", host
        )
    try:
        page.step(0)
        _log.info("open http://%s:%d in a browser; Ctrl-C ends", address, port)
        while True:
            page.watched = bool(server.get_clients())
            page.step()
    except KeyboardInterrupt:
        _log.info("ended")
    finally:
        close(server)
