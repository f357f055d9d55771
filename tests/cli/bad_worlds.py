"""Environments that break the contract of a managed system in one way each, all else kept."""

import gymnasium
from gymnasium.spaces import Box, Discrete


class Fine(gymnasium.Env):
    def __init__(self, n=2):
        self.observation_space, self.action_space = Discrete(3), Discrete(n)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.episode, self.steps = options["episode"], 0
        return 0, self.info()

    def step(self, action):
        self.steps += 1
        return *self.react(), False, self.steps == 4, self.info()

    def react(self):
        return 1, -1.0

    def info(self):
        return {}


class NanReward(Fine):
    def react(self):
        return 1, float("nan") if self.episode == 3 else 1.0


class InfiniteReward(Fine):
    def react(self):
        return 1, float("-inf") if self.episode == 3 else 1.0


class HugeReward(Fine):
    def react(self):
        return 1, -1.7e308 if self.steps % 2 else 1.7e308


class NoActions(Fine):
    def info(self):
        return {"available_actions": ()}


class NegativeAction(Fine):
    def __init__(self):
        super().__init__()
        self.action_space = Discrete(2, start=-1)

    def info(self):
        return {"available_actions": (0, -1)}


class LargeAction(Fine):
    def __init__(self):
        super().__init__(65)

    def info(self):
        return {"available_actions": (0, 64)}


class DoubleAction(Fine):
    def info(self):
        return {"available_actions": (0, 0, 1)}


class OtherActions(Fine):
    def __init__(self):
        super().__init__(7)

    def info(self):
        return {"available_actions": (0, 1) if self.episode < 3 else (5, 6)}


class VanishingActions(Fine):
    def info(self):
        return {"available_actions": (0, 1) if self.episode < 3 else ()}


class OffTheMap(Fine):
    def react(self):
        return (7 if self.episode == 3 and self.steps == 2 else 1), 1.0


class TextState(Fine):
    def react(self):
        return "left", 1.0


class RaisesInReset(Fine):
    def reset(self, *, seed=None, options=None):
        if options["episode"] == 3:
            raise RuntimeError("the valve is stuck")
        return super().reset(seed=seed, options=options)


class RaisesInStep(Fine):
    def react(self):
        if self.episode == 3 and self.steps == 2:
            raise RuntimeError("the valve is stuck")
        return 1, 1.0


class MissingSignal(Fine):
    signal_names = ("load",)


class NanSignal(Fine):
    signal_names = ("load",)

    def info(self):
        return {"signals": {"load": float("nan")}}


class NanObservation(Fine):
    def __init__(self):
        super().__init__()
        self.observation_space = Box(0.0, 1.0, (1,))

    def reset(self, *, seed=None, options=None):
        return [0.5], super().reset(seed=seed, options=options)[1]

    def react(self):
        return [float("nan")], 1.0


class Fourfold(Fine):
    def step(self, action):
        return super().step(action)[:4]


class NoSpace(Fine):
    def __init__(self):
        self.observation_space, self.action_space = Discrete(3), None


class HalfState(Fine):
    def react(self):
        return 1.5, 1.0


class TextReward(Fine):
    def react(self):
        return 1, "1.0"


class VectorReward(Fine):
    def react(self):
        return 1, [1.0]


class NoReward(Fine):
    def react(self):
        return 1, None


class ComplexReward(Fine):
    def react(self):
        return 1, 1 + 2j


class TextEnd(Fine):
    def step(self, action):
        seen, reward, _, truncated, info = super().step(action)
        return seen, reward, "False", truncated, info


class TextMask(Fine):
    def info(self):
        return {"action_mask": ["1", "0"]}


class ZeroMask(Fine):
    def info(self):
        return {"action_mask": [0, 0]}


class NoneLegal(Fine):
    def info(self):
        return {"legal_actions": ()}


class HalfAction(Fine):
    def info(self):
        return {"available_actions": (0, 1.5)}


class TextSignal(Fine):
    signal_names = ("load",)

    def info(self):
        return {"signals": {"load": "3"}}


class NoInfo(Fine):
    def info(self):
        return None


class StrangeGuard(Fine):
    def info(self):
        return {"action_taken": 7} if self.steps else {}


class OldReset(Fine):
    def reset(self, *, seed=None, options=None):
        return super().reset(seed=seed, options=options)[0]


class StrictReset(Fine):
    def reset(self, *, seed=None, options=None):
        if options:
            raise ValueError(f"unknown options {list(options)}")
        return super().reset(seed=seed, options={"episode": 1})


class Bare(Fine):
    def reset(self, *, seed=None):
        return super().reset(seed=seed, options={"episode": 1})


class Bound(Bare):
    def reset(self):
        return super().reset()


class OneName(Fine):
    signal_names = "load"


class SaysNo(Fine):
    redrivable = "no"


for name, kind in list(globals().items()):
    if isinstance(kind, type) and issubclass(kind, Fine) and f"{name}-v0" not in gymnasium.registry:
        gymnasium.register(f"{name}-v0", kind, max_episode_steps=20)
if "Endless-v0" not in gymnasium.registry:
    gymnasium.register("Endless-v0", Fine)
