"""MHR, the Momentum Human Rig, for SOMA Core, read from the TorchScript file that its makers publish.

``_files`` says what the files are and where they lie, ``_model_file`` checks and loads one, ``_generator``
evaluates it, ``_backend`` declares it; ``mhr`` (LOD 1) and ``mhr_lod6`` are the entry points.
"""

from __future__ import annotations

__all__: list[str] = []
