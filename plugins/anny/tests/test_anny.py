"""What every backend must hold, without and with the local changes."""

import pytest

from soma_core.testing import conformance_suite

TestAnny = conformance_suite("anny")

TestAnnyLocalChanges = pytest.mark.slow(
    conformance_suite(
        "anny",
        {"parameters": "nipple-point-incr moves only vertices that Anny's topology leaves out"},
        options={"local_changes": "all"},
    )
)
