"""Experiments: one module for each claim that ``soma evaluate experiment=<name>`` measures."""

__all__: list[str] = []
