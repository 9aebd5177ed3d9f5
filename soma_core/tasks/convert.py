"""``soma convert``: motions of other tools to this skeleton, one file or a folder of them."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import OmegaConf

from soma_core.errors import AssetError, InputError, SomaError
from soma_core.motion.conversion import EVERYONE, convert_file, convert_people
from soma_core.motion.folder import FolderConverted, convert_folder, is_one_motion
from soma_core.motion.shards import ShardsConverted, clip_count, convert_shards
from soma_core.paths import expanded

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from soma_core.config.schema import ConvertConfig

__all__ = ["run"]

_log = logging.getLogger(__name__)


def run(config: DictConfig, output: Path) -> None:
    """Convert ``config.input``: a file into `output`, or a folder, which is mirrored there.

    Raises:
        SomaError: the input, or the backend that it needs, cannot be used; in a folder, after the others.
    """
    options: ConvertConfig = OmegaConf.to_object(config)
    if not options.input:
        raise InputError(
            "input", got="none", expected="a motion file, or a folder of them", fix="Pass input=FILE."
        )
    path = expanded(options.input)
    if not path.exists():
        raise AssetError(path, cause="file is missing", fix="Check the path.")
    try:
        if options.output == "parquet":
            _say_shards(path, convert_shards(path, output, options=options), output / "report.json")
        elif path.is_dir() and not is_one_motion(path, options):
            _say(path, convert_folder(path, output, options=options), output / "report.json")
        elif clip_count(path) is not None:
            raise InputError(
                "input", got=f"{path.name}, a Parquet file of clips", expected="a motion, for output=folder",
                fix="Pass output=parquet; frames of SAM 3D Body are under pred_vertices.",
            )  # fmt: skip
        elif options.engine == "ray":
            raise InputError(
                "engine", got="ray, for one file", expected="local, which one file is for",
                fix="Leave engine out; or pass output=parquet for a Parquet file of clips.",
            )  # fmt: skip
        elif options.person == EVERYONE:
            for person, converted in convert_people(path, output, options=options).items():
                _log.info("%s, person %s: %s", path.name, person or "without a name", converted)
        else:
            found = convert_file(path, output, options=options)
            _log.info("%s: %s", path.name, found)
            _log.info("wrote %s", ", ".join(place.name for place in found.written.values()))
    except KeyboardInterrupt:
        _log.warning("stopped; the same command with out=%s goes on from here", output)
        raise


def _say(folder: Path, found: FolderConverted, report: Path) -> None:
    """Say what became of a folder.

    Raises:
        SomaError: a file could not be converted, or none holds a motion.
    """
    numbers = {"converted": found.converted, "skipped": found.skipped, "failed": found.errors}
    told = ", ".join(f"{len(names)} {state}" for state, names in numbers.items() if names)
    _log.info("%s: %s", folder, told)
    places = {name: place for each in found.converted.values() for name, place in each.written.items()}
    if places:
        _log.info("wrote %s for each of them", ", ".join(places))
    if len(found.skipped) == len(found):
        raise InputError(
            str(folder), got=f"{len(found)} files without a motion", expected="motion files",
            fix="soma convert input=FILE says what is missing in one of them.",
        )  # fmt: skip
    errors = list(found.errors.values())
    if len(errors) == len(found):
        raise errors[0]
    if errors:
        failed = f"{len(errors)} of {len(found)} files"
        raise SomaError(f"{failed} could not be converted, {report} lists them. The first: {errors[0]}")


def _say_shards(source: Path, found: ShardsConverted, report: Path) -> None:
    """Say what became of a data set.

    Raises:
        SomaError: a clip could not be converted.
    """
    told = ", ".join(f"{count} {state}" for state, count in sorted(found.counts.items()))
    earlier = f", {found.earlier} of them by an earlier run" if found.earlier else ""
    _log.info("%s: %s; %d shards in %s%s", source, told, len(found.shards), found.shards[0].parent, earlier)
    if found.failed:
        first = next(iter(found.failed.values()))
        failed = f"{len(found.failed)} of {sum(found.counts.values())} clips"
        raise SomaError(f"{failed} could not be converted, {report} lists them. The first: {first}")
