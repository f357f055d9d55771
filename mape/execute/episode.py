"""One episode of tabular TD learning, written once.

`episode` is a template: the names `begin`, `narrow`, `act`, `credit`, `explorable`, `value` and `step_size` are bound
to a system's and a learner's rules by `mape.compose`. Bound to compilable rules it becomes one compiled call; bound to
the same rules as plain Python, or to the methods of any Gymnasium environment, it is the same algorithm with the same
bits.
"""

from __future__ import annotations

import math
from typing import Any

from mape.execute.rules import Floats, Ints, greedy

# Bound by `mape.compose`.
begin: Any = None
narrow: Any = None
act: Any = None
credit: Any = None
explorable: Any = None
value: Any = None
step_size: Any = None

OK, NON_FINITE, OFF_TABLE, OVERFLOW, NONE_LEGAL = 0, 1, 2, 3, 4
TRACE_COLUMNS = ("state", "action", "exploratory", "q", "td_error", "alpha")


def episode(
    number: int,
    epsilon: float,
    at: int,
    trace: Floats,
    system: Any,
    q: Floats,
    touched: Ints,
    journal: Ints,
    saved: Floats,
    used: Ints,
    rows: Ints,
    legal: Ints,
    choices: Ints,
    actions: Ints,
    rate: Floats,
    draws: Floats,
    context: Floats,
    discount: float,
    bootstrap_terminal: bool,
    on_policy: bool,
    mask_greedy: bool,
    reset_draws: int,
    step_draws: int,
    max_steps: int,
) -> tuple[int, int, float, float, float]:
    """Drive one episode and learn from it.

    Parameters
    ----------
    number, epsilon
        Number of the episode, from 1, also the stamp of the pairs that it touches; its exploration rate.
    draws, at
        Uniforms on [0, 1). The block of this episode begins at `at`: first the system's (`reset_draws`, then
        `step_draws` per step), then two per step for exploration.
    trace
        Shape (max_steps, 6) or (0, 6); see `TRACE_COLUMNS`.
    system
        What the system's rules take first.
    q, touched
        Values and stamps, shape (rows, states). A pair whose stamp is not `number` is saved before its first update.
    journal, saved, used
        The undo journal: flat index and old value of each touched pair; ``used[0]`` is its length, ``used[1]`` the
        number of steps, -1 before the first state. They are valid even if a rule raises.
    rows, legal, choices
        The rows of the actions on offer; those of them that are legal in a state, written here; as much working space.
        Where all that is offered is legal in every state, `legal` is `rows`.
    actions
        Action id of each row.
    rate
        Parameters of `step_size`.
    context
        Means of the system's own signals over the steps; written here.
    discount, bootstrap_terminal, on_policy
        The learner's; the last says whether `value` looks at the rows that exploration may choose, which are sought for
        nobody else.
    mask_greedy
        Whether the greedy choice too is among the rows worth exploring, where there are any.

    Returns
    -------
    status, steps, return, mean absolute TD error, max absolute change of Q
        On a status other than OK the last three are the state or reward, action and TD error at fault; OVERFLOW leaves
        them as they are, one of them not finite.
    """
    used[0] = 0
    used[1] = -1
    for k in range(len(context)):
        context[k] = 0.0
    n_states = q.shape[1]
    at_step = at + reset_draws
    at_choice = at_step + max_steps * step_draws
    tracing = len(trace) > 0
    total = 0.0
    total_td = 0.0
    phase, state = begin(system, number, draws, at)
    used[1] = 0
    if not 0 <= state < n_states:
        return OFF_TABLE, 0, float(state), -1.0, 0.0
    count = narrow(system, phase, state, rows, legal, actions)  # what is legal in the present state: legal[:count]
    if count == 0:
        return NONE_LEGAL, 0, float(state), -1.0, 0.0
    steps = 0
    ended = False
    best = -1  # the greedy row of the present state, where it is known
    while steps < max_steps and not ended:
        allowed = 0
        exploring = draws[at_choice] < epsilon
        if exploring or mask_greedy:
            for i in range(count):
                if explorable(system, phase, state, actions[legal[i]]):
                    choices[allowed] = legal[i]
                    allowed += 1
        if exploring:
            if allowed:
                row = choices[int(draws[at_choice + 1] * allowed)]
            else:
                row = legal[int(draws[at_choice + 1] * count)]
        elif best >= 0:
            row = best
        elif mask_greedy and allowed:
            row = greedy(q, choices, allowed, state)
        else:
            row = greedy(q, legal, count, state)
        at_choice += 2

        next_state, reward, terminated, ended = act(system, phase, state, actions[row], draws, at_step, context)
        row = credit(system, row, actions)
        at_step += step_draws
        steps += 1
        used[1] = steps
        if not 0 <= next_state < n_states:
            return OFF_TABLE, steps, float(next_state), float(actions[row]), 0.0
        ended = ended or terminated

        bootstrap = 0.0
        best = -1
        if bootstrap_terminal or not terminated:
            count = narrow(system, phase, next_state, rows, legal, actions)
            if count == 0 and not terminated:
                return NONE_LEGAL, steps, float(next_state), float(actions[row]), 0.0
            allowed = 0
            if mask_greedy or on_policy:
                for i in range(count):
                    if explorable(system, phase, next_state, actions[legal[i]]):
                        choices[allowed] = legal[i]
                        allowed += 1
            # What exploration may choose there, of which an expectation is taken, is not what the greedy choice may.
            if count > 0:  # else the end, where nothing can be done any more
                if mask_greedy and allowed:
                    best = greedy(q, choices, allowed, next_state)
                else:
                    best = greedy(q, legal, count, next_state)
                if allowed:
                    bootstrap = value(q, choices, allowed, next_state, best, epsilon)
                else:
                    bootstrap = value(q, legal, count, next_state, best, epsilon)
                if next_state == state:
                    best = -1  # the update below changes this very state
        old = q[row, state]
        td_error = reward + discount * bootstrap - old
        if not math.isfinite(td_error):
            return NON_FINITE, steps, float(reward), float(actions[row]), td_error
        alpha = step_size(td_error, rate)
        new = old + alpha * td_error
        if not math.isfinite(new):
            return NON_FINITE, steps, float(reward), float(actions[row]), td_error
        if touched[row, state] != number:
            touched[row, state] = number
            journal[used[0]] = row * n_states + state
            saved[used[0]] = old
            used[0] += 1
        q[row, state] = new
        if tracing:
            trace[steps - 1, 0] = state
            trace[steps - 1, 1] = actions[row]
            trace[steps - 1, 2] = 1.0 if exploring else 0.0
            trace[steps - 1, 3] = new
            trace[steps - 1, 4] = td_error
            trace[steps - 1, 5] = alpha
        total += reward
        total_td += abs(td_error)
        state = next_state

    change = 0.0
    for i in range(used[0]):
        pair = journal[i]
        difference = abs(q[pair // n_states, pair % n_states] - saved[i])
        if difference > change:
            change = difference
    for k in range(len(context)):
        context[k] /= steps
    if not (math.isfinite(total) and math.isfinite(total_td) and math.isfinite(change)):
        return OVERFLOW, steps, total, total_td / steps, change
    return OK, steps, total, total_td / steps, change
