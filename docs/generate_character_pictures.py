"""Make the contact sheets in docs/characters.md: `python docs/generate_character_pictures.py CHARACTERS CAPTURES`.

CHARACTERS is a folder with the files that SHEETS names, CAPTURES one with takes of the CMU Graphics Lab Motion Capture Database.
Neither is in the repository; docs/characters.md says where the characters come from.
"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image

import mocapfix
from mocapfix.options import OutputOptions

PICTURES = Path(__file__).parent / "gallery"
SHEETS = {
    "kaykit_knight.glb": "02_05",
    "quaternius.glb": "05_13",
    "RobotExpressive.glb": "02_01",
    "CesiumMan.glb": "05_13",
    "cryptovoxels.vrm": "85_02",
    "Xbot.glb": "85_02",
}
"""character to the take that moves it"""
WIDTH_PX, COLOURS = 1200, 64


def main(characters: Path, captures: Path) -> None:
    for name, take in SHEETS.items():
        result = mocapfix.clean(captures / f"{take}.c3d")
        with TemporaryDirectory() as folder:
            path = characters / name
            outputs = result.write(folder, options=OutputOptions(characters=(path,), extra_formats=("sheet",)))
            with Image.open(outputs[f"{path.stem}.sheet.png"]) as sheet:
                small = sheet.convert("RGB").resize(
                    (WIDTH_PX, round(sheet.height * WIDTH_PX / sheet.width)), Image.Resampling.LANCZOS
                )
        small.quantize(COLOURS).save(PICTURES / f"character-{path.stem}.png", optimize=True)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
