"""Build the extension of Blender as a zip file: the same bytes for the same sources.

Usage: python addon/build_addon.py [FOLDER]
"""

import sys
import tomllib
import zipfile
from pathlib import Path

SOURCE = Path(__file__).parent / "mocapfix_blender"
SUFFIXES = (".py", ".toml")
ZIP_TIME = (1980, 1, 1, 0, 0, 0)
"""time of all members, the earliest that a zip file can have"""
FILE_MODE = 0o644


def build_addon(folder: Path) -> Path:
    """Write mocapfix_blender-VERSION.zip into a folder, which is created if necessary; return its path."""
    manifest = tomllib.loads((SOURCE / "blender_manifest.toml").read_text(encoding="utf-8"))
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / f"mocapfix_blender-{manifest['version']}.zip"
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        license_file = SOURCE.parents[1] / "LICENSE"
        sources = {path.name: path for path in SOURCE.iterdir() if path.suffix in SUFFIXES} | {"LICENSE": license_file}
        for name, path in sorted(sources.items()):
            member = zipfile.ZipInfo(name, ZIP_TIME)
            member.compress_type, member.external_attr, member.create_system = zipfile.ZIP_DEFLATED, FILE_MODE << 16, 3
            archive.writestr(member, path.read_bytes())
    return target


if __name__ == "__main__":
    sys.stdout.write(f"{build_addon(Path(sys.argv[1] if len(sys.argv) > 1 else 'dist'))}\n")
