"""What ``soma backends new`` writes: a complete backend to start from, and how one stays up to date."""

from soma_core.template.distribution import update_backend, write_backend

__all__ = ["update_backend", "write_backend"]
