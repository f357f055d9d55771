"""`mapek` with one part of the recovery cut out, in all processes of a run: `no_recovery.py WHAT up CONFIG ...`.

It shows that the tests under blows would notice.
"""

import sys

import adapters.cli.up
from adapters.buses import member, outbox
from adapters.cli.main import main
from adapters.processes import role, supervise


def no_state(self, unit):
    """Go on where the log ends, with a component that knows nothing of what was before."""
    last = self.member.joined.last[unit.loop]
    if last[3] < 0:
        self.start(unit)
    self.member.watch(unit.loop, max(self.first, last[3] + (self.first == 1)))


def no_catching_up(join):
    def of_the_first_start_only(self, deadline):
        join(self, deadline)
        if self.joined.epoch > 1:
            self._inbox._fetch = lambda loop: None

    return of_the_first_start_only


CUTS = {
    "state": lambda: setattr(role.Role, "_restore", no_state),
    "catching-up": lambda: setattr(member.Member, "_join", no_catching_up(member.Member._join)),
    "sending-again": lambda: setattr(outbox.Outbox, "_send_again", lambda self, *given: None),
}


def command_of(role, config, *options):
    command = supervise.command_of(role, config, *options)
    return [command[0], __file__, what, *command[command.index("serve") :]]


if __name__ == "__main__":
    what = sys.argv.pop(1)
    adapters.cli.up.command_of = command_of
    CUTS[what]()
    sys.exit(main())
