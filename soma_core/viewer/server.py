"""The server of the page: an address of its own, and an end by Ctrl-C."""

from __future__ import annotations

import contextlib
import io
import logging
import socket
from typing import TYPE_CHECKING, Any

from soma_core.errors import InputError, SomaError

if TYPE_CHECKING:
    from soma_core.viewer.page import Page

__all__ = ["close", "open_server", "serve"]

_log = logging.getLogger(__name__)

_NEXT_PORTS = 20


def open_server(host: str, port: int) -> Any:
    """Start viser at an address, or at the next port that is free.

    Raises:
        SomaError: viser is not installed.
        InputError: no such address of this machine, or none of the ports is free.
    """
    try:
        import viser
    except ImportError as error:
        raise SomaError(
            "soma view needs viser, which is not installed. Run: pip install 'soma-body-core[view]'."
        ) from error
    found = _free_port(host, port)
    if found != port and port:
        _log.info("port %d is taken; this is the next", port)
    with contextlib.redirect_stdout(io.StringIO()):  # its own banner
        return viser.ViserServer(host=host, port=found, verbose=False)


def _free_port(host: str, port: int) -> int:
    for number in range(port, min(port + _NEXT_PORTS, 65536)) if port else (0,):
        try:
            place = socket.getaddrinfo(host, number, type=socket.SOCK_STREAM)[0]
            with socket.socket(place[0], place[1]) as one:
                one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                one.bind(place[4])
                return int(one.getsockname()[1])
        except PermissionError as error:
            raise InputError(
                "port", got=port, expected="one that may be used", fix="Pass port=8080."
            ) from error
        except (socket.gaierror, OSError) as error:
            if isinstance(error, socket.gaierror) or error.errno in (98, 48, 10048):
                if isinstance(error, socket.gaierror):
                    raise _no_host(host) from error
                continue
            raise _no_host(host) from error
    raise InputError(
        "port", got=f"{port} and the next {_NEXT_PORTS - 1}, all taken", expected="a free one",
        fix="Pass port=9000, or port=0 for any.",
    )  # fmt: skip


def _no_host(host: str) -> InputError:
    return InputError(
        "host", got=host, expected="an address of this machine",
        fix="Leave it out for this machine alone, or pass host=0.0.0.0 for all of its addresses.",
    )  # fmt: skip


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
