"""SMPL, SMPL-H and SMPL-X for SOMA Core, read from the files that their makers hand out to registered users.

``family`` says what the three models are, ``_files`` where their files lie, ``_model_file`` reads and checks
them, ``_generator`` evaluates them, ``_backend`` declares them; ``smpl``, ``smplh`` and ``smplx`` are the
entry points.
"""

from __future__ import annotations

__all__: list[str] = []
