"""The version of the core: one place that packaging reads too."""

__all__ = ["__version__"]

__version__ = "0.1.0"
