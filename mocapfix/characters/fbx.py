"""FBX, which Blender reads and writes in a process of its own: nothing else does this with a current FBX from open source.

`fbx_export.py` is what that process runs. It imports the GLB of the character, exports it, imports the FBX again, and compares
the heads of all bones in every frame. An FBX is read as the GLB to which it converts it.
"""

import importlib.util
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from mocapfix.errors import ReadError
from mocapfix.io.files import make_scratch_folder, replace_atomically
from mocapfix.io.gltf import GlbContent, build_glb, parse_glb

BLENDER_VARIABLE = "MOCAPFIX_BLENDER"  # names an executable of Blender, or of a Python that has the module bpy
BLENDER_TIMEOUT_S = 300.0
EXPORT_SCRIPT = Path(__file__).with_name("fbx_export.py")
MAX_ERROR_CHARACTERS = 200  # of Blender's own message, in ours


def find_blender() -> list[str] | None:
    """Return the beginning of a command that runs a script in Blender; None without Blender.

    In this order: what the variable MOCAPFIX_BLENDER names, this Python if it has bpy, `blender` on the search path.
    """
    given = os.environ.get(BLENDER_VARIABLE)
    if given:
        return _build_command(given)
    if importlib.util.find_spec("bpy"):
        return [sys.executable]
    found = shutil.which("blender")
    return _build_command(found) if found else None


def _build_command(executable: str) -> list[str]:
    if Path(executable).name.lower().startswith("python"):
        return [executable]
    return [executable, "--background", "--factory-startup", "--python-exit-code", "1", "--python"]


def write_fbx(target: Path, glb_path: Path, rate: float) -> str | None:
    """Write FBX from a GLB: its mesh, all bones and its last animation, a key in every frame.

    Returns:
        A sentence why no file was written, None if it was: an FBX that is missing is no reason to fail a whole cleaning.

    Raises:
        WriteError: If `target` is not writable.
    """
    command = find_blender()
    if command is None:
        remedy = f"install it, or set {BLENDER_VARIABLE} to its executable"
        return f"{target.name} was not written, because FBX needs Blender and it was not found; {remedy}."
    with make_scratch_folder() as folder:
        source, exported = folder / "character.glb", folder / "character.fbx"
        content = parse_glb(glb_path, glb_path.read_bytes())
        animation = content.document["animations"][0]  # alone, so that Blender does not choose another one
        document = content.document | {"animations": [animation]}
        source.write_bytes(build_glb(GlbContent(document, content.binary, content.other_chunks)))
        problem = _run_blender(command, [str(source), str(exported), repr(float(rate)), animation["name"]])
        if problem is None and not exported.exists():
            problem = "Blender wrote no file"
        if problem:
            return f"{target.name} was not written: {problem}."
        with replace_atomically(target) as part:
            part.write_bytes(exported.read_bytes())
    return None


def is_fbx(path: Path, head: bytes) -> bool:
    """Return whether a file with this beginning is an FBX, binary or text."""
    return head.startswith(b"Kaydara FBX Binary") or path.suffix.lower() == ".fbx"


def convert_fbx(path: Path) -> bytes:
    """Return the GLB to which Blender converts an FBX. Raises ReadError without Blender, or if that cannot read it."""
    command = find_blender()
    if command is None:
        remedy = f"install it, set {BLENDER_VARIABLE} to its executable, or export the character as .glb"
        raise ReadError(f"{path}: an FBX is read by Blender, and it was not found; {remedy}.")
    with make_scratch_folder() as folder:
        converted = folder / "character.glb"
        problem = _run_blender(command, [str(path.resolve()), str(converted)])
        if problem or not converted.exists():
            raise ReadError(f"{path}: cannot be read: {problem or 'Blender wrote no file'}; export the character as .glb.")
        return converted.read_bytes()


def _run_blender(command: Sequence[str], arguments: Sequence[str]) -> str | None:
    """Run the script in Blender. Return what went wrong as the end of a sentence, None if nothing did."""
    separator = [] if len(command) == 1 else ["--"]
    is_own_python = command[0] == sys.executable
    environment = {key: value for key, value in os.environ.items() if is_own_python or not key.startswith("PYTHON")}
    try:
        done = subprocess.run(
            [*command, str(EXPORT_SCRIPT), *separator, *arguments],
            env=environment,
            capture_output=True,
            stdin=subprocess.DEVNULL,
            timeout=BLENDER_TIMEOUT_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f"Blender did not end within {BLENDER_TIMEOUT_S:g} s"
    except OSError as error:
        return f"{command[0]} cannot be started ({error.strerror}); check {BLENDER_VARIABLE}"
    if done.returncode == 0:
        return None
    lines = [line.strip() for line in done.stderr.decode("utf-8", "replace").splitlines() if line.strip()]
    return f"Blender failed ({(lines or ['no message'])[-1][:MAX_ERROR_CHARACTERS].rstrip('.')})"
