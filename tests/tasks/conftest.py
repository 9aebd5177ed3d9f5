"""The stand-in of SMPL-H and a motion for it, as in the tests of conversions."""

from tests.motion.conftest import amass, smplh_models, smplh_supplied

__all__ = ["amass", "smplh_models", "smplh_supplied"]
