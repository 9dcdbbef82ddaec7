"""The description of the package: README.md with the links of a checkout made absolute. Hatchling calls it when it builds."""

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

RELATIVE_LINK = re.compile(r"""(?:(?<=\]\()|(?<=src=")|(?<=href="))(?![a-z]+:|#)[^)\s"]+""")


def make_absolute(link: str, urls: dict[str, str]) -> str:
    """Return the address of a file of the checkout: on the site of the documentation, or in the repository."""
    if link.startswith("docs/"):
        return urls["Documentation"] + re.sub(r"\.md(?=#|$)", ".html", link.removeprefix("docs/"))
    return urls["Changelog"].removesuffix("CHANGELOG.md") + link


class DescriptionHook(MetadataHookInterface):
    """Sets the field `readme`."""

    def update(self, metadata: dict[str, Any]) -> None:
        text = (Path(self.root) / "README.md").read_text(encoding="utf-8")
        text = RELATIVE_LINK.sub(lambda link: make_absolute(link[0], metadata["urls"]), text)
        metadata["readme"] = {"content-type": "text/markdown", "text": text}
