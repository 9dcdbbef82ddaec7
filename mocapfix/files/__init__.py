"""Helpers for files: layouts, atomic replacement, strict YAML models, and the data shipped with mocapfix."""
