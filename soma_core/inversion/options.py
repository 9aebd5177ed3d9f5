"""Options of a fit from plain values, as configuration files hold them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from soma_core.inversion.analytical import AnalyticalOptions
from soma_core.inversion.autograd import AutogradOptions
from soma_core.inversion.priors import HINGES, PosePriors

__all__ = ["inversion_options"]


def inversion_options(values: Mapping[str, Any]) -> dict[str, Any]:
    """Keyword arguments of ``PoseInversion`` from numbers, texts and mappings under the same names.

    ``priors.hinges`` is true or false: the elbows and knees of ``HINGES``, or none.

    Raises:
        InputError: a number out of range.
    """
    plain = dict(values)
    priors = dict(plain.pop("priors", {}))
    hinges = HINGES if priors.pop("hinges", False) else {}
    return plain | {
        "stages": tuple(plain["stages"]),
        "analytical": AnalyticalOptions(**plain.get("analytical", {})),
        "autograd": AutogradOptions(**plain.get("autograd", {})),
        "priors": PosePriors(**priors, hinges=hinges),
    }
