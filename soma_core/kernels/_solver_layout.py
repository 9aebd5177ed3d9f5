"""Lists, constants and working memory of the pose solver's kernels, by name."""

from collections.abc import Mapping

from soma_core.kernels._descent_text import MEMORY

__all__ = ["COUNTS", "EXTRA", "KEPT", "LISTS", "NUMBERS", "SLOTS", "slot_sizes"]

COUNTS = (
    "joint_count", "all_count", "weighted_count", "pair_count", "column_count", "driven_count", "slot_count",
    "channel_count", "helper_count", "add_count", "twist_count", "chain_count", "twist_rows", "block_count",
    "feature_columns", "used_count", "feature_count", "activation_count", "squash",
)  # fmt: skip
LISTS = (
    "parents", "weighted", "pairs", "joint", "parent", "parent_column", "near_start", "near_joint",
    "near_pair", "near_flip", "row_start", "row_joint", "row_parent", "row_slot", "push_start",
    "push_source", "push_target", "block_start", "block_row", "update_start", "update_target",
    "channel_joint", "channel_reference", "mix_start", "mix_channel", "drive_start", "drive_row",
    "drive_slot", "cross_start", "cross_row", "cross_slot", "add_slot", "add_pair", "add_channel",
    "twist_slot", "twist_channel", "twist_block", "twist_kind", "chain_channel", "chain_column",
    "mode_size", "taken_start", "taken", "read_start", "read_used", "read_column", "response_start",
    "tree_start", "tree_joint", "tree_up", "tree_row", "cloud_start", "cloud_tree", "cloud_weighted",
    "fold_start", "fold_tree", "fold_helper", "fold_channel", "fold_row", "mode_row_count", "apply_start",
    "apply_row", "apply_read", "apply_block", "apply_kind", "near_start_mode", "near_block", "near_rows",
    "used_joint", "feature_joint", "feature_column", "weigh_start", "weigh_feature",
)  # fmt: skip
NUMBERS = (
    "mix_value", "drive_value", "cross_value", "spin_axis", "gate", "mode", "cloud_moment", "fold_value",
    "gram", "left", "right", "feature_left", "feature_right", "feature_still", "weigh_value",
)  # fmt: skip
EXTRA = ("response_size", "mode_rows", "mode_tree", "opened")
"""Further counts, of memory alone."""

KEPT = ("blocks", "carry", "last", "inverse")


def slot_sizes(n: Mapping[str, int]) -> dict[str, int]:
    """Vectors of working memory by name."""
    a, t, k, c = n["all_count"], 12 * n["weighted_count"], n["channel_count"], n["column_count"]
    return {
        "relative": 9 * a, "trial_relative": 9 * a, "turns": 9 * a, "trial_turns": 9 * a,
        "places": 3 * a, "trial_places": 3 * a, "hips": 3, "trial_hips": 3,
        "steer": 3 * k, "trial_steer": 3 * k, "twist": k,
        "change": t, "product": t, "residual": t, "target": t, "column": 16 * a, "root": 4 * c,
        "spread": 9 * a, "force": 3 * a, "slope": 3 * c + 3, "twists": 3 * n["twist_rows"],
        "twist_force": 3 * k, "twist_pair": k * k, "helper_axis": 3 * n["helper_count"],
        "gained": 1, "damping": 1, "moving": 1, "accepted": 1, "last_change": 1, "threshold": 1, "mass": 1,
        "soft_energy": 1, "scale": 1, "activity": n["activation_count"], "active": n["activation_count"],
        "before": n["activation_count"], "pull": n["activation_count"],
        "feature": 3 * n["feature_columns"] * n["feature_count"], "transform": 12 * a, "push": 12 * a,
        "features": 9 * n["feature_columns"] * n["used_count"], "response": n["response_size"],
        "mode_rows": n["mode_rows"], "mode_tree": n["mode_tree"], "opened": n["opened"],
        "mode_force": 9 * c if n["block_count"] else 0,
        "gradient": 3 * c + 3, "past": 2 * MEMORY * (3 * c + 3), "past_inverse": MEMORY, "energy": 1,
        "shrink": 1, "pressing": 1, "doubt_weight": 1,
        "fresh": 3 * c + 3, "step": 3 * c + 3, "past_share": MEMORY, "reached": 1, "pressing_next": 1,
        "typical": 1,
        "selected": 9 * (n["slot_count"] + c + 1),
    }  # fmt: skip


SLOTS = tuple(slot_sizes(dict.fromkeys((*COUNTS, *EXTRA), 0)))
