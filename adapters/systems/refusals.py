"""What is said of an environment that refuses its options."""

from __future__ import annotations

import inspect
from typing import Any

import gymnasium
from gymnasium.envs.registration import load_env_creator

from mape.config import SystemConfig
from mape.errors import ConfigError, UnknownName
from mape.states import faults, told


def refusal(config: SystemConfig, error: BaseException) -> ConfigError:
    """Return the error for what an environment raised while it was made.

    An option that it does not have is named with those it has; else it speaks for itself, beside its options.
    """
    legal = _options_of(config.id)
    unknown = [] if legal is None else [name for name in config.options if name not in legal]
    if unknown and isinstance(error, TypeError):
        return UnknownName(f"option of system {config.id!r}:", unknown[0], legal or ())
    if isinstance(error, TypeError) and isinstance(error.__context__, TypeError):
        error = error.__context__  # Gymnasium raises it again, with the options behind it
    said = error if isinstance(error, Exception) else told(error)  # of an exit, the text is but its code
    return ConfigError(f"system {config.id!r} with options {config.options}: {said}")


def _options_of(identifier: str) -> list[str] | None:
    """Return the keyword arguments of an environment, or None where it takes any, or cannot be asked."""
    try:
        made: Any = gymnasium.spec(identifier.rpartition(":")[2]).entry_point
        parameters = inspect.signature(load_env_creator(made) if isinstance(made, str) else made).parameters.values()
    except faults():  # of a module that cannot be imported; of a creator that has no signature
        return None
    if any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
        return None
    return [parameter.name for parameter in parameters if parameter.kind is not parameter.VAR_POSITIONAL]
