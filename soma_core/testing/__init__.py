"""What backend authors import in their tests."""

__all__: list[str] = []
