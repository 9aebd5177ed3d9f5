"""Motions of other tools to this skeleton and back: read, written, converted, fitted, played.

The names are loaded when they are first used: options cost no torch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from soma_core._lazy import lazy_names

if TYPE_CHECKING:
    from soma_core.io.bvh import read_bvh, write_bvh
    from soma_core.io.skeleton_motion import SkeletonMotion
    from soma_core.motion.animated import Animated, animate
    from soma_core.motion.cleaning import (
        Cleaned,
        clean,
        mirror,
        mirrored_body,
        resample,
        smooth,
        without_spikes,
    )
    from soma_core.motion.clip_stream import ClipStream
    from soma_core.motion.conversion import convert, convert_file, convert_people, load_clip
    from soma_core.motion.converter import Converted, finish_fit, invert, plan_fit
    from soma_core.motion.files import layout_of, read, write
    from soma_core.motion.fit_job import FitPlan, fit_chunks
    from soma_core.motion.folder import FolderConverted, convert_folder
    from soma_core.motion.identities import stored_identity
    from soma_core.motion.options import (
        CleanOptions,
        ConvertOptions,
        DatasetOptions,
        FitOptions,
        InvertOptions,
        LimbSeconds,
    )
    from soma_core.motion.played import Played
    from soma_core.motion.products import write_body, write_products
    from soma_core.motion.quality import motion_quality
    from soma_core.motion.retargeting import retarget
    from soma_core.motion.shards import ShardsConverted, convert_dataset, convert_shards
    from soma_core.motion.writers import WriteOptions
    from soma_core.options import BackendChoice, FrameRange, IdentityChoice, InversionChoice, Picture

__all__ = [
    "Animated",
    "BackendChoice",
    "CleanOptions",
    "Cleaned",
    "ClipStream",
    "ConvertOptions",
    "Converted",
    "DatasetOptions",
    "FitOptions",
    "FitPlan",
    "FolderConverted",
    "FrameRange",
    "IdentityChoice",
    "InversionChoice",
    "InvertOptions",
    "LimbSeconds",
    "Picture",
    "Played",
    "ShardsConverted",
    "SkeletonMotion",
    "WriteOptions",
    "animate",
    "clean",
    "convert",
    "convert_dataset",
    "convert_file",
    "convert_folder",
    "convert_people",
    "convert_shards",
    "finish_fit",
    "fit_chunks",
    "invert",
    "layout_of",
    "load_clip",
    "mirror",
    "mirrored_body",
    "motion_quality",
    "plan_fit",
    "read",
    "read_bvh",
    "resample",
    "retarget",
    "smooth",
    "stored_identity",
    "without_spikes",
    "write",
    "write_body",
    "write_bvh",
    "write_products",
]

_HOMES = {
    "soma_core.io.bvh": ["read_bvh", "write_bvh"],
    "soma_core.io.skeleton_motion": ["SkeletonMotion"],
    "soma_core.motion.animated": ["Animated", "animate"],
    "soma_core.motion.cleaning": [
        "Cleaned",
        "clean",
        "mirror",
        "mirrored_body",
        "resample",
        "smooth",
        "without_spikes",
    ],
    "soma_core.motion.clip_stream": ["ClipStream"],
    "soma_core.motion.conversion": ["convert", "convert_file", "convert_people", "load_clip"],
    "soma_core.motion.converter": ["Converted", "finish_fit", "invert", "plan_fit"],
    "soma_core.motion.files": ["layout_of", "read", "write"],
    "soma_core.motion.fit_job": ["FitPlan", "fit_chunks"],
    "soma_core.motion.folder": ["FolderConverted", "convert_folder"],
    "soma_core.motion.identities": ["stored_identity"],
    "soma_core.motion.options": [
        "CleanOptions",
        "ConvertOptions",
        "DatasetOptions",
        "FitOptions",
        "InvertOptions",
        "LimbSeconds",
    ],
    "soma_core.motion.played": ["Played"],
    "soma_core.motion.products": ["write_body", "write_products"],
    "soma_core.motion.quality": ["motion_quality"],
    "soma_core.motion.retargeting": ["retarget"],
    "soma_core.motion.shards": ["ShardsConverted", "convert_dataset", "convert_shards"],
    "soma_core.motion.writers": ["WriteOptions"],
    "soma_core.options": ["BackendChoice", "FrameRange", "IdentityChoice", "InversionChoice", "Picture"],
}

__getattr__, __dir__ = lazy_names(__name__, _HOMES)
