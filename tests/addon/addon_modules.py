"""Imports modules of the Blender add-on that need no Blender, without its package, which imports bpy."""

import importlib
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

ROOT = Path(__file__).parents[2]
SOURCE = ROOT / "addon" / "mocapfix_blender"


def load_addon_module(name: str) -> Any:
    """Return a module of the add-on by its name."""
    if "mocapfix_blender" not in sys.modules:
        package = ModuleType("mocapfix_blender")
        package.__path__ = [str(SOURCE)]
        sys.modules["mocapfix_blender"] = package
    return importlib.import_module(f"mocapfix_blender.{name}")
