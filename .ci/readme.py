"""The README as a package index shows it, by hatch-fancy-pypi-readme: its links are absolute.

Set ``Repository`` in ``[project.urls]``, and the links lead there. Without it, they stay as they are.
"""

from typing import Any

from hatch_fancy_pypi_readme import hooks
from hatchling.metadata.plugin.interface import MetadataHookInterface


class ReadmeHook(MetadataHookInterface):
    """Gives the substitutions in pyproject.toml the address of the repository."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Set the project's readme."""
        repository = metadata.get("urls", {}).get("Repository", "").rstrip("/")
        links = self.config["substitutions"] if repository else ()
        absolute = [{**link, "replacement": link["replacement"].replace("REPOSITORY", repository)} for link in links]
        hooks.FancyReadmeMetadataHook(self.root, {**self.config, "substitutions": absolute}).update(metadata)
