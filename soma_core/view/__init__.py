"""Pictures of bodies: contact sheets, galleries, errors in colour, a wrap on its mesh."""

__all__: list[str] = []
