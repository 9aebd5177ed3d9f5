"""What the command line may choose about how Anny is built."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

__all__ = ["AnnyOptions"]


@dataclass
class AnnyOptions:
    """``backend.options`` of Anny.

    Attributes:
        phenotypes: ``all``, or ``default`` for gender, age, muscle, weight, height and proportions only
            (half the basis, so about twice as fast).
        local_changes: ``none``, ``all``, or a list of names; each enabled name adds two columns to the basis.
        tolerance_mm: directions of the shape basis that together move the surface by less than this
            (root mean square over the extremes of all phenotypes) are left out.
    """

    phenotypes: str = "all"
    local_changes: Any = "none"
    tolerance_mm: float = 1e-5
