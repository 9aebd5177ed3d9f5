"""Tables of what the device benchmark found, as markdown for the README and as short text for a terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator

__all__ = ["gpu_table", "short_table"]

Table = tuple[str, list[str], list[list[str]]]
LONGEST = 11500
"""Characters of the text."""


def gpu_table(state: dict) -> str:
    """Markdown."""
    lines = []
    for title, head, rows in _tables(state):
        if rows:
            lines += [f"{title}:", "", _line(head), _line(["---"] * len(head)), *map(_line, rows), ""]
    return "\n".join([*lines, *_trouble(state), _machine(state), "Written by `python benchmarks/gpu.py`."])


def short_table(state: dict) -> str:
    """What fits into the end of an answer."""
    lines = [_machine(state)]
    for title, head, rows in _tables(state):
        if rows:
            lines += [f"== {title}", "; ".join(head), *("; ".join(row) for row in rows)]
    return "\n".join([*lines, "== state", *_trouble(state)])[-LONGEST:]


def _line(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _rows(state: dict, section: str) -> list[dict]:
    found = state["sections"].get(section, {}).get("rows", [])
    return [row for row in found if row["status"] == "done" and row["name"] not in ("none", "packages")]


def _number(value: object) -> str:
    if not isinstance(value, (int, float)):
        return ""
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def _cells(row: dict, *keys: str) -> list[str]:
    return [_number(row.get(key)) for key in keys]


def _verdict(row: dict) -> str:
    return {True: "yes", False: "**no**"}.get(row.get("ok"), "")


def _tables(state: dict) -> Iterator[Table]:
    rows = [[row["name"], *_cells(row, "error", "bound", "gradient_error", "gradient_bound", "first_s"),
             _verdict(row)] for row in _rows(state, "kernels")]  # fmt: skip
    head = ["kernel", "error", "bound", "gradient", "bound", "first call, s", "ok"]
    yield "Kernels on the device against torch in float64 on the CPU", head, rows
    keys = (
        "mm_to_float64",
        "mm_without_gradients",
        "mm_pose",
        "slope_rotations",
        "slope_translation",
        "slope_params",
    )
    rows = [[row["name"], *_cells(row, *keys), _verdict(row)] for row in _rows(state, "layer")]
    head = [
        "layer",
        "mm to float64",
        "without gradients",
        "pose",
        "rotations",
        "translation",
        "parameters",
        "ok",
    ]
    yield "The layer on the device, and its gradients against float64 on the CPU", head, rows
    keys = ("mean_mm", "max_mm", "max_degrees", "converged")
    rows = [[row["name"], *_cells(row, *keys, "first_s"), _verdict(row)] for row in _rows(state, "fit")]
    head = ["fit", "mean, mm", "max, mm", "worst angle, degrees", "converged", "first call, s", "ok"]
    yield "Pose inversion of exact targets", head, rows
    yield from _by_batch(state)
    rows = [[row["name"], *_cells(row, "ms", "p25_ms", "p75_ms", "eager_ms", "pose_ms", "mm_to_eager")]
            for row in _rows(state, "graph")]  # fmt: skip
    yield "CUDA graphs", ["case", "ms", "p25", "p75", "without a graph, ms", "pose, ms", "mm to eager"], rows
    keys = ("frames_per_s", "ms", "mean_mm", "max_mm", "max_degrees", "converged", "peak_mb")
    rows = [[row["name"], *_cells(row, *keys)] for row in _rows(state, "inversion")]
    rows += [[f"py-soma-x: {row['name'].removeprefix('inversion ')} {row['frames']}", *_cells(row, *keys)]
             for row in _rows(state, "peer") if row["name"].startswith("inversion")]  # fmt: skip
    head = ["case", "frames/s", "ms", "mean, mm", "max, mm", "worst angle, degrees", "converged", "peak MB"]
    yield "Pose inversion", head, rows


def _by_batch(state: dict) -> Iterator[Table]:
    """One line a case, one column a batch."""
    ours = [row for row in _rows(state, "table4") if "batch" in row]
    peer = [{**row, "name": f"py-soma-x: {row['name']}"} for row in _rows(state, "peer") if "batch" in row]
    batches = sorted({row["batch"] for row in ours + peer})
    cells: list[tuple[str, str, Callable[[dict], str]]] = [
        ("ms", "", lambda row: _number(row.get("ms"))),
        ("skeleton, ms", ": skeleton", lambda row: _number(row.get("skeleton_ms"))),
        ("skeleton's rotations, ms", ": skeleton's rotations",
         lambda row: _number(row.get("skeleton_rotations_ms"))),
    ]  # fmt: skip
    rows = []
    for _, suffix, cell in cells:
        rows += _lines(ours + peer, batches, suffix, cell)
    yield "Milliseconds by batch", ["case", *map(str, batches)], rows
    rows = _lines(ours + peer, batches[-1:], "", lambda row: _number(row.get("meshes_per_s")))
    peaks = _lines(ours + peer, batches[-1:], "", lambda row: _number(row.get("peak_mb")))
    known = {row[0]: row[1] for row in peaks}
    rows = [[*row, known.get(row[0], "")] for row in rows]
    if batches:
        yield f"At batch {batches[-1]}", ["case", "meshes/s", "peak MB"], rows


def _lines(rows: list[dict], batches: list[int], suffix: str, cell: Callable[[dict], str]) -> list[list[str]]:
    found: dict[str, dict[int, str]] = {}
    for row in rows:
        text = cell(row)
        if text:
            found.setdefault(row["name"].rpartition(" ")[0] + suffix, {})[row["batch"]] = text
    lines = [[case, *(values.get(batch, "") for batch in batches)] for case, values in found.items()]
    return [line for line in lines if any(line[1:])]


def _trouble(state: dict) -> list[str]:
    """A line for each section, and one for each row that failed, was skipped or is wrong."""
    lines = []
    for name, section in state["sections"].items():
        lines.append(f"{name}: {section['status']}, {section['seconds']:.0f} s, "
                     f"{len(section['rows'])} rows. {section.get('why', '')[-200:]}".strip())  # fmt: skip
        skipped = [row["name"] for row in section["rows"] if row["status"] == "skipped"]
        if skipped:
            lines.append(f"- no time for {len(skipped)} rows: {', '.join(skipped)}"[:400])
        for row in section["rows"]:
            if row["status"] == "skipped":
                continue
            if row["status"] != "done" or row.get("ok") is False or row["name"] == "none":
                wrong = "" if row.get("ok") is not False else " WRONG"
                lines.append(f"- {row['name']}: {row['status']}{wrong} {row.get('why', '')[:150]}".rstrip())
            elif "why" in row:
                lines.append(f"- {row['name']}: {row['why'][:150]}")
    for restart in state.get("restarts", []):
        lines.append(f"- a worker ended: {restart['why']}")
    return [line + "  " for line in lines] + [""]


def _machine(state: dict) -> str:
    rows = {row["name"]: row for row in state["sections"].get("machine", {}).get("rows", [])}
    found, clocks = rows.get("versions", {}), rows.get("clocks", {})
    driver = f", driver {clocks['driver_version']}" if "driver_version" in clocks else ""
    rates = [f"{rows[name][key]:.3g} {unit}" for name, key, unit in (
        ("memory", "tb_per_s", "TB/s copied"), ("product", "tflop_per_s", "TFLOP/s in a float32 product"),
    ) if key in rows.get(name, {})]  # fmt: skip
    card = found.get("card") or found.get("cpu", state["options"]["device"])
    return (f"{card}{driver}, torch {found.get('torch', '?')}, CUDA {found.get('cuda')}, "
            f"Warp {found.get('warp', '?')}, commit {state['commit'] or 'unknown'}; medians, float32. "
            f"{'; '.join(rates)}").strip()  # fmt: skip
