"""What every backend must hold; this is the whole test file that a backend needs."""

from soma_core.testing import conformance_suite

TestToy = conformance_suite("toy")
