"""A Ctrl-C at a chosen line of a function."""

import itertools
import sys


def stopped_by_ctrl_c(call, code, line):
    """Call, with a KeyboardInterrupt before the line number `line`, of those made, of a function; say if it has one."""
    lines = itertools.count()

    def trace(frame, event, _):
        if event == "line" and next(lines) == line:
            raise KeyboardInterrupt
        return trace

    before = sys.gettrace()
    sys.settrace(lambda frame, event, _: trace if frame.f_code is code else None)
    try:
        call()
    except KeyboardInterrupt:
        return True
    finally:
        sys.settrace(before)
    return False
