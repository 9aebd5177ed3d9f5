"""A page that shows bodies and moves them: what it shows, how a browser is told, what its controls do."""

__all__: list[str] = []
