"""The sets of actions in a row of the log, read back from their masks."""


def actions_of(mask):
    """Return the ids of the actions in a mask column's words, in rising order."""
    return tuple(64 * w + bit for w, word in enumerate(mask) for bit in range(64) if int(word) >> bit & 1)
