"""What `mapek swap` says before anybody is asked."""

import pytest
from command_line import Mapek

from adapters.cli.swap import SWAPPED_WITHIN
from adapters.processes.replacing import CHECKED_WITHIN


@pytest.mark.parametrize("to", ["", "  ", '{name = ""}', "{alpha = 0.2}"])
def test_a_part_without_a_name_is_a_matter_of_usage(mapek: Mapek, to: str) -> None:
    outcome = mapek("swap", "plan", to, "--connect", "tcp/127.0.0.1:9")

    assert outcome.code == 2
    assert "name" in outcome.err
    assert "{'name'" not in outcome.err


def test_who_asks_waits_longer_than_a_check_may_take() -> None:
    assert SWAPPED_WITHIN > CHECKED_WITHIN
