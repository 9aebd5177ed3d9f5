"""The loss plot of a training run."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from pathlib import Path

from soma_core.cache import atomic_write
from soma_core.correctives.training import Epoch

__all__ = ["plot_history"]


def plot_history(history: Sequence[Epoch], path: Path) -> bool:
    """Draw errors and the share of the teacher reproduced by epoch; False without matplotlib."""
    if importlib.util.find_spec("matplotlib") is None:
        return False
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.add_subplot()
    epochs = [line["epoch"] + 1 for line in history]
    for key, label in (("train_mm", "training"), ("validation_mm", "validation")):
        axes.plot(epochs, [line[key] for line in history], marker=".", label=label)  # type: ignore[literal-required]
    axes.set_xlabel("epoch")
    axes.set_ylabel("root mean square error [mm]")
    axes.set_ylim(bottom=0)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(visible=True, alpha=0.3)
    other = axes.twinx()
    other.plot(epochs, [100 * line["reduction"] for line in history], color="tab:green", linestyle="--")
    other.set_ylabel("validation: error to the teacher that is gone [%]", color="tab:green")
    axes.legend(loc="lower left")
    atomic_write(path, lambda temporary: figure.savefig(temporary, dpi=150))
    return True
