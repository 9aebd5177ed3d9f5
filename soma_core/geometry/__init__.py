"""Pure maths: rotations, Procrustes, barycentric coordinates, radial basis functions, Laplacians.

Functions take and return arrays, know nothing of rigs or files, and accept any leading batch shape.
"""

from __future__ import annotations

__all__: list[str] = []
