"""Motions of other tools to this skeleton and back."""

__all__: list[str] = []
