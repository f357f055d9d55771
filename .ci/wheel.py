"""What a wheel holds besides the packages: the examples, within `mape`, where `mapek run frozen_lake` finds them.

An editable install has them in the checkout. A copy beside it would be a folder `mape` of its own, which Python takes
for the package.
"""

from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class Examples(BuildHookInterface):
    """Puts the folder of the examples into a wheel."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Add the folder, unless the install is ``"editable"``."""
        if version != "editable":
            build_data["force_include"]["examples"] = "mape/examples"
