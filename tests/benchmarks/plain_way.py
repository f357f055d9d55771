"""Table 1 in the plain way: `gymnasium.make`, a NumPy Q-table, `np.argmax`, one process.

What a user writes today, with the same algorithm and the same measures; the reference of the speed claims.
"""

import math

import gymnasium
import numpy as np

import managed_systems  # noqa: F401 - registers the gridworld

OPTIONS = {"goals": [(0, 0), (8, 8)], "switch_at": [301, 601, 901, 1201]}


def morphin_trial(seed, episodes=1500):
    """Return the total of steps, the alarms, and the largest change of Q after each episode."""
    env = gymnasium.make("mapek/Gridworld-v0", **OPTIONS)
    rng = np.random.default_rng(seed)
    q = np.zeros((81, 4))
    n = mean = total = minimum = 0.0
    counter, alarmed, steps = 0.0, False, 0
    alarms, changes = [], []
    for episode in range(1, episodes + 1):
        epsilon = 0.1 + 0.9 * math.exp(-0.05 * counter)
        before = q.copy()
        state, info = env.reset(seed=seed if episode == 1 else None)
        episode_return, done = 0.0, False
        while not done:
            if rng.random() < epsilon:
                action = rng.choice(np.flatnonzero(info["action_mask"]))
            else:
                action = np.argmax(q[state])
            following, reward, terminated, truncated, info = env.step(action)
            td_error = reward + 0.9 * np.max(q[following]) - q[state, action]
            q[state, action] += (0.1 + 0.89 / (1.0 + math.exp(-(abs(td_error) - 5.0)))) * td_error
            state, done = following, terminated or truncated
            episode_return += reward
            steps += 1
        changes.append(np.abs(q - before).max())
        if alarmed:
            counter = min((counter + 1.0) * (15.0 if episode_return > 0 else 0.6), 1e6)
        else:
            counter += 1.0
        n += 1.0
        mean += (episode_return - mean) / n
        total += mean - episode_return - 0.5
        minimum = min(minimum, total)
        if total - minimum > 300.0:
            n = mean = total = minimum = counter = 0.0
            alarmed = True
            alarms.append(episode)
    env.close()
    return steps, alarms, changes


def q_learning_trial(seed, episodes=1500):
    """Return the total of steps and the largest change of Q after each episode."""
    env = gymnasium.make("mapek/Gridworld-v0", **OPTIONS)
    rng = np.random.default_rng(seed)
    q = np.zeros((81, 4))
    steps, changes = 0, []
    for episode in range(1, episodes + 1):
        before = q.copy()
        state, info = env.reset(seed=seed if episode == 1 else None)
        done = False
        while not done:
            action = rng.choice(np.flatnonzero(info["action_mask"])) if rng.random() < 0.1 else np.argmax(q[state])
            following, reward, terminated, truncated, info = env.step(action)
            q[state, action] += 0.1 * (reward + 0.9 * np.max(q[following]) - q[state, action])
            state, done = following, terminated or truncated
            steps += 1
        changes.append(np.abs(q - before).max())
    env.close()
    return steps, changes
