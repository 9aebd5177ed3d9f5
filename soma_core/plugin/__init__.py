"""The plugin contract: what a backend declares, what it builds, and the registry that finds it.

A plugin needs no more than this package: ``from soma_core import BackendSpec, Parameter, WrapPair,
hookimpl``. Nothing here imports torch or the rest of the core.
"""

__all__: list[str] = []
