"""``soma view``: a page in the browser that shows bodies, poses them and plays motions."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import OmegaConf

from soma_core.viewer.page import Page
from soma_core.viewer.server import close, open_server, serve
from soma_core.viewer.session import Session
from soma_core.viewer.sources import settings_of

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from soma_core.config.schema import ViewConfig

__all__ = ["open_session", "run"]

_log = logging.getLogger(__name__)


def run(config: DictConfig, output: Path) -> None:
    """Serve the page until Ctrl-C; what is saved from it goes into `output`.

    Raises:
        SomaError: a backend, a file or the address cannot be used, or viser is not installed.
    """
    options: ViewConfig = OmegaConf.to_object(config)
    server = open_server(options.host, options.port)
    try:
        page = Page(server, open_session(options), output, settings=options.settings or "")
    except BaseException:
        close(server)
        raise
    serve(page)


def open_session(options: ViewConfig) -> Session:
    """Open what the settings name.

    Raises:
        SomaError: a backend or a file cannot be used.
    """
    session = Session(options, translation=options.translation)
    chosen = options.backend
    for name in (chosen.name, *options.beside):
        _log.info("opening %s", name)
        own = {"params": chosen.params, "options": chosen.options} if name == chosen.name else {}
        session.add(name, **own)
    settings = settings_of(options.settings or "")
    if options.motion is not None:
        session.load(options.motion, settings)
        if options.identity_from == "motion" or (options.compare and session.motion.identity):
            session.own_body(session.figures[0])
    if options.compare is not None:
        session.compare(options.compare, settings)
    return session
