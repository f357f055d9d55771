"""Templates and rules that are bound to each other; at module level, so that they can be compiled."""

import math

import numpy as np

SCALE, TABLE = 2.0, (0.5, 0.25)

# Bound by `mape.compose`.
rule = first = second = None


def scaled(x):
    return SCALE * rule(x) + TABLE[1]


def both(x):
    return first(x) - 3.0 * second(first(x))


def less(x):
    return x - 1.0


def root(x):
    return math.sqrt(abs(x))


def below(x):
    # Named as the free names of templates are, in another sense.
    second = x * 0.5
    return second if second < x else x


def makes_an_array(x):
    return np.array([x, 2.0]).sum()


def makes_zeros(x):
    return x + np.zeros(3)[0]


def makes_a_list(x):
    return max([x, 2.0])


def makes_a_text(x):
    if x > 1e9:
        raise ValueError(f"{x} is too much")
    return x


def asks_numpy(x):
    return np.median_of_medians(x)


def asks_math(x):
    return math.fmod(x, 2.0)


def adds_a_text(x):
    return x + "1"


def sums_a_generator(x):
    return sum(k * x for k in range(3))


def calls_another(x):
    return adds_a_text(x) + 1.0
