"""Configuration by hydra: schemas, search path, and the run of a task in its own folder."""

__all__: list[str] = []
