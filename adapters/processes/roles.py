"""The roles by their names."""

from __future__ import annotations

from collections.abc import Callable

from adapters.buses.member import Member
from adapters.buses.messages import Layout
from adapters.processes.role import Role
from mape.config import Config
from mape.loop import layout_of


def make_role(
    name: str, config: Config, member_of: Callable[[Layout | None], Member], hang_after: float | None = None
) -> Role:
    """Make a role, with a link to Knowledge that `member_of` makes of the layout that Execute has to tell.

    After `hang_after` seconds without a step Execute gives an episode up, and itself with it.

    Raises
    ------
    ConfigError
        The system or a part cannot be made.
    """
    if name != "execute":
        return Role(name, config, member_of(None))
    # Gymnasium takes its time to import, and the other roles have no use for it.
    from adapters.processes.execute_role import ExecuteRole, FreeExecuteRole
    from adapters.systems import make_system

    system = make_system(config.system)
    try:
        layout = layout_of(config, system)
        told = Layout(
            signals=layout.signals, detectors=layout.detectors, rates=layout.rates, max_actions=layout.max_actions
        )
        kind = FreeExecuteRole if config.execute.mode == "free" else ExecuteRole
        return kind(name, config, member_of(told), [system], hang_after)
    except BaseException:
        system.close()
        raise
