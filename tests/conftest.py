"""How hypothesis draws: few examples, no deadline (the first call of a kernel compiles it), the same ones every time in CI."""

import os

from hypothesis import settings

settings.register_profile("mocapfix", deadline=None, max_examples=30, derandomize="CI" in os.environ)
settings.load_profile("mocapfix")
