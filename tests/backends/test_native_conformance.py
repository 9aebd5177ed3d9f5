"""What every backend must hold, the core's own included."""

from soma_core.testing import conformance_suite

TestSoma = conformance_suite("soma")
