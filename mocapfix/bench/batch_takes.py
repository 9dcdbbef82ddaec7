"""Folders of composed takes for the benchmarks of batches, and the comparison of the outputs of two batches."""

import hashlib
import json
import shutil
from pathlib import Path

from mocapfix.batch.records import RECORD_SUFFIX
from mocapfix.review.take_files import JSON_REPORT_SUFFIX
from mocapfix.synthetic import compose_take, write_synthetic_take

RUN_DEPENDENT_SUFFIXES = (RECORD_SUFFIX, ".rrd")
"""outputs with times: records, and recordings, to which rerun adds the time of writing"""


def compose_batch_takes(folder: Path, count: int, seconds: tuple[float, float], rate: float) -> float:
    """Write takes 0.c3d, 1.c3d ... of lengths that rise from the first to the second of `seconds`; return the sum in seconds."""
    folder.mkdir(parents=True, exist_ok=True)
    lengths = [seconds[0] + (seconds[1] - seconds[0]) * index / max(1, count - 1) for index in range(count)]
    for index, length in enumerate(lengths):
        write_synthetic_take(folder / f"{index}.c3d", compose_take(seed=index, seconds=length, rate=rate))
    return sum(lengths)


def copy_takes(originals: Path, folder: Path, count: int) -> None:
    """Copy takes in turn until there are `count`, those of each round into a folder of their own."""
    paths = sorted(originals.glob("*.c3d"))
    for index in range(count):
        target = folder / f"round{index // len(paths)}" / paths[index % len(paths)].name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(paths[index % len(paths)], target)


def hash_outputs(folder: Path) -> dict[str, str]:
    """Return the hashes of the outputs in the folder of one take by name, but of those that depend on the run or its folders."""
    paths = sorted(path for path in folder.iterdir() if path.is_file() and not path.name.endswith(RUN_DEPENDENT_SUFFIXES))
    return {path.name: hashlib.sha256(_read_output(path)).hexdigest() for path in paths}


def _read_output(path: Path) -> bytes:
    """Return the bytes of an output, of a report without the arguments, which name the input by its path."""
    if not path.name.endswith(JSON_REPORT_SUFFIX):
        return path.read_bytes()
    return json.dumps({key: value for key, value in json.loads(path.read_bytes()).items() if key != "arguments"}).encode()


def find_differing_takes(reference: Path, output_folder: Path) -> list[str]:
    """Return the takes in the rounds of `copy_takes` whose outputs differ from those of the originals."""
    expected = {path.name: hash_outputs(path) for path in reference.iterdir() if path.is_dir()}
    folders = sorted(output_folder.glob("round*/*")) or sorted(path for path in output_folder.iterdir() if path.name in expected)
    return [path.relative_to(output_folder).as_posix() for path in folders if hash_outputs(path) != expected[path.name]]
