"""What ``soma backends new`` writes: a complete backend to start from."""

from soma_core.template.distribution import write_backend

__all__ = ["write_backend"]
