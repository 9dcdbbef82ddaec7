"""What cleaning an animation gives, and how it is put into a folder."""

import json
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from mocapfix import change_file
from mocapfix.animation import Animation
from mocapfix.changes import Change
from mocapfix.clock import Clock, Progress
from mocapfix.errors import WriteError
from mocapfix.faults import Faults
from mocapfix.left import Left
from mocapfix.result import check_not_there, make_folder
from mocapfix.skeleton import Skeleton
from mocapfix.take import Take

SIDE_FILES = ("changes.yaml", "report.json", "report.html", "rrd")


@dataclass(frozen=True)
class AnimatedResult:
    """A cleaned animation and everything known of it.

    before, after  the animation as it was read, and as it was mended
    tips, take     the same as takes of the joints' tips, what was lost missing, and with the deviation of what was mended
    faults   what was wrong;  changes  what was done about it;  left  what stays empty, and why
    report   the record, as the JSON report holds it (see mocapfix.record)
    """

    before: Animation
    after: Animation
    tips: Take
    take: Take
    faults: Faults
    changes: tuple[Change, ...]
    left: tuple[Left, ...]
    report: dict

    def write(self, folder: str | Path, overwrite: bool = False, progress: Progress | None = None) -> dict[str, Path]:
        """Write the mended animation, its other bytes as they were, the changes, report and recording into a folder, made where
        it is not there.

        All are written beside their places first and put there together, so that none is missing or half-written.
        -> the files by kind. Raises WriteError where one is there already (and overwrite is False), or cannot be written.
        """
        folder = Path(folder)
        targets = self.outputs(folder)
        source, target = self.before.path, next(iter(targets.values()))
        if source and target.exists() and target.samefile(source):
            raise WriteError(f"{source}: is the input itself and is never replaced; choose another folder with --out.")
        check_not_there(targets.values(), overwrite)
        make_folder(folder)
        try:
            with TemporaryDirectory(dir=folder, prefix=f".{target.stem}.") as beside:
                parts = self.outputs(Path(beside))
                self._write_into(parts, Clock(dict(self.report["seconds"]), progress))
                for kind, place in targets.items():
                    parts[kind].replace(place)
        except OSError as error:
            raise WriteError(f"{folder}: cannot be written ({error.strerror or error}); choose another folder.") from error
        return targets

    def outputs(self, folder: Path) -> dict[str, Path]:
        """-> what `write` puts into a folder, by kind, each named by the input's stem; the animation first."""
        path = self.before.path or Path("animation.bvh")
        own = path.suffix.lstrip(".").lower()
        return {kind: folder / f"{path.stem}.{kind}" for kind in (own, *SIDE_FILES)}

    def _write_into(self, outputs: dict[str, Path], clock: Clock) -> None:
        from mocapfix import show
        from mocapfix.write.patched import patched

        with clock("write"):
            patched(next(iter(outputs.values())), self.before, self.after.values)
        figure = self.after
        ends = np.full(figure.offsets.shape, np.nan)
        skeleton = Skeleton(figure.names, figure.parents, figure.offsets @ figure.axes.T * figure.unit, ends)
        joints = figure.world()[0]
        shown = show.Cleaning(self.tips, self.tips, self.take, self.faults, self.changes, skeleton, joints)
        report = {**self.report, "seconds": clock.seconds}
        with clock("show"):
            show.comparison(outputs["rrd"], shown)
            show.report(outputs["report.html"], report, shown)
        change_file.save(outputs["changes.yaml"], self.tips, self.changes)
        outputs["report.json"].write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
